"""The no-U-turn sampler of numpyro: a cross-check on small problems that shares nothing with sequential samplers."""

from __future__ import annotations

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.infer import MCMC, NUTS

from rfdropo_bayes.bayes.problem import Problem, traced_densities
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import InferenceResult, chains, prior_cautions

CHAINS, PRIOR_DRAWS = 2, 64  # chains, which start at the best of this number of prior draws


@dataclass(frozen=True, repr=False)
class NutsConfig(MethodOptions, called="NUTS"):
    """NUTS: the posterior by Hamiltonian Monte Carlo, if JAX can differentiate the likelihood.

    Attributes:
        draws: draws of each of two chains, after an equal number of warm-up steps.
    """

    draws: int = 500

    def __post_init__(self) -> None:
        if self.draws < 1:
            raise InputError(f"draws = {self.draws} is less than 1", where="[inference]")


def run(problem: Problem, config: NutsConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Sample the posterior. Chains keep no checkpoint: an interrupted run starts again.

    Raises:
        InputError: the likelihood has no gradient, or no starts_of_draws prior draw has a likelihood.
    """
    prior, likelihood = traced_densities(problem)

    def potential(u: Float[Array, " d"]) -> Float[Array, ""]:
        return -(prior(u) + likelihood(u))

    try:
        jax.eval_shape(jax.grad(potential), jnp.zeros(len(problem.names)))
    # RuntimeError: only derivatives along a direction are known, as of compiled rollouts.
    except (jax.errors.JAXTypeError, TypeError, ValueError, NotImplementedError, RuntimeError) as error:
        what = "NUTS needs the gradient of the simulator, which this engine does not have"
        remedy = 'set simulator.engine = "jax", or use method = "smc"'
        raise InputError(what, where="[inference] method", remedy=remedy) from error
    began, ledger, (draw_key, run_key) = time.monotonic(), Ledger(), jax.random.split(key)
    u = np.asarray(problem.to_unconstrained(problem.sample_prior(draw_key, PRIOR_DRAWS)), dtype=float)
    density = evaluate_prior(problem, u) + evaluate_rows(problem, u, problem.n_rows, ledger).sum(axis=1)
    best = np.argsort(-density, kind="stable")[:CHAINS]
    if not np.isfinite(density[best]).all():
        what = f"too few of {PRIOR_DRAWS} prior draws have a positive likelihood"
        raise InputError(what, where="[model.priors]", remedy="widen the priors")
    kernel, size = NUTS(potential_fn=potential), config.draws
    sampler = MCMC(
        kernel, num_warmup=size, num_samples=size, num_chains=CHAINS, chain_method="sequential", progress_bar=False
    )
    sampler.run(run_key, init_params=jnp.asarray(u[best]), extra_fields=("num_steps", "diverging"))
    extra = sampler.get_extra_fields()
    # the warm-up takes the same number
    steps, diverging = 2 * int(np.sum(extra["num_steps"])), int(np.sum(extra["diverging"]))
    ledger.charge(problem, steps, problem.n_rows)
    draws = chains(problem, list(np.asarray(sampler.get_samples(group_by_chain=True))))
    sentence = f"{diverging} transitions diverged: the posterior has a place that steps cannot follow"
    cautions = [Caution(Code.TRANSITIONS_DIVERGED, sentence)] * bool(diverging) + prior_cautions(problem, draws)
    logbook.stage(1.0, method="nuts", rollouts=ledger.rollouts)
    facts = {"seconds": time.monotonic() - began, "details": {"diverging": diverging, "rollouts_are_estimated": True}}
    return InferenceResult("nuts", draws, **ledger.record(), cautions=cautions, **facts)  # type: ignore[arg-type]
