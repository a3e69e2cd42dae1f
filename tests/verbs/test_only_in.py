"""A mechanism that one group of recordings has: it acts in new recordings of this group, and in no others."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY
from tests.verbs.toys import BOX, PRIORS, SIGMA, STEP

DELAY = 0.1
TRUTH = {"gain": 1.4, "time_constant": 0.25, "zero": 0.01}
WALK = {"duration": 2.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": STEP}
GROUPS = {"april": "april_*", "june": "june_*"}


def recorded(delays, seed):
    """A recording for each name, with its delay [s]."""
    model, noise = rb.Model(BOX, mechanisms=["command_delay"]), {"standard_deviation": SIGMA}
    runs = []
    for k, (name, delay) in enumerate(delays.items()):
        truth = TRUTH | {"command_delay": delay}
        runs += rb.simulate(model, WALK | {"recordings": [name]}, parameters=truth, noise=noise, seed=seed + k)
    return runs


def model_of(**more):
    described = {"noise": "white", "priors": PRIORS, "groups": GROUPS, "only_in": {"command_delay": ["april"]}}
    return rb.Model(BOX, mechanisms=["command_delay"], **(described | more))


@pytest.fixture(scope="module")
def runs():
    return recorded({"april_a": DELAY, "april_b": DELAY, "june_a": 0.0}, 0)


@pytest.fixture(scope="module")
def fit(runs, tmp_path_factory):
    """Read back from its folder, as a user does who predicts later."""
    out = tmp_path_factory.mktemp("fit") / "run"
    model = model_of(per_group={"zero": 0.02})
    unseen = recorded({"april_tested": DELAY, "june_tested": 0.0}, 20)
    rb.calibrate(model, runs, rb.Laplace(draws=100, starts=2, prior_draws=16), test=unseen, out=out, show=False)
    return rb.load(out, model=model)


def off(found, run):
    """How far the prediction of a recording is from the measured tip [m]."""
    error = found.bands["mean"].values[:, 0] - run.position[:, 0]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=-1))))


@pytest.mark.slow
def test_a_group_has_one_value_and_others_have_none(fit):
    names = [info.name for info in fit.record.free if info.name.startswith("command_delay")]
    assert names == ["command_delay@april"]
    assert fit.record.flat(names[0]).mean() == pytest.approx(DELAY, abs=0.003)
    for prediction in fit.record.recordings:
        error = np.linalg.norm(prediction.central - prediction.observed, axis=-1)
        assert error.max() < 6.0 * SIGMA, prediction.name


@pytest.mark.slow
def test_it_acts_in_a_new_recording_of_its_group_and_in_none_of_another(fit):
    april, june = recorded({"april_new": DELAY, "june_new": 0.0}, 30)
    for run in (april, june):
        assert off(rb.predict(fit, run), run) < 3.0 * SIGMA
    assert off(rb.predict(fit, june, group="april"), june) > 3.0 * off(rb.predict(fit, june), june)
    assert off(rb.predict(fit, april, group="june"), april) > 3.0 * off(rb.predict(fit, april), april)


@pytest.mark.slow
def test_a_group_that_no_fit_has_seen_is_without_and_a_caution_says_so(fit):
    (may,) = recorded({"may_new": 0.0}, 40)
    found = rb.predict(fit, may)
    said = [caution.sentence for caution in found.cautions if caution.code == Code.GROUP_WITHOUT]
    assert [
        "command_delay in april" in sentence and "may_new is predicted without" in sentence for sentence in said
    ] == [True]
    assert off(found, may) < 3.0 * SIGMA
    (june,) = recorded({"june_new": 0.0}, 30)
    assert not [c for c in rb.predict(fit, june).cautions if c.code == Code.GROUP_WITHOUT]


@pytest.mark.slow
def test_a_day_that_is_adapted_to_is_without(fit):
    (may,) = recorded({"may_new": 0.0}, 40)
    found = rb.adapt(fit, may, seconds=1.0, draws=30, show=False)
    assert [c.code for c in found.cautions].count(Code.GROUP_WITHOUT) == 1
    assert [name for name in found.record.posterior if name.startswith("command_delay")] == ["command_delay@april"]
    (april,) = recorded({"april_new": DELAY}, 30)
    back = rb.predict(found, april)
    assert back.group == "may_new"  # the folder is that day's, unless a group is named
    back = rb.predict(found, april, group="april")
    assert off(back, april) < 3.0 * SIGMA
    assert not [c for c in back.cautions if c.code == Code.GROUP_WITHOUT]
    assert found.content["details"]["checks"]["may_new"]["adapted"]["error_mm"] < 3e3 * SIGMA
    with pytest.raises(rb.InputError, match="belongs to april, which was fitted"):
        rb.adapt(fit, recorded({"april_new": DELAY}, 30)[0], show=False)


@pytest.mark.slow
def test_another_recording_of_a_fitted_group_keeps_the_value_of_the_group(runs):
    """Its zero is its own; the delay is that of its group, which 0.3 s do not show."""
    model = model_of(per_recording={"zero": "all"})
    fit = rb.calibrate(model, runs, rb.Laplace(draws=60, starts=1, prior_draws=16), show=False)
    (april,) = recorded({"april_new": DELAY}, 30)
    found = rb.adapt(fit, april, seconds=0.3, draws=30, show=False)
    np.testing.assert_allclose(found.record.flat("command_delay@april").mean(), DELAY, atol=0.003)
    assert found.content["details"]["moved"] == ["zero@april_new[0:15]"]
    (later,) = recorded({"april_later": DELAY}, 50)
    assert off(rb.predict(found, later), later) < 3.0 * SIGMA


@pytest.mark.slow
def test_the_file_that_an_audit_writes_is_calibrated_with_the_mechanism_in_its_group(runs, tmp_path):
    """What the audit finds in April alone: written, read back, calibrated, and predicted in April and in June."""
    base = rb.Model(BOX, noise="white", priors=PRIORS, groups=GROUPS)
    known = [*runs, *recorded({"june_b": 0.0}, 60)]
    others = [name for name in REGISTRY if name != "command_delay"]
    options, noise = rb.AuditOptions(exclude=others, ports=False, bootstraps=199), {"standard_deviation": SIGMA}
    unseen = recorded({"april_tested": DELAY, "june_tested": 0.0}, 20)
    rb.audit(base, known, options, test=unseen, noise=noise, out=tmp_path / "audit")
    tables = tomllib.loads((tmp_path / "audit" / "extended.toml").read_text())["model"]
    assert tables["only_in"] == {"command_delay": ["april"]}
    model = rb.Model(BOX, **tables)
    fit = rb.calibrate(model, known, rb.Laplace(draws=60, starts=1, prior_draws=16), show=False)
    names = [info.name for info in fit.record.free if info.name.startswith("command_delay")]
    assert names == ["command_delay@april"]
    assert fit.record.flat(names[0]).mean() == pytest.approx(DELAY, abs=0.003)
    for run in recorded({"april_new": DELAY, "june_new": 0.0}, 30):
        assert off(rb.predict(fit, run), run) < 3.0 * SIGMA


@pytest.mark.slow
def test_the_law_of_one_group_that_an_audit_writes_is_calibrated_and_predicted_there_alone(tmp_path):
    """The drive of April pulls further the further it has been told to, which no mechanism does."""
    excess = {"coefficient": "excess", "feature": "product", "commands": ["pull", "pull"], "scale": 20.0}
    bent = rb.Model(BOX, laws=[{"port": "cable pull", "terms": [excess]}])
    noise = {"standard_deviation": SIGMA}

    def shown(names, seed):
        made = []
        for k, name in enumerate(names):
            truth = TRUTH | {"excess": 15.0 if name.startswith("april") else 0.0}
            made += rb.simulate(bent, WALK | {"recordings": [name]}, parameters=truth, noise=noise, seed=seed + k)
        return made

    known = shown(["april_a", "april_b", "april_c", "june_a", "june_b", "june_c"], 0)
    unseen = shown(["april_t", "april_u", "june_t", "june_u"], 20)
    base = rb.Model(BOX, noise="white", priors=PRIORS, groups=GROUPS)
    options = rb.AuditOptions(library=False, bootstraps=199)
    found = rb.audit(base, known, options, test=unseen, noise=noise, out=tmp_path / "audit")
    assert (found.verdict, found.content["law"]["terms"][0]["group"]) == ("described", "april")
    tables = tomllib.loads((tmp_path / "audit" / "extended.toml").read_text())["model"]
    ((name, groups),) = tables["only_in"].items()
    assert groups == ["april"]
    fit = rb.calibrate(rb.Model(BOX, **tables), known, rb.Laplace(draws=60, starts=1, prior_draws=16), show=False)
    assert [info.name for info in fit.record.free if info.name.startswith("law")] == [f"{name}@april"]
    assert fit.record.flat(f"{name}@april").mean() == pytest.approx(15.0, abs=1.0)
    for run in shown(["april_new", "june_new"], 30):
        assert off(rb.predict(fit, run), run) < 3.0 * SIGMA


def test_a_fit_without_the_group_is_one_without_the_parameter(runs):
    problem = model_of().problem([run for run in runs if run.name.startswith("june")])
    assert set(problem.names) == {"gain", "time_constant", "zero", "observation_noise"}
    assert "command_delay@april" in model_of().problem(runs).names


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"only_in": {"command_delay": "apirl"}}, "unknown group 'apirl'.*april"),
        ({"only_in": {"command_dely": "april"}}, "command_dely"),
        ({"only_in": {"observation_noise": "april"}}, "unknown parameter 'observation_noise'"),
        ({"per_group": {"command_delay": 0.1}}, "command_delay is also in .model.per_group."),
        ({"per_recording": {"command_delay": "all"}}, "command_delay is also in .model.per_recording."),
        ({"fixed": {"command_delay": 0.1}}, "command_delay is also in .model.fixed."),
    ],
)
def test_what_contradicts_it_is_refused(runs, change, words):
    with pytest.raises(InputError, match=words):
        model_of(**change).problem(runs)
