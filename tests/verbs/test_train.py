"""``rfdropo train`` and ``rfdropo evaluate`` from experiment files, and what they refuse."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import rfdropo_bayes as rb
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.onnx_export import ExportedPolicy
from rfdropo_bayes.policies.policy_figures import curve_figure
from rfdropo_bayes.policies.randomisation import fitting
from rfdropo_bayes.policies.training import Trained
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.posteriors import FIXED, ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import EVALUATED_EPISODES, PEAK_TENSION, STOPPED_EPISODES, TENSION_LIMIT
from rfdropo_bayes.verbs.make_vec import randomisation_of, training_of, with_training
from rfdropo_bayes.verbs.train import _cautions, _summary, _tension_facts, training_sentence

REPOSITORY = Path(__file__).resolve().parents[2]
REACH = REPOSITORY / "experiments" / "reach_policy.toml"
COMMITTED = REPOSITORY / "models" / "policies" / "reach"
QUICK = [
    "training.steps=1792",  # more than the hundred actions of an episode in each environment
    "training.environments=16",
    "training.evaluate_every=1792",
    "training.evaluation_episodes=16",
]


SINGLE = {"precision": "float32"}
DOUBLE = ["simulator.precision=float64"]  # whose kernel the other tests compile as well
GOALS = [[0.0, 0.0, 0.25], [0.02, 0.02, 0.27]]


def rfdropo(*words: object) -> str:
    """Run a command that succeeds; return what it wrote on stderr."""
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stderr


@pytest.mark.slow
def test_an_arm_of_another_length_needs_goals_of_its_own() -> None:
    long = Robot.outline(name="long", length=0.3, radius=0.01, markers={"tip": 0.3})
    with pytest.raises(rb.InputError, match="a trunk of 195 mm, but long has 300 mm"):
        rb.make_vec("TrunkReach-v0", rb.Model(long), n=1)
    venv = rb.make_vec("TrunkReach-v0", rb.Model(long), n=1, options=rb.TrainingOptions(goals=GOALS))
    venv.reset()
    assert 0.25 <= venv.episodes.goal[0, 2] <= 0.27


def test_there_must_be_a_run_to_go_on_with(tmp_path) -> None:
    with pytest.raises(InputError, match=r"holds no run to go on with; correct --out"):
        rb.train(rb.Model.read(REACH), tmp_path, resume=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("task", ["TrunkReach-v0", "TrunkPush-v0"])
def test_a_policy_is_trained_exported_and_evaluated(tmp_path, task) -> None:
    settings = [part for entry in [*QUICK, f'training.task="{task}"'] for part in ("--set", entry)]
    steps = rfdropo("train", REACH, "--out", tmp_path / "policy", *settings).splitlines()[-3:]
    assert [step.split()[0] for step in steps] == ["the", "playing", "drawing"]
    assert {path.name for path in (tmp_path / "policy").iterdir()} >= {
        "policy.onnx", "card.md", "summary.json", "curve.png", "report.html", "episodes.jsonl", "config.toml",
        "run.json",
    }  # fmt: skip
    summary = json.loads((tmp_path / "policy" / "summary.json").read_text())
    assert (summary["status"], summary["task"]) == ("done", task)
    policy = ExportedPolicy(tmp_path / "policy" / "policy.onnx")
    assert policy.layout.task == task
    assert policy.facts["posterior_sha256"] == summary["posterior_sha256"]
    assert float(policy.facts[PEAK_TENSION]) == pytest.approx(summary["evaluation"]["tension_largest"], rel=1e-5)
    assert (policy.facts[STOPPED_EPISODES], policy.facts[EVALUATED_EPISODES]) == ("0", "16")
    assert "Cables pull at most" in (tmp_path / "policy" / "report.html").read_text()
    rfdropo("evaluate", REACH, "--policy", tmp_path / "policy", "--out", tmp_path / "test", "--episodes", 8, *settings)
    table = pd.read_csv(tmp_path / "test" / "episodes.csv")
    assert len(table) == 8
    assert table["distance"].gt(0.0).all()
    assert (tmp_path / "test" / "policy.gif").stat().st_size > 10_000


@pytest.mark.slow
def test_a_policy_is_trained_under_a_calibration_with_one_command(tmp_path) -> None:
    runs = rb.read("virtual/reach_1.nc", folder=REPOSITORY / "experiments")
    model = rb.Model("virtual_trunk", priors={"young_modulus": {}}, noise="white", simulator=SINGLE)
    rb.calibrate(
        model,
        runs,
        rb.Laplace(starts=1, prior_draws=4, max_steps=3, draws=16),
        seed=0,
        show=False,
        out=tmp_path / "fit",
    )
    settings = [part for entry in QUICK for part in ("--set", entry)]
    told = rfdropo("train", "--from", tmp_path / "fit", "--task", "reach", "--goal", "0.01,-0.03,0.13", *settings)
    summary = json.loads((tmp_path / "fit_train" / "summary.json").read_text())
    assert summary["randomisation"] == "posterior"
    assert summary["settings"]["goals"] == [[0.01, -0.03, 0.13]] * 2
    page = (tmp_path / "fit_train" / "report.html").read_text()
    assert "parameters of every episode: posterior" in page
    assert "young_<wbr>modulus" in page
    warned = (
        "fit is not safe to train on: its 90 % bands of the fit recordings hold only"  # of a virtual trunk's drives
    )
    assert told.count(warned) == page.count(warned) == 1
    assert [caution["code"] for caution in summary["cautions"]] == ["unsafe_posterior"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "the command needs an experiment file or --from DIR, not both"),
        ([REACH, "--task", "lift"], "use reach or push"),
        ([REACH, "--goal", "1,2"], "is not X,Y,Z"),
    ],
)
def test_what_a_training_cannot_take_is_said(words, told) -> None:
    result = CliRunner().invoke(app, ["train", *map(str, words)])
    assert result.exit_code != 0
    assert told in " ".join((result.output + str(result.exception)).split())


def summary_of(**best: float) -> dict:
    """That of a training whose only evaluation this was."""
    row = {"steps": 100, "seconds": 1.0, "reward": 1.0, "distance_q05": 0.001, "distance_median": 0.01} | best
    found = Trained(None, None, [row], 0, 1.0)
    return _summary(TrainingTable(tension_limit=5.0), found, ExportedPolicy(COMMITTED / "policy.onnx"), {})


def test_a_summary_is_json_where_episodes_have_no_end() -> None:
    summary = summary_of(distance_q95=np.inf)
    assert json.loads(json.dumps(summary, allow_nan=False))["evaluation"]["distance_q95"] is None
    assert summary["curve"][0]["distance_q95"] is None
    curve_figure(summary["curve"]).draw_without_rendering()
    assert summary["curve"][0]["distance_median"] == 0.01


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ((0.01, 0.02), "half of the episodes end within 10.00 mm of the goal, 95 % within 20.00 mm."),
        (
            (0.01, np.inf),
            "half of the episodes end within 10.00 mm of the goal; fewer than 95 % reach an end: 7 stopped by the "
            "limit on tension, 1 failed.",
        ),
        ((np.inf, np.inf), "fewer than half of the episodes reach an end: 7 stopped by the limit on tension, 1 failed"),
    ],
)
def test_what_was_learnt_does_not_take_a_few_stopped_episodes_for_most(ends, words) -> None:
    pull = {"tension_median": 1.0, "tension_largest": 6.0, "tension_stopped": 7}
    told = training_sentence(summary_of(distance_median=ends[0], distance_q95=ends[1], failed=1, **pull))
    assert told.startswith(words)
    assert told.endswith("the limit of 5 N stopped 7 of them.")


def test_a_deployment_is_told_of_the_limit_and_of_the_episodes_that_it_stopped() -> None:
    best = {"tension_largest": 6.0, "tension_stopped": 3}
    known = {PEAK_TENSION: "6", STOPPED_EPISODES: "3", EVALUATED_EPISODES: "64"}
    assert _tension_facts(best, TrainingTable()) == known
    assert _tension_facts(best, TrainingTable(tension_limit=5.0)) == known | {TENSION_LIMIT: "5"}


@pytest.mark.slow
def test_the_committed_policy_reaches_its_goals(tmp_path) -> None:
    """200 of 200 episodes ended within 5 mm. At 99 % a sample of 60 has fewer than 57 once in 300."""
    found = rb.evaluate(rb.Model.read(REACH), [COMMITTED], tmp_path, episodes=60, lanes=30, seed=5)
    row = found["policies"]["reach"]
    assert row["success_mm"]["5"]["share"] >= 57 / 60
    assert row["median_mm"] < 2.0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (['training.randomisation="posterior"'], "without a source"),
        (['training.randomisation="posterior"', 'training.source="nowhere"'], "nowhere"),
        (["training.ranges={}"], "no ranges"),
        (["training.ranges={young_modulus = [1.0, 2.0]}"], "outside its hard bounds"),
        (["training.options={learning_rat = 1e-3}"], "did you mean 'learning_rate'"),
        (["training.period=0.013"], "not a whole number of time steps"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path, overrides, words) -> None:
    with pytest.raises(InputError, match=words):
        rb.train(rb.Model.read(REACH, [*QUICK, *overrides]), tmp_path / "policy")


def test_an_experiment_without_training_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match=r"no table \[training\]"):
        rb.train(rb.Model.read(REPOSITORY / "experiments" / "sofa_reach_rod.toml"), tmp_path)


def test_an_experiment_without_training_is_evaluated_as_the_policy_was_trained(tmp_path) -> None:
    """The table of the policy's own run is read: its period, which is not the policy's here, is what is refused."""
    trained = tmp_path / "trained"
    trained.mkdir()
    shutil.copy(COMMITTED / "policy.onnx", trained)
    model = rb.Model.read(REPOSITORY / "experiments" / "sofa_reach_rod.toml")
    with pytest.raises(InputError, match=r"no table \[training\]"):
        rb.evaluate(model, [trained], tmp_path / "test", episodes=2)
    (trained / "config.toml").write_text('[training]\ntask = "TrunkReach-v0"\nperiod = 0.1\nsource = "nowhere"\n')
    with pytest.raises(InputError, match=r"period_s is 0\.05, here it is 0\.1"):
        rb.evaluate(model, [trained], tmp_path / "test", episodes=2)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ('training.task="TrunkPush-v0"', "task is TrunkReach-v0"),
        ("training.period=0.1", "period_s is 0.05, here it is 0.1"),
    ],
)
def test_a_policy_for_another_task_or_period_is_refused(tmp_path, override, words) -> None:
    with pytest.raises(InputError, match=f"the policy's {words}"):
        rb.evaluate(rb.Model.read(REACH, [override]), [COMMITTED], tmp_path / "test", episodes=2)


def test_the_model_in_memory_makes_environments() -> None:
    model = rb.Model("trunk_sofa", fixed={"young_modulus": 4e6})
    options = rb.TrainingOptions(observation="markers", start={"trunk_mass": [0.3, 0.4]})
    venv = rb.make_vec("TrunkReach-v0", model, options, n=3)
    venv.seed(0)
    assert venv.reset().shape == (3, 3 * 4 + 3 + 8 + 3 * 4)
    drawn = [info["parameters"] for info in venv.reset_infos]
    assert {values["young_modulus"] for values in drawn} == {4e6}
    assert len({values["trunk_mass"] for values in drawn}) == 3
    assert np.isfinite(venv.step(np.zeros((3, 8)))[1]).all()
    with pytest.raises(rb.InputError, match="TrunkReach-v0"):
        rb.make_vec("TrunkReech-v0", model)


def test_a_posterior_beside_another_randomisation_is_refused(tmp_path) -> None:
    """It would take the place of the ranges without a word."""
    model = rb.Model("trunk_sofa")
    ranges = rb.TrainingOptions(randomisation="uniform", ranges={"young_modulus": [4e6, 5e6]})
    with pytest.raises(InputError, match="a calibration was given, and randomisation = 'uniform'"):
        rb.make_vec("TrunkReach-v0", model, ranges, fit=tmp_path)
    with pytest.raises(InputError, match=r"posterior\.nc"):  # which is looked for where the two agree
        rb.make_vec("TrunkReach-v0", model, rb.TrainingOptions(randomisation="posterior"), fit=tmp_path)


@pytest.mark.slow
def test_same_seed_same_curve_from_python(tmp_path) -> None:
    """Bit for bit, policies included; another seed is another curve. Evaluations of twins agree, too."""
    model = rb.Model("trunk_sofa", simulator=SINGLE)
    options = {"steps": 1024, "environments": 16, "evaluate_every": 512, "evaluation_episodes": 4}
    ranges = {"randomisation": "uniform", "ranges": {"young_modulus": [4e6, 5e6]}}
    runs = {}
    for name, seed in (("first", 0), ("again", 0), ("other", 1)):
        curve = rb.train(model, tmp_path / name, rb.TrainingOptions(**options, **ranges), seed=seed)["curve"]
        runs[name] = [{key: value for key, value in row.items() if key != "seconds"} for row in curve]
    assert runs["first"] == runs["again"] != runs["other"]
    twins = [tmp_path / "first", tmp_path / "again"]
    drawn = rb.TrainingOptions(**ranges)
    found = rb.evaluate(model, twins, tmp_path / "test", drawn, episodes=4, film=False)["policies"]
    assert found["first"] == found["again"]
    assert (tmp_path / "test" / "episodes.csv").exists()


def test_policies_whose_folders_are_called_the_same_are_told_apart(tmp_path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day / "reach").mkdir(parents=True)
        (tmp_path / day / "reach" / "policy.onnx").write_bytes((COMMITTED / "policy.onnx").read_bytes())
    policies = [tmp_path / "monday" / "reach", tmp_path / "tuesday" / "reach" / "policy.onnx"]
    found = rb.evaluate(rb.Model.read(REACH, DOUBLE), policies, tmp_path / "test", episodes=2, lanes=2, film=False)
    assert set(found["policies"]) == {"monday_reach", "tuesday_reach"}
    with pytest.raises(InputError, match="given twice"):
        rb.evaluate(rb.Model.read(REACH), [COMMITTED, COMMITTED], tmp_path / "twice", episodes=2)


def held_at(name, value):
    return {"parameter": ParameterInfo(name, "-").as_dict(), "value": value}


def test_what_a_fit_held_is_held_in_the_episodes_too(tmp_path) -> None:
    """Its draws, or its phi, explain the data with these values, and not with nominal ones."""
    held = {"trunk_mass": 0.31, "observation_noise": 1e-3}
    modulus = ParameterInfo("young_modulus", "Pa", 1e4, 1e9, {}, "stiffness")
    record = PosteriorRecord(
        (modulus,), {"young_modulus": np.full((1, 3), 2e6)}, attrs={FIXED: [held_at(*each) for each in held.items()]}
    )
    record.save(tmp_path / "posterior.nc")
    normal = {"mean": 2e6, "std": 1e4, "low": 1.9e6, "high": 2.1e6, "unit": "Pa"}
    (tmp_path / "summary.json").write_text(json.dumps({"method": "rfdropo", "phi": {"young_modulus": normal}}))
    model = rb.Model("trunk_sofa", fixed={"poisson_ratio": 0.4})
    for kind in ("posterior", "phi"):
        asked = {"task": "TrunkReach-v0", "randomisation": kind, "source": str(tmp_path)}
        table, _, simulator = training_of(with_training(model, asked))
        for given in (None, tmp_path, Calibration(record, {}, "")) if kind == "posterior" else (None,):
            found = fitting(randomisation_of(table, model.spec, simulator, given), simulator.parameters)
            assert found.kind == kind
            drawn = found.draw(np.random.default_rng(0))
            assert drawn.pop("young_modulus") == pytest.approx(2e6, rel=0.05)
            assert drawn == {"trunk_mass": 0.31, "poisson_ratio": 0.4}


def test_time_stamps_of_recordings_do_not_show_a_policy_the_future(capsys) -> None:
    """An audit may find that the cameras' stamps come early: a session cannot start so, and training takes zero."""
    infos = (ParameterInfo("young_modulus", "Pa"), ParameterInfo("clock_offset", "s"))
    draws = {"young_modulus": np.full((1, 4), 2e6), "clock_offset": np.array([[-0.03, -0.01, -0.02, 0.02]])}
    fit = Calibration(PosteriorRecord(infos, draws), {}, "")
    model = rb.Model("trunk_sofa", mechanisms=["clock_offset"])
    table, _, simulator = training_of(with_training(model, {"task": "TrunkReach-v0"}))
    found = fitting(randomisation_of(table, model.spec, simulator, fit), simulator.parameters)
    assert found.share_changed("clock_offset") == pytest.approx(0.75, abs=0.05)
    rng = np.random.default_rng(0)
    assert {found.draw(rng)["clock_offset"] for _ in range(30)} == {0.0, 0.02}
    assert np.isfinite(rb.make_vec("TrunkReach-v0", model, fit=fit, n=2).reset()).all()
    (caution,) = _cautions(table, fit, Path(), found, True)
    assert caution.code == "recordings_only"
    assert "clock_offset is below 0 s in 7" in capsys.readouterr().err
    stated = rb.Model("trunk_sofa", mechanisms=["clock_offset"], fixed={"clock_offset": -0.03})
    with pytest.raises(InputError, match=r"clock_offset = -0\.03 s would show the future"):
        rb.make_vec("TrunkReach-v0", stated, n=2).reset()


@pytest.mark.parametrize("given", ["posterior", "uniform"])
def test_a_fixed_value_of_what_is_randomised_is_refused(given) -> None:
    """It would be left out without a word: an evaluation of another stiffness would be one of the posterior's."""
    modulus = ParameterInfo("young_modulus", "Pa", 1e4, 1e9, {}, "stiffness")
    fit = Calibration(PosteriorRecord((modulus,), {"young_modulus": np.full((1, 3), 2e6)}), {}, "")
    ranges = {"ranges": {"young_modulus": [1e6, 3e6]}} if given == "uniform" else {}
    model = rb.Model("trunk_sofa", fixed={"young_modulus": 4e6})
    table, _, simulator = training_of(with_training(model, {"task": "TrunkReach-v0", "randomisation": given, **ranges}))
    with pytest.raises(InputError, match=f"young_modulus is fixed, but randomisation = '{given}'"):
        randomisation_of(table, model.spec, simulator, fit if given == "posterior" else None)


def test_a_posterior_whose_law_the_simulator_lacks_is_refused(tmp_path) -> None:
    """A law is no mechanism of the library, and its effect would be left out without a word."""
    term = {"coefficient": "creep", "feature": "low_pass", "commands": ["own"], "shape": 0.3, "scale": 0.1}
    law = {"port": "every cable", "terms": [{**term, "shape_parameter": "creep_time"}]}
    names = ("young_modulus", "creep", "creep_time", "observation_noise", "cube_mass")
    draws = {name: np.full((1, 3), 0.4) for name in names} | {"young_modulus": np.full((1, 3), 2e6)}
    offset = ParameterInfo("offset_x", "m", scope=Scope("monday"))
    infos = (*(ParameterInfo(name, "-") for name in names), offset)
    record = PosteriorRecord(infos, {**draws, offset.name: np.zeros((1, 3))})
    record.save(tmp_path / "posterior.nc")
    normal = {"mean": 2e6, "std": 1e4, "low": 1.9e6, "high": 2.1e6, "unit": "Pa"}
    (tmp_path / "summary.json").write_text(json.dumps({"method": "rfdropo", "phi": {"young_modulus": normal}}))
    asked = {"task": "TrunkReach-v0"}
    plain = with_training(rb.Model("trunk_sofa"), asked)
    table, _, simulator = training_of(plain)
    for given in (tmp_path, Calibration(record, {}, "")):
        with pytest.raises(InputError, match="has creep, which the simulator lacks"):
            randomisation_of(table, plain.spec, simulator, given)
    stated = with_training(plain, {"randomisation": "phi", "source": str(tmp_path)}).settings.training
    with pytest.raises(InputError, match="has creep, which the simulator lacks"):
        randomisation_of(stated, plain.spec, simulator)
    whole = with_training(rb.Model("trunk_sofa", laws=[law]), asked)
    table, _, simulator = training_of(whole)
    assert "creep_time" in randomisation_of(table, whole.spec, simulator, tmp_path).names


def test_one_episode_is_an_evaluation_and_none_is_not(tmp_path) -> None:
    found = rb.evaluate(rb.Model.read(REACH, DOUBLE), [COMMITTED], tmp_path / "one", episodes=1, film=False)
    (policy,) = found["policies"].values()
    assert policy["interquartile_mean_mm"] == {"value": policy["median_mm"], "low": None, "high": None}
    pull = policy["peak_tension_n"]
    assert pull["largest"] == pull["median"] > 1.0
    assert pull["stopped"] == 0
    table = (tmp_path / "one" / "evaluation.md").read_text()
    assert f"| {pull['median']:.3g} | {pull['largest']:.3g} | 0 |" in table
    with pytest.raises(InputError, match="0 episodes show nothing"):
        rb.evaluate(rb.Model.read(REACH), [COMMITTED], tmp_path / "none", episodes=0)
