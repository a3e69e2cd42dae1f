"""State of several climbs over growing horizons: what each visit leaves, and which go on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes.basins import OneSummit, summits
from rfdropo_bayes.inference.modes.climb import Climbable, LevenbergState

RIVAL = 30.0  # [nat]: an optimum that far below the best matters to no posterior


class Climbs(NamedTuple):
    """State of the climbs.

    Attributes:
        positions: where each climb stands.
        log_density: log posterior there, at the horizon of the climb's last visit.
        converged: of the climb at that horizon.
        earlier: where the best climb of the horizon before ended, as one row; none at the first horizon, nor once
            another start was looked for around it.
        level: index of the present horizon; done: climbs done at it.
        noise: noise coordinates.
        ledger, trace, seconds: as in every method.
    """

    positions: Float[np.ndarray, "start d"]
    log_density: Float[np.ndarray, " start"]
    converged: Bool[np.ndarray, " start"]
    earlier: Float[np.ndarray, "end d"]
    level: int
    done: int
    noise: Bool[np.ndarray, " d"] | None
    ledger: Ledger
    trace: list[dict[str, Any]]
    seconds: float

    @property
    def begins_again(self) -> bool:
        """Whether the present climb is from another start, looked for at this horizon; see `restarts`."""
        return self.level > 0 and len(self.earlier) == 0

    @property
    def level_done(self) -> bool:
        """Whether all climbs have been at the present horizon."""
        return self.done == len(self.positions)


def begin(
    positions: Float[np.ndarray, "start d"], log_density: Float[np.ndarray, " start"], ledger: Ledger, seconds: float
) -> Climbs:
    """Climbs at their starts."""
    idle = np.zeros(len(positions), dtype=bool)
    return Climbs(positions, log_density, idle, positions[:0], 0, 0, None, ledger, [], seconds)


def record(climbs: Climbs, state: LevenbergState, steps: int, horizon: int, target: Climbable) -> Climbs:
    """Put down one finished climb."""
    positions, density, converged = climbs.positions.copy(), climbs.log_density.copy(), climbs.converged.copy()
    positions[climbs.done], density[climbs.done] = state.position, state.log_density
    converged[climbs.done] = state.converged
    facts = {"horizon": horizon, "start": climbs.done, "steps": steps, "log_density": state.log_density}
    climbs.trace.append(facts | {"converged": state.converged, "rollouts": climbs.ledger.rollouts})
    return climbs._replace(
        positions=positions, log_density=density, converged=converged, done=climbs.done + 1, noise=target.noise
    )


def with_starts(climbs: Climbs, starts: Float[np.ndarray, "start d"]) -> Climbs:
    """Further climbs at the present horizon."""
    return climbs._replace(
        positions=np.concatenate([climbs.positions, starts]),
        log_density=np.concatenate([climbs.log_density, np.full(len(starts), -np.inf)]),
        converged=np.concatenate([climbs.converged, np.zeros(len(starts), dtype=bool)]),
        earlier=climbs.earlier[:0],
    )


def go_on(climbs: Climbs, target: Climbable, same: OneSummit) -> Climbs:
    """Keep one climb of each summit and go to the next horizon.

    Of the climbs of a horizon the better half goes on (successive halving), and every rival of the best.
    """
    positions, density = climbs.positions, climbs.log_density
    kept = summits(positions, density, target.density, same)
    kept = kept[(2 * np.arange(len(kept)) < len(kept)) | (density[kept] > density[kept[0]] - RIVAL)]
    return climbs._replace(
        positions=positions[kept],
        log_density=density[kept],
        converged=climbs.converged[kept],
        earlier=positions[kept[:1]],
        level=climbs.level + 1,
        done=0,
    )


def pack(climbs: Climbs) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays of the climbs and the rest of them, for a checkpoint."""
    assert climbs.noise is not None
    of_arrays = ("positions", "log_density", "converged", "earlier", "noise")
    meta = {name: getattr(climbs, name) for name in ("level", "done", "trace", "seconds")}
    return {name: getattr(climbs, name) for name in of_arrays}, meta | {"ledger": climbs.ledger.record()}


def unpack(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> Climbs:
    """The climbs that `pack` took apart."""
    ledger = Ledger.from_record(meta["ledger"])
    named = {name: meta[name] for name in ("level", "done", "trace", "seconds")}
    saved: dict[str, Any] = {**arrays, **named}
    return Climbs(ledger=ledger, **saved)
