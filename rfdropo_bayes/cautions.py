"""Reasons to doubt a result: a code for programs, and a sentence for people."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Code(StrEnum):
    """Topic of a caution. Programs read codes; sentences may be reworded at any time."""

    AT_BOUND = "at_bound"
    """A parameter's posterior is cut off by a bound, or by an end of its prior."""
    IMPLAUSIBLE = "implausible"
    """The mass or stiffness that was fitted or fixed is implausible for a soft robot."""
    AGAINST_PRIOR = "against_prior"
    """The data put parameters in a region of little prior mass."""
    BUDGET_SPENT = "budget_spent"
    """The rollouts ran out before all data were in."""
    PARTICLES_STUCK = "particles_stuck"
    """The last moves hardly moved the particles."""
    EVIDENCE_SCATTERED = "evidence_scattered"
    """Replicates differ in their log evidence."""
    REPLICATES_DISAGREE = "replicates_disagree"
    """Replicates differ in the location of parameters."""
    MODES_UNSEEN = "modes_unseen"
    """A single replicate or optimisation cannot show that a mode of the posterior was lost."""
    ROLLOUTS_EXCLUDED = "rollouts_excluded"
    """Many rollouts got no weight."""
    OPTIMISATION_UNFINISHED = "optimisation_unfinished"
    """The best optimisation stopped before its optimum."""
    SEVERAL_OPTIMA = "several_optima"
    """One normal distribution does not describe the posterior."""
    NORMAL_DIFFERS = "normal_differs"
    """Few draws of a normal approximation count under the exact posterior, or none were compared."""
    SEARCH_EDGE = "search_edge"
    """RF-DROPO's mean or standard deviation is at an end of its search range."""
    NO_SPREAD = "no_spread"
    """RF-DROPO's standard deviation is at its smallest value."""
    DRIVES_UNSTATED = "drives_unstated"
    """The travel of drives is stated for some recordings, but not for all used recordings."""
    FIRST_ROW_FAR = "first_row_far"
    """A first row is farther from the simulated one than the model was wrong in the fitted recordings."""
    FIRST_ROW_UNMATCHED = "first_row_unmatched"
    """Draws of a new group's parameters did not converge in matching a first row."""
    SESSION_UNMATCHED = "session_unmatched"
    """A session is fitted worse than the fitted sessions, few of the body's draws explain it, or fits did not
    converge.
    """
    GROUP_WITHOUT = "group_without"
    """Parameters that some groups alone have: a group that no fit has seen is taken to be without them."""
    UNSAFE_POSTERIOR = "unsafe_posterior"
    """A policy is trained on a posterior that its own record, or an audit of its recordings, speaks against."""
    RECORDINGS_ONLY = "recordings_only"
    """Values of a parameter that only recordings can have, and no policy can meet."""
    RECORDING_DOUBTFUL = "recording_doubtful"
    """Rows, names or values of a recording were probably misread, or copied, or moved by something else."""
    FRAME_DOUBTFUL = "frame_doubtful"
    """The markers lie or move as in another frame than the robot's."""
    ORDER_DOUBTFUL = "order_doubtful"
    """Another order of the commands explains the motion better."""
    UNIT_DOUBTFUL = "unit_doubtful"
    """The markers move so much more, or less, than the nominal model that a unit was probably misread."""
    NOT_PREDICTED = "not_predicted"
    """No draw could be simulated under the commands of the test recordings."""
    RESIDUALS_CORRELATED = "residuals_correlated"
    """Residuals last from row to row beyond the noise model."""
    RESIDUALS_LAST = "residuals_last"
    """Residuals last from row to row, and rows count accordingly less."""
    RESIDUALS_HEAVY = "residuals_heavy"
    """There are more outliers than the noise model allows."""


@dataclass(frozen=True)
class Caution:
    """One reason to doubt a result.

    Attributes:
        code: its topic.
        sentence: the same for people, with numbers and a remedy.
        grave: the method failed, and the draws must not be used.
    """

    code: Code
    sentence: str
    grave: bool = False

    def as_dict(self) -> dict[str, Any]:
        """For JSON: code, sentence, grave."""
        return asdict(self)


def grave(cautions: Iterable[Caution]) -> list[Caution]:
    """The cautions that forbid use of the draws."""
    return [caution for caution in cautions if caution.grave]


def read_cautions(rows: Iterable[dict[str, Any]]) -> list[Caution]:
    """Cautions from the dictionaries that `Caution.as_dict` writes."""
    return [Caution(Code(row["code"]), row["sentence"], row["grave"]) for row in rows]
