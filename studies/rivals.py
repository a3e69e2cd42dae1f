"""The methods that RF-DROPO is compared with, on the same trajectories and the same number of rollouts.

- BayesSim (Ramos, Possas and Fox 2019): a mixture density network from summaries to parameters, trained on the prior.
- NPDR (Muratore et al. 2021): sequential neural posterior estimation (SNPE-C) with a masked autoregressive flow.
- UDR: uniform domain randomisation over random sub-ranges; it looks at no data.

The first two come from the package ``sbi`` (studies/requirements.txt). They see simulated trajectories with the
observation noise of the model on them and infer all parameters, in unconstrained coordinates standardised by the prior.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, RolloutProblem, with_rollouts
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.methods import METHODS, Method
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import InferenceResult, chains, exclusion_cautions, prior_cautions
from rfdropo_bayes.inference.smc.moves import host_generator
from studies.replicas import actions, noisy_rollouts

FEWEST_ROLLOUTS = 50


@dataclass(frozen=True, repr=False)
class BayesSimConfig(MethodOptions, called="BayesSim"):
    """BayesSim, a baseline of the paper with its settings there: a mixture density network.

    Attributes:
        rollouts: simulations drawn from the prior.
        hidden: width of the two hidden layers.
        components: of the mixture.
        max_epochs: of training; early stopping usually ends it.
        draws: from the posterior.
    """

    rollouts: float = 1000.0
    hidden: int = 24
    components: int = 5
    max_epochs: int = 500
    draws: int = 1000

    def __post_init__(self) -> None:
        _check_budget(self.rollouts, FEWEST_ROLLOUTS)


@dataclass(frozen=True, repr=False)
class NpdrConfig(MethodOptions, called="NPDR"):
    """NPDR, a baseline of the paper with its settings there: rounds of neural posterior estimation.

    Attributes:
        rollouts: simulations of all rounds together.
        rounds: each draws its simulations from the posterior of the round before.
        hidden: width of the flow's layers.
        transforms: of the flow; None for one per parameter.
        atoms: of the atomic loss.
        max_epochs: of training in each round.
        draws: from the posterior.
    """

    rollouts: float = 2000.0
    rounds: int = 20
    hidden: int = 100
    transforms: int | None = None
    atoms: int = 10
    max_epochs: int = 200
    draws: int = 1000

    def __post_init__(self) -> None:
        _check_budget(self.rollouts, FEWEST_ROLLOUTS * self.rounds)


@dataclass(frozen=True, repr=False)
class UdrConfig(MethodOptions, called="UDR"):
    """UDR, a baseline of the paper: uniform ranges drawn at random inside the central 99 % of the prior.

    Attributes:
        draws: from the ranges.
    """

    draws: int = 1000


def _check_budget(rollouts: float, least: int) -> None:
    if rollouts < least:
        raise InputError(f"{rollouts:g} rollouts are too few", where="[inference] rollouts", remedy=f"at least {least}")


class Simulations(NamedTuple):
    """Standardised parameters and the features they led to; failed rollouts are left out."""

    theta: Float[np.ndarray, "n d"]
    features: Float[np.ndarray, "n time f"]


class StandardPrior:
    """The problem's prior in standardised unconstrained coordinates, as ``sbi`` wants one: ``sample`` and ``log_prob``.

    Args:
        problem: whose prior it is.
        key: for the draws that set location and scale, and for all that follow.
    """

    def __init__(self, problem: Problem, key: PRNGKeyArray) -> None:
        self.problem, self.key, self._calls = problem, key, 0
        u = np.asarray(problem.to_unconstrained(problem.sample_prior(key, 2000)), dtype=float)
        self.mean, self.sd = u.mean(axis=0), u.std(axis=0)

    def __deepcopy__(self, memo: dict[int, Any]) -> StandardPrior:
        """Itself: ``sbi`` copies what a round proposes from, and a problem's compiled functions cannot be copied."""
        return self

    def sample(self, sample_shape: Any = ()) -> Any:
        """Draws, as a tensor of single precision."""
        import torch

        self._calls += 1
        n = int(np.prod(tuple(sample_shape))) if len(tuple(sample_shape)) else 1
        values = self.problem.sample_prior(jax.random.fold_in(self.key, self._calls), n)
        theta = self.standardise(np.asarray(self.problem.to_unconstrained(values), dtype=float))
        return torch.as_tensor(theta.reshape(*tuple(sample_shape), -1), dtype=torch.float32)

    def log_prob(self, theta: Any) -> Any:
        """Log density up to the constant of the scaling."""
        import torch

        flat = theta.detach().numpy().astype(float).reshape(-1, len(self.mean))
        density = evaluate_prior(self.problem, self.unconstrained(flat)) + np.log(self.sd).sum()
        return torch.as_tensor(density.reshape(theta.shape[:-1]), dtype=torch.float32)

    def standardise(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """From unconstrained coordinates."""
        return (u - self.mean) / self.sd

    def unconstrained(self, theta: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """To unconstrained coordinates."""
        return self.mean + self.sd * theta


class Untracked:
    """A tracker for ``sbi`` that keeps nothing; its own would write into a folder ``sbi-logs`` where it is run."""

    log_dir = None

    def log_metric(self, name: str, value: Any, step: int | None = None) -> None:
        """Keep nothing."""

    def flush(self) -> None:
        """Write nothing."""


def import_sbi() -> tuple[Any, Any]:
    """The packages ``torch`` and ``sbi``.

    Raises:
        InputError: they are not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import sbi.inference
            import sbi.neural_nets
            import sbi.utils
            import torch
    except ImportError as error:
        raise InputError(
            f"BayesSim and NPDR need the package sbi ({error})",
            where="[inference] method",
            remedy="install it: pip install -r studies/requirements.txt",
        ) from None
    return torch, sbi


def simulate(
    problem: RolloutProblem, prior: StandardPrior, theta: Float[np.ndarray, "n d"], key: PRNGKeyArray, ledger: Ledger
) -> Simulations:
    """Roll out parameter sets and put observation noise on them."""
    values = problem.from_unconstrained(jnp.asarray(prior.unconstrained(theta)))
    features, status = noisy_rollouts(problem, key, values)
    features, status = np.asarray(features, dtype=float), np.asarray(status)
    ledger.charge(problem, len(theta), problem.n_rows)
    broken = np.logical_not(np.isfinite(features).all(axis=(1, 2)))
    ledger.exclude(problem, status, broken)
    alive = (status == 0) & ~broken
    return Simulations(theta[alive], np.where(np.asarray(problem.observed_mask), features[alive], 0.0))


def observed_features(problem: RolloutProblem) -> Float[np.ndarray, "1 time f"]:
    """The measured trajectory, laid out like simulated ones; zero where masked."""
    return np.where(np.asarray(problem.observed_mask), np.asarray(problem.observed, dtype=float), 0.0)[None]


def run_bayessim(
    problem: Problem, config: BayesSimConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED
) -> InferenceResult:
    """BayesSim. It has one stage, so there is nothing to resume from.

    Raises:
        InputError: a problem without rollouts, or sbi is not installed.
    """
    simulated = with_rollouts(problem)

    def summarise(features: np.ndarray) -> np.ndarray:
        return cross_correlation_summary(features, actions(simulated))

    return _run(simulated, "bayessim", config, key, summarise, rounds=1, logbook=logbook)


def run_npdr(problem: Problem, config: NpdrConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """NPDR. Rounds build on trained networks, which are not kept: an interrupted run starts again.

    Raises:
        InputError: a problem without rollouts, or sbi is not installed.
    """
    return _run(with_rollouts(problem), "npdr", config, key, thinned_summary, rounds=config.rounds, logbook=logbook)


def _run(
    problem: RolloutProblem,
    name: str,
    config: Any,
    key: PRNGKeyArray,
    summarise: Callable[[np.ndarray], np.ndarray],
    *,
    rounds: int,
    logbook: Logbook,
) -> InferenceResult:
    torch, sbi = import_sbi()
    began = time.monotonic()
    prior_key, noise_key, seed_key = jax.random.split(key, 3)
    seed = int(host_generator(seed_key).integers(2**31))
    prior, ledger, trace = StandardPrior(problem, prior_key), Ledger(), []
    observed = summarise(observed_features(problem))[0]
    share = int(config.rollouts // rounds)
    with _apart(torch, seed):
        wrapped, _, _ = sbi.utils.process_prior(prior)
        estimator = _estimator(sbi, config, len(problem.names))
        trainer = sbi.inference.NPE_C(wrapped, density_estimator=estimator, tracker=Untracked())
        proposal, posterior, scaling = wrapped, None, None
        for index in range(rounds):
            theta = np.asarray(proposal.sample((share,)).detach().numpy(), dtype=float)
            found = simulate(problem, prior, theta, jax.random.fold_in(noise_key, index), ledger)
            summaries = summarise(found.features)
            if scaling is None:
                _, target, kept = informative(summaries, observed)
                scaling = kept, summaries.mean(axis=0)[kept], summaries.std(axis=0)[kept]
                shown = torch.as_tensor(target, dtype=torch.float32)[None]
            kept, mean, spread = scaling
            x = torch.as_tensor((summaries[:, kept] - mean) / spread, dtype=torch.float32)
            given = torch.as_tensor(found.theta, dtype=torch.float32)
            trainer.append_simulations(given, x, proposal=proposal if index else None)
            atoms = {"num_atoms": config.atoms} if index else {}
            network = trainer.train(max_num_epochs=config.max_epochs, show_train_summary=False, **atoms)
            proposal = posterior = trainer.build_posterior(network).set_default_x(shown)
            trace.append({"round": index, "rollouts": ledger.rollouts})
            logbook.stage((index + 1) / rounds, method=name, **trace[-1])
        assert posterior is not None
        drawn = posterior.sample((config.draws,), x=shown, show_progress_bars=False)
    u = prior.unconstrained(np.asarray(drawn.detach().numpy(), dtype=float))
    draws = chains(problem, [u])
    return InferenceResult(
        method=name,
        draws=draws,
        trace=trace,
        **ledger.record(),
        cautions=[*prior_cautions(problem, draws), *exclusion_cautions(ledger.excluded, ledger.evaluations)],
        seconds=time.monotonic() - began,
        details={"simulations": int(share * rounds), "rounds": rounds},
    )


@contextmanager
def _apart(torch: Any, seed: int) -> Iterator[None]:
    """sbi on random numbers of its own, with the caller's as they were afterwards; without its progress, which would
    draw over ours, and its advice on priors. It takes no generator: torch's global one is lent to it."""
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings(), Path(os.devnull).open("w") as nothing:
        torch.manual_seed(seed)
        warnings.simplefilter("ignore")
        with redirect_stdout(nothing), redirect_stderr(nothing):
            yield


def _estimator(sbi: Any, config: Any, d: int) -> Any:
    if isinstance(config, BayesSimConfig):
        return sbi.neural_nets.posterior_nn(
            "mdn", hidden_features=config.hidden, num_components=config.components, z_score_x="none"
        )
    return sbi.neural_nets.posterior_nn(
        "maf", hidden_features=config.hidden, num_transforms=config.transforms or d, z_score_x="none"
    )


def run_udr(problem: Problem, config: UdrConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Random sub-ranges of the prior's central 99 %, as the paper's baseline of uniform randomisation has them."""
    began = time.monotonic()
    prior_key, range_key = jax.random.split(key)
    generator = host_generator(range_key)
    prior = {name: np.asarray(column) for name, column in problem.sample_prior(prior_key, 2000).items()}
    draws, ranges = {}, {}
    for name in problem.names:
        low, high = np.quantile(prior[name], [0.005, 0.995])
        start, end = sorted(generator.uniform(low, high, 2).tolist())
        draws[name] = generator.uniform(start, end, size=(1, config.draws))
        ranges[name] = [start, end]
    logbook.stage(1.0, method="udr")
    return InferenceResult(
        method="udr",
        draws=draws,
        trace=[{"rollouts": 0.0}],
        seconds=time.monotonic() - began,
        details={"ranges": ranges},
    )


def cross_correlation_summary(
    features: Float[np.ndarray, "n time f"], commands: Float[np.ndarray, "time a"]
) -> Float[np.ndarray, "n s"]:
    """BayesSim's: correlation of state changes with actions, and mean and deviation of the state changes.

    Ramos, Possas and Fox 2019, eq. 10: ``s = (<tau_s, tau_a>_ij, E[tau_s], Var[tau_s])`` with ``tau_s`` the state
    differences.
    """
    change = np.diff(features, axis=1)
    action = commands[: change.shape[1]]
    products = np.einsum("ntf,ta->nfa", change, action) / len(action)
    parts = (products.reshape(len(features), -1), change.mean(axis=1), change.std(axis=1))
    return np.concatenate(parts, axis=1)


def thinned_summary(features: Float[np.ndarray, "n time f"], most: int = 100) -> Float[np.ndarray, "n s"]:
    """NPDR's: the trajectory itself, every second row; rows are thinned further until at most ``most`` numbers remain.

    Of more features than ``most`` in a single row, as several recordings have, the last row is kept.
    """
    step = min(max(2, -(-features.shape[1] * features.shape[2] // most)), features.shape[1])
    return features[:, step - 1 :: step].reshape(len(features), -1)


def informative(
    summaries: Float[np.ndarray, "n s"], observed: Float[np.ndarray, " s"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, " k"], Bool[np.ndarray, " s"]]:
    """Summaries that vary, standardised; masked features are constant and would divide by zero."""
    spread = summaries.std(axis=0)
    kept = spread > 1e-9 * max(float(spread.max()), 1e-300)
    mean, spread = summaries.mean(axis=0)[kept], spread[kept]
    return (summaries[:, kept] - mean) / spread, (observed[kept] - mean) / spread, kept


METHODS["bayessim"] = Method(BayesSimConfig, run_bayessim)
METHODS["npdr"] = Method(NpdrConfig, run_npdr)
METHODS["udr"] = Method(UdrConfig, run_udr, posterior=False)
