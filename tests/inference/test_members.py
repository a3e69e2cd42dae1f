"""What a problem must have is checked before a method runs."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.bayes.problem import (
    Problem,
    ProblemDefaults,
    ResidualProblem,
    RolloutProblem,
    WarmStart,
    check_problem,
)
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods

from .toys import Decay, LinearGaussian, Spring

KEY = jax.random.key(0)
LEAST = ("names", "units", "bounds", "n_rows", "sample_prior", "log_prior", "row_log_likelihood")
OF_EVERY = (*LEAST, "to_unconstrained", "from_unconstrained")


def alone(problem, *further):
    """An object with members of a problem, and nothing of the defaults that it derives from."""
    bare = type("Bare", (), {})()
    for name in (*OF_EVERY, *further):
        setattr(bare, name, getattr(problem, name))
    return bare


@pytest.mark.parametrize(
    ("problem", "said"),
    [
        (alone(LinearGaussian()), r"Bare lacks fingerprint, prior_ends, status_names; .*define the members of Problem"),
        (
            alone(LinearGaussian(), "fingerprint", "prior_ends", "status_names", "residuals"),
            r"Bare has 'residuals' but lacks physical_names, prior_derivatives; .*ResidualProblem",
        ),
        (
            alone(Spring(), "fingerprint", "prior_ends", "status_names", "rollouts", "physical_names", "observed"),
            r"Bare has 'rollouts' but lacks noise_deviation, observed_mask; .*RolloutProblem",
        ),
    ],
)
def test_a_problem_that_lacks_a_member_is_refused_by_name(problem, said):
    """And not taken for one that can do less."""
    with pytest.raises(InputError, match=said):
        check_problem(problem)


def test_a_method_looks_through_its_problem_first():
    problem = alone(LinearGaussian(), "fingerprint", "prior_ends", "status_names", "residuals")
    with pytest.raises(InputError, match="has 'residuals' but lacks"):
        methods.run(problem, "smc", {}, KEY)


def test_what_has_the_defaults_lacks_nothing():
    for problem in (LinearGaussian(), Decay(), Spring()):
        check_problem(problem)
        assert isinstance(problem, Problem)
        assert not isinstance(problem, WarmStart)
    assert isinstance(LinearGaussian(), ResidualProblem)
    assert not isinstance(LinearGaussian(), RolloutProblem)
    assert isinstance(Spring(), RolloutProblem)
    assert not isinstance(Spring(), ResidualProblem)


def test_derivatives_of_the_prior_are_those_of_its_density():
    problem, u = LinearGaussian(), np.array([0.3, -1.0, 2.0])
    gradient, hessian = ProblemDefaults.prior_derivatives.func(problem)
    np.testing.assert_allclose(gradient(u), (problem.mean - u) / problem.sd**2, rtol=1e-5)
    np.testing.assert_allclose(hessian(u), -np.diag(problem.sd**-2.0), rtol=1e-5, atol=1e-12)
