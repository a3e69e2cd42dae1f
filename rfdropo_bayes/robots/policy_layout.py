"""Observations and actions of a policy, their order and units: shared by training and deployment.

Environments build their observations from a layout, and an exported policy carries it in its metadata. A deployment
refuses a policy whose layout does not match the robot. No JAX, no PyTorch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError

CommandUnit = Literal["m", "rad", "N", "N m", "Pa", "-"]
PEAK_TENSION = "peak_tension_n"
"""Metadata of an exported policy: the largest tension of a cable [N] in the evaluation that it was kept for."""
TENSION_LIMIT, STOPPED_EPISODES, EVALUATED_EPISODES = "tension_limit_n", "stopped_episodes", "evaluated_episodes"
"""Metadata beside it: the limit on tension [N] in that evaluation, if any; episodes that it stopped, and all."""


@dataclass(frozen=True)
class ObservationPart:
    """A named piece of the observation."""

    name: str  # name of the quantity, e.g. ``"markers"``, ``"goal"``, ``"commands"``.
    size: int  # number of values
    unit: str  # their SI unit, "-" if they have none


@dataclass(frozen=True)
class PolicyLayout:
    """Observation and action of a policy."""

    task: str  # the environment it was trained in
    period_s: float  # time from one action to the next [s]
    observation: tuple[ObservationPart, ...]  # parts of the observation, in order
    channels: tuple[str, ...]  # command channels that it moves, in order
    # unit of the commands: "m" of cable, "rad" of a motor, "N" of tension, "Pa" of pressure; of a black box also "N m"
    # or "-"
    unit: CommandUnit
    # "discrete" actions are rows of ``moves``; a "continuous" action is a number from -1 to 1 for every channel
    kind: Literal["discrete", "continuous"]
    # change of the commands by an action [unit]: (action, channel) if discrete; if continuous, one row, the change at 1
    moves: tuple[tuple[float, ...], ...]
    # low, high: limits of each channel's command [unit]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        channels = len(self.channels)
        widths = {len(row) for row in self.moves} | {len(self.low), len(self.high)}
        if widths != {channels}:
            raise InputError(f"moves and limits do not fit the {channels} channels", where=self.task)
        if self.kind == "continuous" and len(self.moves) != 1:
            raise InputError("a continuous action needs one row of moves", where=self.task)
        if self.period_s <= 0 or any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise InputError("the period must be positive, and limits must be [least, greatest]", where=self.task)

    @property
    def size(self) -> int:
        """Size of an observation."""
        return sum(part.size for part in self.observation)

    def assemble(self, parts: Mapping[str, Float[np.ndarray, "*lane size"]]) -> Float[np.ndarray, "*lane total"]:
        """An observation from its parts, of one lane or of many.

        Raises:
            InputError: a part is missing, or has another size.
        """
        columns = []
        for part in self.observation:
            if part.name not in parts:
                known = ", ".join(sorted(parts))
                raise InputError(
                    f"there is no {part.name!r}", where=f"observation of {self.task}", remedy=f"has {known}"
                )
            column = np.asarray(parts[part.name], dtype=np.float32)
            if column.shape[-1] != part.size:
                raise InputError(f"{part.name!r} has {column.shape[-1]} numbers, not {part.size}", where=self.task)
            columns.append(column)
        return np.concatenate(columns, axis=-1)

    def change(
        self, action: Int[np.ndarray, "*lane"] | Float[np.ndarray, "*lane channel"]
    ) -> Float[np.ndarray, "*lane channel"]:
        """Change of the commands by an action [unit]; continuous actions are clipped to -1 and 1.

        Raises:
            InputError: a discrete action that is not an integer in the range of ``moves``.
        """
        moves = np.asarray(self.moves)
        if self.kind == "discrete":
            chosen = np.asarray(action)
            if not np.issubdtype(chosen.dtype, np.integer) or chosen.min() < 0 or chosen.max() >= len(moves):
                raise InputError(
                    f"{_brief(chosen)} is not an action",
                    where=self.task,
                    remedy=f"use whole numbers from 0 to {len(moves) - 1}",
                )
            return moves[chosen]
        return moves[0] * np.clip(action, -1.0, 1.0)

    def to_json(self) -> str:
        """The layout as one line of text, keys in a fixed order."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str, *, where: str) -> PolicyLayout:
        """The layout that `to_json` wrote; InputError for any other text; ``where`` names its source."""
        try:
            table: dict[str, Any] = json.loads(text)
            table["observation"] = tuple(ObservationPart(**part) for part in table["observation"])
            table["moves"] = tuple(tuple(row) for row in table["moves"])
            for name in ("channels", "low", "high"):
                table[name] = tuple(table[name])
            return cls(**table)
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"the layout of the policy cannot be read: {error}", where=where, remedy="export the policy again"
            ) from None

    @property
    def sha256(self) -> str:
        """Digest: equal for policies with equal observations and actions."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    def require(self, other: PolicyLayout, *, where: str) -> None:
        """Raise an InputError that names the first difference to the layout that is needed here."""
        for name, wanted in asdict(self).items():
            found = asdict(other)[name]
            if found != wanted:
                raise InputError(
                    f"the policy's {name} is {_brief(found)}, here it is {_brief(wanted)}",
                    where=where,
                    remedy="use a policy that was trained for this layout",
                )


def _brief(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."
