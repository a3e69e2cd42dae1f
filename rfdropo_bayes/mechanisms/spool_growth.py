"""A spool whose radius changes with what is wound on it."""

from __future__ import annotations

from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class SpoolGrowth(InCommandUnit, MemorylessActuation):
    """Displacement grows with the square of the command, ``u (1 + k u)``; k is zero at null."""

    name = "spool_growth"
    stage = "actuation"
    inside_drive = False
    cause = "cable wound in layers, a conical spool, or a lever whose arm changes with its angle"
    remedy = "measure the travel of a cable turn by turn; use a grooved spool of one layer"
    in_metres = (
        ParameterSpec(
            "spool_growth",
            "1/m",
            -1e3,
            1e3,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 5.0},
            "relative change of the displacement per command",
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Add the square of the command, from zero command on."""
        return sent + values["spool_growth"] * sent**2
