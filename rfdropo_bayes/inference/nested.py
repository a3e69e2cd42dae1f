"""Nested slice sampling of blackjax, a cross-check on small problems: tempering can miss nats if a posterior has a
phase transition, and nested sampling, which shrinks the prior, does not temper.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from blackjax import nss
from blackjax.ns import utils
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, traced_densities
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import InferenceResult, chains, prior_cautions

REPLACED = 0.1  # share of the live points, in each step
REMAINING = -3.0  # logarithm of the share of the evidence that the live points hold at the end
MOST_STEPS = 5000
SHRINKAGES = 100  # simulated prior volumes behind the evidence's deviation
EVALUATIONS = 8  # of a slice, roughly: stepping out and shrinking


@dataclass(frozen=True, repr=False)
class NestedConfig(MethodOptions, called="Nested"):
    """Nested slice sampling: posterior and evidence, if JAX can trace the likelihood.

    Attributes:
        live: number of live points; the posterior has twice this number of draws.
    """

    live: int = 500

    def __post_init__(self) -> None:
        if self.live < 20:
            raise InputError(f"live = {self.live} is less than 20", where="[inference]")


def run(problem: Problem, config: NestedConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Shrink the prior onto the posterior. It keeps no checkpoint: an interrupted run starts again.

    Raises:
        InputError: a likelihood that JAX cannot trace.
    """
    began, (live_key, step_key, weight_key, draw_key) = time.monotonic(), jax.random.split(key, 4)
    u = jnp.asarray(problem.to_unconstrained(problem.sample_prior(live_key, config.live)))
    replaced, slices = int(REPLACED * config.live), max(5, 2 * u.shape[1])
    sampler = nss(*traced_densities(problem), num_inner_steps=slices, num_delete=replaced)
    state, advance, dead = jax.jit(sampler.init)(u, rng_key=live_key), jax.jit(sampler.step), []
    for index in range(MOST_STEPS):
        state, info = advance(jax.random.fold_in(step_key, index), state)
        dead.append(jax.device_get(info))
        remaining = float(state.integrator.logZ_live - state.integrator.logZ)
        logbook.stage(float(np.clip(1.0 + REMAINING / min(remaining, -1e-9), 0.0, 1.0)), method="nested")
        if remaining < REMAINING:
            break
    final = utils.finalise(state, dead, update_info=False)
    values = np.asarray(jax.scipy.special.logsumexp(utils.log_weights(weight_key, final, SHRINKAGES), axis=0))
    draws = chains(problem, [np.asarray(utils.sample(draw_key, final, 2 * config.live).position)])
    ledger = Ledger()
    ledger.charge(problem, config.live + len(dead) * replaced * slices * EVALUATIONS, problem.n_rows)
    sentence = f"nested sampling stopped after {MOST_STEPS} steps, before the evidence was in"
    short = [Caution(Code.EVIDENCE_UNFINISHED, sentence, grave=True)] * (remaining >= REMAINING)
    return InferenceResult(
        "nested",
        draws,
        trace=[{"rollouts": ledger.rollouts, "log_evidence": float(values.mean()), "steps": len(dead)}],
        log_evidence=(float(values.mean()), float(values.std(ddof=1))),
        **ledger.record(),
        cautions=[*short, *prior_cautions(problem, draws)],
        seconds=time.monotonic() - began,
        details={"live": config.live, "steps": len(dead), "rollouts_are_estimated": True},
    )
