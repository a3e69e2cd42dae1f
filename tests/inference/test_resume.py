"""A run that is killed and resumed ends with the draws of one that was not."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.progress import Progress

from .toys import Decay, Spring

KEY = jax.random.key(12)
OPTIONS = {
    "smc": {"particles": 40, "replicates": 2, "blocks": 2},
    "laplace": {"starts": 2, "blocks": 2, "draws": 50},
    "rfdropo": {"evaluations": 60, "rollouts_per_candidate": 10},
}
CASES = [
    *OPTIONS.items(),
    ("laplace", {"starts": 4, "pilot_particles": 50, "rollouts": 2000.0, "draws": 50}),
    ("rfdropo", {**OPTIONS["rfdropo"], "optimiser": "cem"}),
]


class Killed(Exception):
    """Stands for the kill."""


class Mortal(Progress):
    """Dies at a given stage, after its checkpoint was written."""

    def __init__(self, stages):
        super().__init__()
        self.left = stages

    def stage(self, share, **facts):
        self.left -= 1
        if self.left < 0:
            raise Killed


class Counting(Progress):
    """Counts stages."""

    count = 0

    def stage(self, share, **facts):
        self.count += 1


@functools.cache
def decay():
    """One problem for many runs, compiled once."""
    return Decay(n_rows=20)


def problem_for(method):
    return Spring() if method == "rfdropo" else decay()


def same(first, second):
    for name in first.draws:
        np.testing.assert_array_equal(first.draws[name], second.draws[name])
    assert first.rollouts == second.rollouts
    assert first.excluded == second.excluded
    np.testing.assert_equal(first.log_evidence, second.log_evidence)
    np.testing.assert_equal(first.trace, second.trace)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "options"), CASES)
def test_resumed_after_a_kill_at_any_stage(method, options, tmp_path):
    problem, counting = problem_for(method), Counting()
    whole = methods.run(problem, method, options, KEY, progress=counting)
    assert counting.count >= 3
    every = range(counting.count) if method == "smc" else (0, counting.count // 2, counting.count - 1)
    for stages in every:
        folder = tmp_path / str(stages)
        with pytest.raises(Killed):
            methods.run(problem, method, options, KEY, checkpoint_dir=folder, progress=Mortal(stages))
        resumed = methods.run(problem, method, options, KEY, checkpoint_dir=folder, resume=True)
        same(whole, resumed)


def test_a_finished_run_is_only_read(tmp_path):
    problem = Decay(n_rows=20)
    first = methods.run(problem, "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path)
    problem.row_log_likelihood = lambda values, horizon: pytest.fail("evaluated again")
    again = methods.run(problem, "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path, resume=True)
    same(first, again)


def test_a_kill_inside_a_stage_costs_that_stage_only(tmp_path):
    """The likelihood itself dies, in the middle of the moves."""

    class Fragile(Decay):
        calls = 0

        def row_log_likelihood(self, values, horizon):
            self.calls += 1
            if self.calls == self.dies_at:
                raise Killed
            return super().row_log_likelihood(values, horizon)

    problem = Fragile(n_rows=20)
    problem.dies_at = -1
    whole = methods.run(problem, "smc", OPTIONS["smc"], KEY)
    for dies_at in (2, problem.calls // 2, problem.calls - 1):
        problem.calls, problem.dies_at = 0, dies_at
        folder = tmp_path / str(dies_at)
        with pytest.raises(Killed):
            methods.run(problem, "smc", OPTIONS["smc"], KEY, checkpoint_dir=folder)
        problem.dies_at = -1
        same(whole, methods.run(problem, "smc", OPTIONS["smc"], KEY, checkpoint_dir=folder, resume=True))


SCRIPT = """
import json, sys, time
from pathlib import Path
import jax
sys.path.insert(0, sys.argv[1])
from toys import Decay, Spring
from rfdropo_bayes.inference import methods

class SlowDecay(Decay):
    def row_log_likelihood(self, values, horizon):
        time.sleep(0.05)
        return super().row_log_likelihood(values, horizon)

class SlowSpring(Spring):
    def rollouts(self, values, horizon):
        time.sleep(0.2)
        return super().rollouts(values, horizon)

problem = SlowSpring() if sys.argv[3] == "rfdropo" else SlowDecay(n_rows=20)
methods.run(problem, sys.argv[3], json.loads(sys.argv[4]), jax.random.key(12), checkpoint_dir=Path(sys.argv[2]))
"""


@pytest.mark.parametrize(
    ("method", "options", "begun"),
    [
        pytest.param("smc", OPTIONS["smc"], "smc_1", marks=pytest.mark.slow),
        pytest.param("rfdropo", OPTIONS["rfdropo"], "rfdropo", marks=pytest.mark.slow),
        pytest.param(*CASES[-1], "rfdropo", marks=pytest.mark.slow),
    ],
)
def test_sigkill_and_resume(method, options, begun, tmp_path):
    """Killed as soon as a checkpoint is there, without a chance to tidy up."""
    here = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": str(here.parents[1])}
    told = [str(here), str(tmp_path), method, json.dumps(options)]
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, *told], env=environment)
    try:
        deadline = time.monotonic() + 120.0
        while not (tmp_path / f"{begun}.npz").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        assert process.poll() is None, "the run ended before it could be killed"
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()
    problem = problem_for(method)
    whole = methods.run(problem, method, options, KEY)
    same(whole, methods.run(problem, method, options, KEY, checkpoint_dir=tmp_path, resume=True))


@pytest.mark.parametrize("change", ["options", "key", "data", "prior"])
def test_a_checkpoint_of_another_run_is_refused(change, tmp_path):
    problem = Decay(n_rows=20)
    problem.fingerprint = "first"
    methods.run(problem, "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path)
    options, key = dict(OPTIONS["smc"]), KEY
    if change == "options":
        options["particles"] = 50
    elif change == "key":
        key = jax.random.key(13)
    elif change == "data":
        problem.fingerprint = "second"
    else:
        problem.spread = problem.spread * 1.1
    with pytest.raises(InputError, match="belongs to a run with other data"):
        methods.run(problem, "smc", options, key, checkpoint_dir=tmp_path, resume=True)


@pytest.mark.parametrize("damage", ["truncated", "foreign", "empty"])
def test_a_damaged_checkpoint_is_refused(damage, tmp_path):
    methods.run(decay(), "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path)
    file = tmp_path / "smc_0.npz"
    if damage == "foreign":
        np.savez(file, x=np.ones(3))
    else:
        file.write_bytes(file.read_bytes()[: 400 if damage == "truncated" else 0])
    with pytest.raises(InputError, match="damaged"):
        methods.run(decay(), "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path, resume=True)


@pytest.mark.parametrize("part", ["pilot_run", "smc_optimisations"])
def test_a_damaged_checkpoint_of_optimisations_does_not_start_them_over(part, tmp_path):
    """They fall back to the prior, but only if no draw to start from has a likelihood."""
    (tmp_path / f"{part}.npz").write_bytes(b"")
    options = {"rollouts": 6000.0, "particles": 60, "start": "optimum"}
    with pytest.raises(InputError, match="damaged"):
        methods.run(decay(), "smc", options, KEY, checkpoint_dir=tmp_path, resume=True)


def test_without_resume_an_old_checkpoint_is_not_used(tmp_path):
    methods.run(decay(), "smc", OPTIONS["smc"], jax.random.key(1), checkpoint_dir=tmp_path)
    fresh = methods.run(decay(), "smc", OPTIONS["smc"], KEY, checkpoint_dir=tmp_path)
    same(fresh, methods.run(decay(), "smc", OPTIONS["smc"], KEY))


def test_the_log_has_a_line_per_stage_in_plain_json(tmp_path):
    log = tmp_path / "log.jsonl"
    with Progress("calibrate", log=log) as progress:
        result = methods.run(decay(), "smc", OPTIONS["smc"], KEY, progress=progress)
    lines = [json.loads(line, parse_constant=pytest.fail) for line in log.read_text().splitlines()]
    assert len(lines) == sum(1 for row in result.trace if not row.get("final"))
    assert {"time", "elapsed", "run", "horizon", "ess", "rollouts", "stage"} <= lines[0].keys()


@pytest.mark.parametrize("method", [pytest.param("laplace", marks=pytest.mark.slow), "smc"])
def test_exclusions_survive_a_checkpoint(method, tmp_path):
    """A part of the prior diverges: its count is saved and read back."""

    class PartlyDiverging(Decay):
        def row_log_likelihood(self, values, horizon):
            rows, _ = super().row_log_likelihood(values, horizon)
            return rows, np.where(np.asarray(values[self.names[0]]) > middle, 0, 1)

    middle = float(np.median(Decay(n_rows=20).sample_prior(KEY, 999)[Decay(n_rows=20).names[0]]))
    problem = PartlyDiverging(n_rows=20)
    problem.status_names = {1: "diverged"}
    whole = methods.run(problem, method, OPTIONS[method], KEY)
    assert whole.excluded["diverged"] > 0
    with pytest.raises(Killed):
        methods.run(problem, method, OPTIONS[method], KEY, checkpoint_dir=tmp_path, progress=Mortal(1))
    same(whole, methods.run(problem, method, OPTIONS[method], KEY, checkpoint_dir=tmp_path, resume=True))
