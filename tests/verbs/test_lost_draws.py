"""No draw of the demo's prior is lost: every step's constraints are solved, in both precisions."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from rfdropo_bayes.model.model import Model
from rfdropo_bayes.simulators.protocol import Result

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_every_draw_of_the_demos_prior_ends_well(precision) -> None:
    """Of 600 draws 43 were lost where single precision was asked for more than its rounding allows."""
    model = Model.read(DEMO, [f"simulator.precision={precision}"])
    problem = model.problem(model.recordings("fit"))
    drawn = problem.sample_prior(jax.random.key(3), 300)
    status = np.ravel(problem.observe({name: np.asarray(value) for name, value in drawn.items()}).status)
    assert np.all(status == int(Result.OK))
