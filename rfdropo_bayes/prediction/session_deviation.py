"""Deviation of a session, or another group of recordings, from the shared values of a posterior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.prediction.model_error import ADAPTED_TO
from rfdropo_bayes.simulators.parameters import ParameterSpec


class SessionDeviation(NamedTuple):
    """Normal distribution of a session's deviation of one parameter, for every draw, in the parameter's unit."""

    # its mean: the deviation of the session that a posterior was adapted to; zero for any other session
    shift: Float[np.ndarray, " draw"]
    # its standard deviation: that between sessions for a session that no fit has seen; zero for the adapted one
    spread: Float[np.ndarray, " draw"]


def session_deviations(record: PosteriorRecord, specs: Sequence[ParameterSpec]) -> dict[str, SessionDeviation]:
    """Deviations of the session that a posterior describes: the adapted session, else any unseen session.

    Args:
        record: the posterior.
        specs: parameters of the model; others are ignored.

    Returns:
        deviations by parameter; empty if no parameter varies between sessions.
    """
    values = {info.name: record.flat(info.name) for info in record.free}
    known, session = {spec.name for spec in specs} & set(values), record.attrs.get(ADAPTED_TO, "")
    deviations: dict[str, SessionDeviation] = {}
    for info in (each for each in record.free if each.scope.added_to in known):
        nothing = np.zeros(len(values[info.name]))
        if info.scope.owner == session:
            deviations[info.scope.added_to] = SessionDeviation(values[info.name], nothing)
        else:
            deviations.setdefault(info.scope.added_to, SessionDeviation(nothing, info.spread_of(values, len(nothing))))
    return deviations
