"""The verdict by stated rules, and a sentence a lab can act on."""

from __future__ import annotations

from collections.abc import Sequence

from rfdropo_bayes.discrepancy.extension import Rules
from rfdropo_bayes.discrepancy.gain import Gain

NO_VERDICT = "no_verdict"  # no fit has converged, or the time was up before anything was found
DESCRIBED = "described"  # a law at a port, for which the library has no name, holds on unseen recordings
NEGLIGIBLE = "negligible"  # a discrepancy is sure, and far too small to matter
NO_DISCREPANCY, EXPLAINED, EQUIVALENT, PARTLY, UNEXPLAINED = (
    "no_discrepancy",
    "explained",
    "equivalent",
    "partly_explained",
    "unexplained",
)


def unclear(rules: Rules, gain: Gain) -> bool:
    """Whether unseen trajectories leave the explained fraction undetermined: its interval reaches from "none" to "all",
    because the discrepancy is small or the fraction varies between them.
    """
    return gain.interval[0] <= rules.significant and gain.interval[1] >= rules.explained


SMALL = 0.25
"""Share of the noise below which a discrepancy is far below it: with it in quadrature errors grow by 3 %."""


def negligible(rules: Rules, size: float, noise: float, numerical: float | None) -> bool:
    """Whether a significant discrepancy is too small to matter.

    It is if smaller than ``rules.matters``, if stated. Otherwise it must be far below the noise of one measurement, and
    below the change by half the time step and a finer mesh; all are distances of a marker [m].
    """
    if rules.matters is not None:
        return size < rules.matters
    return numerical is not None and size < SMALL * noise and size < numerical


def decide(
    rules: Rules,
    base_p: float,
    extended_p: float | None,
    class_sizes: Sequence[int],
    gain: Gain | None,
    doubtful: bool = False,
    small: bool = False,
) -> str:
    """Apply the rules.

    - no_discrepancy: the base model passes the joint test, under a plausible noise;
    - unexplained: it fails, and no candidate is significant, or all together explain at most 20 %, or they worsen the
      prediction of unseen trajectories;
    - explained: the extended model passes (p > .05) or leaves a negligible residual, the lower bound of the explained
      fraction exceeds 80 %, and unseen trajectories clearly support it; equivalent if a named class has several
      members;
    - partly_explained: a significant gain, but a condition of "explained" fails.

    Args:
        rules: limits of the rules.
        base_p, extended_p: p-values of the joint tests; None without an extension.
        class_sizes: number of members of each named class.
        gain: gain on unseen trajectories; None if it could not be measured.
        doubtful: see `Stacked.doubtful`.
        small: whether what the extended model leaves is `negligible`.
    """
    if base_p > rules.level and not doubtful:
        return NO_DISCREPANCY
    if not class_sizes or extended_p is None:
        return UNEXPLAINED
    if gain is None:
        return PARTLY
    if gain.worse or gain.explained <= rules.significant:
        return UNEXPLAINED
    if (small or extended_p > rules.extended_passes) and gain.clear and gain.interval[0] > rules.explained:
        return EQUIVALENT if max(class_sizes) > 1 else EXPLAINED
    return PARTLY
