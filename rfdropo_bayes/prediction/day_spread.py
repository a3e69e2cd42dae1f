"""How far a day, or another group of recordings, deviates from the values that all of a posterior's days share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.pooling import DEVIATION, Pooled
from rfdropo_bayes.bayes.space import SEPARATOR, InferredParameter, deviations
from rfdropo_bayes.posteriors import SPREAD, PosteriorRecord
from rfdropo_bayes.prediction.first_row import spread_of_draws
from rfdropo_bayes.prediction.model_error import ADAPTED_TO
from rfdropo_bayes.simulators.parameters import ParameterSpec


class DayDeviation(NamedTuple):
    """Normal distribution of a day's deviation of one parameter, for every draw, in the parameter's unit.

    Attributes:
        shift: its mean: the deviation of the day that a posterior was adapted to; zero for any other day.
        spread: its standard deviation: that between days for a day that no fit has seen; zero for the adapted one.
    """

    shift: Float[np.ndarray, " draw"]
    spread: Float[np.ndarray, " draw"]


def pooled_parameters(record: PosteriorRecord, specs: Sequence[ParameterSpec]) -> dict[str, Pooled]:
    """The parameters of a posterior that differ between groups about a value that all share.

    Args:
        record: the posterior.
        specs: parameters of the model.

    Returns:
        by the parameter's name; the groups are without their recordings.
    """
    known = {spec.name for spec in specs}
    families = spread_families(record, specs)
    found: dict[str, Pooled] = {}
    for info in record.free:
        name, _, group = info.name.partition(SEPARATOR)
        shared = name.removesuffix(DEVIATION)
        if name in known or shared not in known:
            continue
        groups = found[shared].groups if shared in found else {}
        family = next((key for key in families if shared == key or shared.startswith(f"{key}_")), "")
        found[shared] = Pooled(float(dict(info.prior)["scale"]), {**groups, group: ()}, family)
    return found


def spread_families(record: PosteriorRecord, specs: Sequence[ParameterSpec]) -> list[str]:
    """Families whose standard deviation between groups a posterior holds, the longest name first: one cable's own
    spread comes before that of all cables."""
    known = {spec.name for spec in specs}
    found = [i.name.removesuffix(SPREAD) for i in record.free if i.name.endswith(SPREAD) and i.name not in known]
    return sorted(found, key=len, reverse=True)


def day_deviations(record: PosteriorRecord, specs: Sequence[ParameterSpec]) -> dict[str, DayDeviation]:
    """How the day that a posterior is for deviates: the day it was adapted to, else any day that no fit has seen.

    Args:
        record: the posterior.
        specs: parameters of the model; others are left out.

    Returns:
        by the parameter's name; empty where no parameter differs between days.
    """
    values = {info.name: record.flat(info.name) for info in record.free}
    by_name, day = {spec.name: spec for spec in specs}, record.attrs.get(ADAPTED_TO, "")
    found = {}
    for name, pooled in pooled_parameters(record, specs).items():
        if name not in values:
            continue
        nothing = np.zeros(len(values[name]))
        own = f"{name}{DEVIATION}{SEPARATOR}{day}"
        if own in values:
            found[name] = DayDeviation(values[own], nothing)
        else:
            spread = spread_of_draws(deviations(by_name[name], pooled)[0], values, len(nothing))
            found[name] = DayDeviation(nothing, spread)
    return found


def draw_deviation(
    deviation: InferredParameter, values: Mapping[str, np.ndarray], key: PRNGKeyArray, count: int
) -> Float[np.ndarray, " n"]:
    """The deviation of a group that no fit has seen, one for each of ``count`` draws, of their own spread between
    groups, in the parameter's unit."""
    return np.asarray(jax.random.normal(key, (count,))) * spread_of_draws(deviation, values, count)
