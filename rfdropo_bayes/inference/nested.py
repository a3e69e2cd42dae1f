"""Nested slice sampling, through blackjax: evidence by shrinking the prior, a cross-check of tempering.

Tempering can stay nats too low where a posterior has a phase transition; nested sampling does not temper.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from blackjax import nss
from blackjax.ns import utils
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.nuts import log_densities
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import InferenceResult, chains, prior_cautions

SHRINKAGES = 100  # simulated prior volumes behind the evidence's deviation
EVALUATIONS = 8  # of a slice, roughly: stepping out and shrinking


@dataclass(frozen=True, repr=False)
class NestedConfig(MethodOptions, called="Nested"):
    """Nested slice sampling: posterior and evidence, where JAX can trace the likelihood.

    Attributes:
        live: points that are kept.
        deleted: share of them that is replaced in a step.
        slices: inner moves of a replaced point; None for max(5, 2 d).
        remaining: stop when the live points hold less than this share of the evidence, in logarithm.
        draws: from the posterior.
        max_steps: most steps.
    """

    live: int = 500
    deleted: float = 0.1
    slices: int | None = None
    remaining: float = -3.0
    draws: int = 1000
    max_steps: int = 5000

    def __post_init__(self) -> None:
        if self.live < 20 or not 0.0 < self.deleted <= 0.5 or self.draws < 1 or self.max_steps < 1:
            raise InputError("live must be 20 or more, deleted at most 0.5, draws and max_steps 1", where="[inference]")


def run(
    problem: Problem,
    config: NestedConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Shrink the prior onto the posterior. It keeps no checkpoint: an interrupted run starts again.

    Raises:
        InputError: a likelihood that JAX cannot trace.
    """
    prior, likelihood = log_densities(problem)
    began = time.monotonic()
    live_key, step_key, end_key = jax.random.split(key, 3)
    u = jnp.asarray(problem.to_unconstrained(problem.sample_prior(live_key, config.live)))
    replaced = max(1, int(config.deleted * config.live))
    slices = config.slices or max(5, 2 * u.shape[1])
    sampler = nss(prior, likelihood, num_inner_steps=slices, num_delete=replaced)
    init, advance = jax.jit(sampler.init), jax.jit(sampler.step)
    state, dead = init(u, rng_key=live_key), []
    for index in range(config.max_steps):
        state, info = advance(jax.random.fold_in(step_key, index), state)
        dead.append(jax.device_get(info))
        left = float(state.integrator.logZ_live - state.integrator.logZ)
        logbook.stage(float(np.clip(1.0 + config.remaining / min(left, -1e-9), 0.0, 1.0)), method="nested")
        if left < config.remaining:
            break
    final = utils.finalise(state, dead, update_info=False)
    draws, evidence = _collect(problem, final, end_key, config.draws)
    ledger = Ledger()
    ledger.charge(problem, config.live + len(dead) * replaced * slices * EVALUATIONS, problem.n_rows)
    sentence = f"nested sampling stopped after {config.max_steps} steps, before the evidence was in"
    short = [Caution(Code.EVIDENCE_UNFINISHED, sentence, grave=True)] * (left >= config.remaining)
    return InferenceResult(
        method="nested",
        draws=draws,
        log_evidence=evidence,
        trace=[{"rollouts": ledger.rollouts, "log_evidence": evidence[0], "steps": len(dead)}],
        **ledger.record(),
        cautions=[*short, *prior_cautions(problem, draws)],
        seconds=time.monotonic() - began,
        details={"live": config.live, "steps": len(dead), "rollouts_are_estimated": True},
    )


def _collect(
    problem: Problem, final: Any, key: PRNGKeyArray, count: int
) -> tuple[dict[str, np.ndarray], tuple[float, float]]:
    """Equal-weight draws, and the evidence with the deviation that unknown prior volumes give it."""
    weight_key, draw_key = jax.random.split(key)
    weights = np.asarray(utils.log_weights(weight_key, final, SHRINKAGES))
    values = np.asarray(jax.scipy.special.logsumexp(jnp.asarray(weights), axis=0))
    drawn = np.asarray(utils.sample(draw_key, final, count).position)
    return chains(problem, [drawn]), (float(values.mean()), float(values.std(ddof=1)))
