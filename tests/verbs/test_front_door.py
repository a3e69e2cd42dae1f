"""``import rfdropo_bayes as rb``: light to import, and every call on objects in memory."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpyro.distributions as dist
import pytest
from matplotlib.figure import Figure

import rfdropo_bayes as rb
from rfdropo_bayes.data import DataSpec
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.method_options import attributes_of, settings_text
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.model.experiment import AuditTable, ModelTable
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.verbs.predict import fitted_scopes

REPOSITORY = Path(__file__).resolve().parents[2]
STEP = 0.02
SIGMA = 2e-4


def lag(parameters, command):
    """The tip follows gain * command with a time constant; many parameter sets at once."""
    gain, share = parameters["gain"][:, None], 1.0 - np.exp(-STEP / parameters["time_constant"])
    wanted = gain * command[:, :, 0]
    place = [wanted[:, 0]]
    for row in range(1, command.shape[1]):
        place.append(place[-1] + share * (wanted[:, row] - place[-1]))
    x = np.stack(place, axis=1)
    return np.stack([x, np.zeros_like(x), np.full_like(x, 0.1)], axis=-1)[:, :, None]


TRUTH = {"gain": 1.4, "time_constant": 0.25}
BOX = rb.BlackBox(
    lag,
    parameters={"gain": {"low": 0.2, "high": 3.0}, "time_constant": {"low": 0.05, "high": 1.0, "unit": "s"}},
    markers=["tip"],
    channels=["pull"],
    time_step=STEP,
    batched=True,
    name="lag",
)
WALK = {"duration": 2.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": STEP}


def test_the_import_is_light():
    """Under 0.2 s on an idle machine; here that no heavy library is loaded before it is used."""
    code = (
        "import sys; import rfdropo_bayes as rb; heavy = {'jax', 'numba', 'torch', 'numpy', 'pandas', 'scipy'}; "
        "assert not heavy & set(sys.modules), heavy & set(sys.modules); assert 'calibrate' in dir(rb)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)


def test_type_checkers_read_the_same_names():
    """From imports that are never run: the table of the names as Python has it stands beside them."""
    source = (REPOSITORY / "rfdropo_bayes" / "__init__.py").read_text()
    imports = re.findall(r"^    from rfdropo_bayes\.(\S+) import (\w+) as (\w+)$", source, re.MULTILINE)
    told = {name: module if known == name else f"{module}:{known}" for module, known, name in imports}
    assert told == rb._HOMES


def test_no_room_has_the_name_of_a_verb():
    """Else an import of the room would hide the verb."""
    rooms = {path.name for path in (REPOSITORY / "rfdropo_bayes").iterdir() if path.is_dir()}
    assert not rooms & set(rb.__all__)


@pytest.mark.slow
def test_a_wrong_call_is_refused_before_it_is_run(tmp_path):
    """mypy knows what the names are: what a call takes and what it gives."""
    calls = {
        "rb.calibrate(1, 2, bogus=3)": 'Unexpected keyword argument "bogus"',
        "rb.calibrate('trunk')": 'Argument 1 to "calibrate"',
        "rb.SMC(rollout=3)": 'Unexpected keyword argument "rollout"',
        "rb.calibrat(1)": 'Module has no attribute "calibrat"',
        "rb.audit(rb.Model('trunk_sofa')).sentense": 'has no attribute "sentense"',
        "rb.calibrate(rb.Model('trunk_sofa')).idata": "",
    }
    file = tmp_path / "calls.py"
    file.write_text("import rfdropo_bayes as rb\n" + "\n".join(calls))
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", str(file)]
    told = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False).stdout
    for line, message in enumerate(calls.values(), start=2):
        said = [each for each in told.splitlines() if each.startswith(f"{file}:{line}:")]
        assert bool(said) == bool(message), told
        assert not message or message in said[0] + said[-1]


def test_every_name_leads_somewhere():
    for name in rb.__all__:
        assert getattr(rb, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        rb.calibrat  # noqa: B018


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"priors": {"young_modulos": {}}}, "did you mean 'young_modulus'"),
        ({"priors": {"young_modulus": {"distribution": "LogNormall"}}}, "did you mean 'LogNormal'"),
        ({"priors": {"young_modulus": {"distribution": "LogNormal", "mediann": 3.0}}}, "did you mean 'median'"),
        ({"fixed": {"trunk_maß": 0.1}}, r"\[model.fixed\]: unknown parameter"),
        ({"per_recording": {"ofset": "all"}}, r"\[model.per_recording\]: unknown parameter 'ofset'"),
        ({"fixed": {"actuator_lag": 0.1}}, "add 'actuator_lag' to \\[model\\] mechanisms"),
    ],
)
def test_a_misspelt_parameter_or_prior_is_refused_where_it_is_written(wrong, said):
    with pytest.raises(rb.InputError, match=said):
        rb.Model("smooth_arm", **wrong)


def test_what_is_no_model_is_told_so():
    with pytest.raises(rb.InputError, match="did you mean 'noise'"):
        rb.Model("smooth_arm", noize="white")
    with pytest.raises(rb.InputError, match="Gamma cannot be a prior"):
        rb.Model("smooth_arm", priors={"young_modulus": dist.Gamma(1.0)})
    with pytest.raises(rb.InputError, match="dict is not a robot"):
        rb.Model({})
    with pytest.raises(rb.InputError, match="holds neither a calibration nor an audit"):
        rb.load(REPOSITORY / "docs")


REPORTS = sorted(path.parent for path in (REPOSITORY / "reports").rglob("posterior.nc"))


OF_REPORTS = pytest.mark.parametrize(
    "folder", [pytest.param(f, id=str(f.relative_to(REPOSITORY / "reports"))) for f in REPORTS]
)


@OF_REPORTS
def test_every_calibration_among_the_reports_has_a_model_of_its_parameters(folder):
    """An audit's answer that lies beside it changes nothing."""
    fit = rb.load(folder)
    assert isinstance(fit, rb.Calibration)
    assert set(fitted_scopes(fit).names) == {info.name for info in fit.record.free}


@pytest.mark.slow
@OF_REPORTS
def test_every_calibration_among_the_reports_predicts_commands(folder):
    fit = rb.load(folder)
    rest = np.zeros((3, len(fit.model.simulator.channel_names)))
    ahead = rb.predict(fit, (0.1 * np.arange(3), rest), draws=2)
    assert np.isfinite(ahead.bands["mean"]).all()


def test_a_robot_from_answers_goes_through_its_tables():
    robot = rb.Robot.outline(name="finger", length=0.12, radius=0.012, markers={"tip": 0.12}, mass=0.04)
    model = rb.Model(robot, priors={"young_modulus": {}})
    assert model.tables()["robot"] == "robot.toml"
    assert "finger" in model.texts()["robot.toml"]
    assert model.parameters.loc["young_modulus", "prior"]["distribution"] == "LogNormal"
    assert model.with_mechanisms("backlash").mechanisms == ("backlash",)
    assert repr(model.with_mechanisms("backlash")) == "<Model finger: mechanisms backlash; priors young_modulus>"


@pytest.fixture(scope="module")
def runs():
    names = {**WALK, "recordings": [f"run_{k}" for k in range(6)]}
    return rb.simulate(rb.Model(BOX), names, parameters=TRUTH, noise={"standard_deviation": SIGMA}, seed=1)


@pytest.fixture(scope="module")
def fit(runs, tmp_path_factory):
    model = rb.Model(BOX, noise="white", fixed={"observation_noise": SIGMA})
    out = tmp_path_factory.mktemp("fit") / "out"
    return rb.calibrate(model, runs[:2], rb.Laplace(draws=4000), test=runs[2:3], seed=0, show=False, out=out)


def grid_posterior(runs):
    """Means and standard deviations of gain and time constant by sums over a grid, with a simulation of its own."""
    gain, constant = np.meshgrid(np.linspace(1.38, 1.42, 81), np.linspace(0.24, 0.26, 81), indexing="ij")
    square = np.zeros(gain.shape)
    for run in runs:
        kept = np.exp(-STEP / constant)
        place = gain * run.initial_command[0]
        square += (run.position[0, 0, 0] - place) ** 2
        for row, level in enumerate(run.command_at(run.time[:-1])[:, 0]):
            place = kept * place + (1.0 - kept) * gain * level
            square += (run.position[row + 1, 0, 0] - place) ** 2
    weight = np.exp(-0.5 * (square - square.min()) / SIGMA**2)
    weight /= weight.sum()
    moments = {}
    for name, values in (("gain", gain), ("time_constant", constant)):
        mean = float(np.sum(weight * values))
        moments[name] = mean, float(np.sqrt(np.sum(weight * (values - mean) ** 2)))
    return moments


@pytest.mark.slow
def test_a_black_box_is_calibrated_as_the_grid_says(fit, runs):
    """Means within .1 and deviations within 8 % of those of the grid: 4000 draws have errors of .016 and 1.1 %."""
    for name, (mean, sd) in grid_posterior(runs[:2]).items():
        row = fit.summary.loc[name]
        assert abs(row["mean"] - mean) < 0.1 * sd
        assert row["sd"] == pytest.approx(sd, rel=0.08)
        assert abs(mean - TRUTH[name]) < 4.0 * sd
    assert fit.verdict in ("safe", "with care")
    assert fit.cautions == []


@pytest.mark.slow
def test_a_calibration_shows_itself_and_comes_back(fit, tmp_path):
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3)
    fit.plot_pair(ax=axes[0])
    fit.plot_prior_posterior("gain", ax=axes[1])
    fit.plot_fit("run_2", marker="tip", axis="x", ax=axes[2])
    for wrong, said in (({"marker": "tpi"}, "no marker 'tpi'; did you mean 'tip'"), ({"axis": "w"}, "no axis 'w'")):
        with pytest.raises(rb.InputError, match=said):
            fit.plot_fit("run_2", **wrong)
    with pytest.raises(rb.InputError, match="no recording 7"):
        fit.plot_fit(7)
    assert axes[2].get_ylabel() == "tip x [mm]"
    plt.close(figure)
    shown = fit._repr_html_()
    assert "gain" in shown
    assert "<img" in shown
    assert fit.report(tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")
    back = rb.load(fit.folder)
    np.testing.assert_array_equal(back.idata.posterior["gain"], fit.idata.posterior["gain"])
    with pytest.raises(InputError, match=r"has no model: .*'lag'.*rb.load\(folder, model=model\)"):
        fitted_scopes(back)  # no file describes a function
    back = rb.load(fit.folder, model=fit.model)
    assert set(fitted_scopes(back).names) == {"gain", "time_constant"}


@pytest.mark.slow
def test_commands_that_were_never_run_are_predicted(fit, runs):
    ahead = rb.predict(fit, runs[3], seed=0)
    inside = (ahead.bands["q05"] < runs[3].position) & (runs[3].position < ahead.bands["q95"])
    assert 0.8 < float(inside.sel(axis="x").mean()) < 0.97
    pair = rb.predict(fit, (runs[3].command_time, runs[3].command), start=runs[3].position[0], seed=0)
    assert set(pair.bands["marker"].values) == {"tip"}


@pytest.mark.slow
def test_an_audit_of_a_black_box_names_a_hidden_delay(runs):
    """A delay of the commands is found with its size, and mechanisms of a body are left out by name."""
    late = rb.Model(BOX, mechanisms=["command_delay"], fixed={"command_delay": 0.06})
    noise = {"standard_deviation": SIGMA}
    seen = rb.simulate(late, runs, parameters=TRUTH, noise=noise, seed=2)
    found = rb.audit(
        rb.Model(BOX, noise="white"), seen[:3], rb.AuditOptions(bootstraps=199), test=seen[3:], noise=noise, seed=0
    )
    assert found.verdict in ("explained", "equivalent")
    assert "payload" in found.content["left_out"]
    members = found.content["findings"][0]["equivalence_class"]
    assert "command_delay" in members
    assert "command_delay" in found.extended.mechanisms or len(members) > 1
    axes = Figure().add_subplot()
    assert found.plot_residual("rate", ax=axes) is axes
    assert axes.get_xlabel().startswith("rate of")
    assert len(found.plot_blocks(Figure().add_subplot()).patches) == len(found.shown.models)
    assert next(line.get_label() for line in found.plot_unseen("x", Figure().add_subplot()).lines) == "measured"
    with pytest.raises(InputError, match="did you mean 'rate'"):
        found.plot_residual("rates")
    with pytest.raises(InputError, match="has no data for figures"):
        replace(found, shown=None).plot_blocks()


def test_every_call_shows_the_keywords_that_it_takes():
    """Tab completion and help show what may be given; nothing hides behind ``**keys``."""
    hidden = []
    for name in rb.__all__:
        called = getattr(rb, name)
        if callable(called):
            entries = inspect.signature(called).parameters.values()
            hidden += [name for entry in entries if entry.kind is entry.VAR_KEYWORD]
    assert hidden == []


@pytest.mark.parametrize(
    ("called", "schema", "without"),
    [
        (rb.read, DataSpec, {"fit", "test"}),
        (rb.TrainingOptions, TrainingTable, set()),
        (rb.AuditOptions, AuditTable, set()),
        (rb.Model, ModelTable, set()),
    ],
)
def test_a_call_shows_the_keys_of_its_table(called, schema, without):
    shown, told = inspect.signature(called).parameters, inspect.getdoc(called) or ""
    keys = set(schema.model_fields) - without
    assert keys <= set(shown)
    if called is not rb.Model:  # whose docstring names the table
        assert [key for key in keys if not re.search(rf"^\s+{key}: \S|``{key}``", told, re.MULTILINE)] == []


def test_a_mistyped_key_names_the_nearest(tmp_path):
    with pytest.raises(InputError, match=r"unknown key 'resampel'.*did you mean 'resample'"):
        rb.read("run.csv", "csv", {}, folder=tmp_path, resampel=0.1)
    with pytest.raises(InputError, match=r"TrainingOptions: unknown key 'step_'.*did you mean 'step'"):
        rb.TrainingOptions(step_=3)
    with pytest.raises(InputError, match=r"AuditOptions: bootstraps = 3"):
        rb.AuditOptions(bootstraps=3)
    with pytest.raises(InputError, match=r"a dict is no TrainingOptions.*make them with rb.TrainingOptions"):
        rb.train(rb.Model("trunk_sofa"), tmp_path, {"steps": 3})


@pytest.mark.parametrize("name", sorted(method.config.called for method in METHODS.values()))
def test_the_options_of_a_method_say_what_they_are(name):
    """The first line is the call that makes them; a line for each option says its value and its meaning."""
    kind = getattr(rb, name)
    shown = repr(kind())
    assert shown.splitlines()[0] == kind().call == f"rb.{name}()"
    told = attributes_of(kind)
    for field in dataclasses.fields(kind):
        assert re.search(rf"^  {field.name} .*{re.escape(told[field.name].split()[0])}", shown, re.MULTILINE)
    changed = kind(draws=123)
    assert changed.call == f"rb.{name}(draws=123)"
    assert eval(changed.call) == changed


def test_checkpoints_know_options_by_their_fields():
    assert settings_text(rb.SMC(particles=50)).startswith("SmcConfig(rollouts=None, particles=50, ")
