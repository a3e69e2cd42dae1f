"""The no-U-turn sampler, through numpyro: a cross-check that shares nothing with the sequential samplers.

It needs the gradient of the log posterior, hence a likelihood that JAX can differentiate backwards.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.infer import MCMC, NUTS

from rfdropo_bayes.bayes.problem import Problem, TraceableProblem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import InferenceResult, chains, prior_cautions

LOWEST = -1e10  # density of a rollout that failed: finite, so that a gradient there is zero and not NaN


@dataclass(frozen=True, repr=False)
class NutsConfig(MethodOptions, called="NUTS"):
    """NUTS: the posterior by Hamiltonian Monte Carlo, where JAX can differentiate the likelihood.

    Attributes:
        chains: run one after the other.
        warmup, draws: of each chain.
        target_accept: acceptance that the step size is adapted to.
        screen: prior draws that the chains start from the best of.
    """

    chains: int = 2
    warmup: int = 300
    draws: int = 500
    target_accept: float = 0.8
    screen: int = 64

    def __post_init__(self) -> None:
        for name in ("chains", "warmup", "draws"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} is less than 1", where="[inference]")
        if not 0.0 < self.target_accept < 1.0 or self.screen < self.chains:
            raise InputError("target_accept must be between 0 and 1, and screen at least chains", where="[inference]")


def log_densities(problem: Problem) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Log prior and log likelihood of one unconstrained point, traceable.

    Raises:
        InputError: the problem has no likelihood that JAX can trace.
    """
    if not isinstance(problem, TraceableProblem):
        raise InputError(
            "this problem has no likelihood that JAX can trace", where="[inference] method", remedy='use method = "smc"'
        )

    def prior(u: Float[Array, " d"]) -> Float[Array, ""]:
        return jnp.asarray(problem.log_prior(u[None]))[0]

    def clipped(u: Float[Array, " d"]) -> Float[Array, ""]:
        value = problem.log_likelihood_at(u)
        return jnp.where(jnp.isfinite(value), value, LOWEST)

    return prior, clipped


def run(
    problem: Problem,
    config: NutsConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Sample the posterior. Chains keep no checkpoint: an interrupted run starts again.

    Raises:
        InputError: the likelihood has no gradient, or no screened prior draw has a likelihood.
    """
    prior, likelihood = log_densities(problem)

    def potential(u: Float[Array, " d"]) -> Float[Array, ""]:
        return -(prior(u) + likelihood(u))

    _check_gradient(potential, len(problem.names))
    began = time.monotonic()
    screen_key, run_key = jax.random.split(key)
    ledger = Ledger()
    start = _starts(problem, config, screen_key, ledger)
    kernel = NUTS(potential_fn=potential, target_accept_prob=config.target_accept)
    sampler = MCMC(
        kernel,
        num_warmup=config.warmup,
        num_samples=config.draws,
        num_chains=config.chains,
        chain_method="sequential",
        progress_bar=False,
    )
    fields = ("num_steps", "diverging", "accept_prob")
    first = jnp.asarray(start if config.chains > 1 else start[0])
    sampler.warmup(run_key, init_params=first, extra_fields=fields, collect_warmup=True)
    steps = int(np.sum(sampler.get_extra_fields()["num_steps"]))
    logbook.stage(config.warmup / (config.warmup + config.draws), method="nuts", rollouts=float(steps))
    sampler.run(sampler.post_warmup_state.rng_key, extra_fields=fields)
    extra = sampler.get_extra_fields()
    steps += int(np.sum(extra["num_steps"]))
    ledger.charge(problem, steps, problem.n_rows)
    u = np.asarray(sampler.get_samples(group_by_chain=True))
    draws = chains(problem, list(u))
    diverging = int(np.sum(extra["diverging"]))
    sentence = f"{diverging} transitions diverged: the posterior has a place that steps cannot follow"
    diverged = [Caution(Code.TRANSITIONS_DIVERGED, sentence)] * bool(diverging)
    logbook.stage(1.0, method="nuts", rollouts=ledger.rollouts)
    return InferenceResult(
        method="nuts",
        draws=draws,
        trace=[{"rollouts": ledger.rollouts, "acceptance": float(np.mean(extra["accept_prob"]))}],
        **ledger.record(),
        cautions=[*diverged, *prior_cautions(problem, draws)],
        seconds=time.monotonic() - began,
        details={"diverging": diverging, "gradients": steps},
    )


def _starts(problem: Problem, config: NutsConfig, key: PRNGKeyArray, ledger: Ledger) -> Float[np.ndarray, "chain d"]:
    u = np.asarray(problem.to_unconstrained(problem.sample_prior(key, config.screen)), dtype=float)
    density = evaluate_prior(problem, u) + evaluate_rows(problem, u, problem.n_rows, ledger).sum(axis=1)
    best = np.argsort(-density, kind="stable")[: config.chains]
    if not np.isfinite(density[best]).all():
        raise InputError(
            f"too few of {config.screen} prior draws have a positive likelihood",
            where="[model.priors]",
            remedy="widen the priors, or raise screen",
        )
    return u[best]


def _check_gradient(potential: Callable[[Array], Any], dimension: int) -> None:
    try:
        jax.eval_shape(jax.grad(potential), jnp.zeros(dimension))
    # RuntimeError: only derivatives along a direction are known, as of compiled rollouts.
    except (jax.errors.JAXTypeError, TypeError, ValueError, NotImplementedError, RuntimeError) as error:
        raise InputError(
            "NUTS needs the gradient of the simulator, which this engine does not have",
            where="[inference] method",
            remedy='set simulator.engine = "jax", or use method = "smc"',
        ) from error
