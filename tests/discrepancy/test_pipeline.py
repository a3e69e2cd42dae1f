"""Whole audits of a simulator that is a formula. Seeds are fixed; each assertion on one data set fails for about one
seed in twenty or fewer, those on several as stated."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.lanes import Lanes, RoutedLanes
from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy import base_fit
from rfdropo_bayes.discrepancy import held_out as held_out_module
from rfdropo_bayes.discrepancy.audit_record import _doubt, differences, next_experiment, record
from rfdropo_bayes.discrepancy.base_fit import base_model, first_target
from rfdropo_bayes.discrepancy.candidates import lead, probe_all
from rfdropo_bayes.discrepancy.deadline import Deadline
from rfdropo_bayes.discrepancy.experiment_design import Hypothesis, at_hand, outlooks
from rfdropo_bayes.discrepancy.extension import Added, ExtensionSearch, Refits, Rules
from rfdropo_bayes.discrepancy.fit import optimise, polled
from rfdropo_bayes.discrepancy.gain import Difference, Gain
from rfdropo_bayes.discrepancy.held_out import Kept
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.measurements import gather_measurements
from rfdropo_bayes.discrepancy.naming import Named, without_each_other
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.discrepancy.repairs import optimised_again, simplified
from rfdropo_bayes.discrepancy.score_tests import p_in_words
from rfdropo_bayes.discrepancy.sentence import _adoption, _named
from rfdropo_bayes.discrepancy.verdict import decide
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.audit_figures import binned
from rfdropo_bayes.report.audit_page import class_effects, render_audit, shown
from rfdropo_bayes.report.page import p_value

from .toys import CANDIDATES, NOISE, ROWS, STEP, Faint, Stopped, Toy, problem, problem_of, recordings

TRUTH = {"gain": 1.3, "bend": -0.4}


@cache
def audited(truth: tuple, seed: int, without: tuple[str, ...]):
    """The audit of a data set, which several tests ask for, once."""
    return audit(problem({**TRUTH, **dict(truth)}, seed, without))


def found(truth: dict, seed: int, without: tuple[str, ...] = (), audited=audited):
    answer = audited(tuple(truth.items()), seed, without)
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert json.loads(json.dumps(content, allow_nan=False))["verdict"] == answer.verdict
    return content


def untimed(content: dict) -> dict:
    """What is the same in each run of an audit."""
    return {key: value for key, value in content.items() if key not in ("seconds", "profile")}


def test_a_lone_effect_is_explained_with_its_size():
    content = found({"play": 1.0}, 1)
    assert content["verdict"] == "explained"
    (finding,) = content["findings"]
    assert finding["equivalence_class"] == ["play"]
    size = finding["parameters"]["play"]
    assert abs(size["mean"] - 1.0) < 4 * size["sd"]
    low, _ = content["gain"]["explained_fraction_interval"]
    assert low > 0.8
    assert content["gain"]["elpd_difference"] > 5 * content["gain"]["elpd_difference_se"]
    assert content["noise_floor_mm"] == pytest.approx(1e3 * NOISE * np.sqrt(3), rel=0.1)
    assert "play" in content["sentence"]


@pytest.mark.slow
def test_an_effect_too_small_to_say_how_much_it_explains_is_named_and_not_belittled():
    content = found({"play": 0.04}, 12)
    assert content["findings"][0]["mechanism"] == "play"
    assert content["gain"]["explained_fraction"] < 0.2  # by chance: the interval goes from 0 to 100 %
    assert content["verdict"] == "unexplained"
    assert "do not determine the explained share of the discrepancy" in content["sentence"]


def test_effects_that_look_the_same_are_one_class():
    content = found({"delay": 1.0}, 2)
    assert content["verdict"] == "equivalent"
    assert sorted(content["findings"][0]["equivalence_class"]) == ["delay", "lag"]
    assert content["next_experiment"]["separates"] == content["findings"][0]["equivalence_class"]


@pytest.mark.slow
def test_a_shape_that_means_nothing_at_null_is_found_on_its_grid():
    content = found({"creep": 0.6, "creep_time": 0.6}, 3)
    assert content["findings"][0]["mechanism"] == "creep"
    time = content["findings"][0]["parameters"]["creep_time"]
    assert abs(time["mean"] - 0.6) < 4 * time["sd"]


def test_a_limit_that_only_rounding_shows_at_null_is_found_on_its_grid():
    asked = problem_of(Stopped(), {**TRUTH, "limit": 1.0}, 5)
    target, base = base_model(asked, asked.seed)
    search = ExtensionSearch(target, asked.candidates, asked.rules, asked.seed)
    assert search.score_tests(base).row("limit").adjusted_p <= asked.rules.level


def test_trial_values_of_large_families_without_visible_effect_stay_few():
    """Every combination of a family of eight would be 3^8 points."""
    asked = problem_of(Faint(), TRUTH, 5)
    target, base = base_model(asked, asked.seed)
    tried = [probe.candidate for probe in probe_all(target, base, asked.candidates)]
    assert 1 <= tried.count("faint") <= 3
    assert 1 <= tried.count("stepped") <= 3


@pytest.mark.slow
def test_a_small_effect_at_a_place_is_found_though_larger_ones_were_tried():
    content = found({"wall": 0.15, "wall_place": 0.4}, 6)
    assert content["findings"][0]["mechanism"] == "wall"
    place = content["findings"][0]["parameters"]["wall_place"]
    assert abs(place["mean"] - 0.4) < 4 * place["sd"]


def test_two_effects_are_both_named():
    content = found({"play": 1.0, "creep": 0.6, "creep_time": 0.6}, 4)
    assert {f["mechanism"] for f in content["findings"]} == {"play", "creep"}
    assert content["verdict"] == "explained"


def test_nothing_is_named_where_nothing_is_wrong():
    """Three null data sets, each called discrepant in 1 % of cases; the statistics are tested on hundreds."""
    assert [found({}, 100 + seed)["verdict"] for seed in range(3)] == ["no_discrepancy"] * 3


def test_a_cause_outside_the_library_is_not_called_explained_and_a_gain_is_invisible():
    content = found({"play": 1.0}, 200, without=("play",))
    assert content["verdict"] in ("unexplained", "partly_explained")
    row = next(c for c in content["candidates"] if c["mechanism"] == "imitable")
    assert not row["visible"]
    assert {c["mechanism"] for c in content["candidates"]} == set(CANDIDATES) - {"play"}


class Coarse(Toy):
    """An error of the audit's own simulator, which a finer one lacks: a share of the square of positions [1/m]."""

    def __init__(self, error: float) -> None:
        self.error = error

    def rollout(self, parameters, commands, steps=None):
        found = super().rollout(parameters, commands, steps)
        return found._replace(position=found.position * (1.0 + self.error * found.position))


LARGE, SMALL = 12.0, 3.0  # of which the first moves the markers by more than the noise, the second by a third of it


def on_a_coarse_mesh(asked, error=LARGE, left=0.0):
    """A problem whose simulator is coarse; the error ``left`` stays on the finer one."""
    finer = Lanes(Coarse(left), np.arange(4)) if left else asked.lanes
    commands = asked.model.recordings.commands
    return replace(asked, lanes=Lanes(Coarse(error), np.arange(4)), finer=(finer, commands))


@pytest.mark.slow
def test_what_an_error_of_the_mesh_hides_is_found_on_the_finer_one():
    """Once the finer simulator is the model, candidates are refitted, and recordings predicted, with it."""
    answer = audit(on_a_coarse_mesh(problem({**TRUTH, "play": 0.15}, 102)))
    assert [step.name for step in answer.steps] == ["discretisation", "play"]
    assert answer.verdict == "explained"
    assert answer.steps[1].fit_target.forward is answer.steps[0].fit_target.forward is not answer.target.forward
    index = answer.problem.coordinates.names.index("play")
    sizes = answer.problem.coordinates.values(answer.draws)[:, index]
    assert abs(sizes.mean() - 0.15) < 4 * sizes.std()


@pytest.mark.parametrize(("error", "level", "named"), [(LARGE, 0.02, ["discretisation"]), (SMALL, 0.0, [])])
def test_an_error_of_the_mesh_is_named_or_else_no_discrepancy(error, level, named):
    """Where nothing may be named, an error of the mesh is let pass."""
    asked = on_a_coarse_mesh(problem(TRUTH, 102), error)
    answer = audit(replace(asked, rules=replace(asked.rules, level=level)))
    assert [step.name for step in answer.steps] == named
    assert answer.verdict == ("explained" if named else "no_discrepancy")
    assert answer.test_series[0].refined is not bool(named)
    content = record(answer, versions={}, data_sha256="", next_experiment=None)
    if named:  # the finer simulator is the model now
        assert content["numerical_error_mm"] is None
        return
    assert "twice as fine" in content["sentence"]
    coarse = answer.target.forward.observe_one(answer.extended.x)["position"]
    moved = coarse - (np.sqrt(1.0 + 12.0 * coarse) - 1.0) / 6.0  # the finer position p solves p (1 + 3 p) = coarse
    assert content["numerical_error_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(moved**2, axis=-1))), rel=1e-4)


@pytest.mark.parametrize("left", [pytest.param(0.0, marks=pytest.mark.slow), SMALL / 2])
def test_an_error_of_the_mesh_below_the_noise_is_no_finding_however_sure_it_is(left):
    """Also where the finer simulator has half of the error itself, as with time steps of first order."""
    answer = audit(on_a_coarse_mesh(problem(TRUTH, 102), SMALL, left))
    assert answer.target.forward.correction
    assert answer.test_series[0].row("discretisation").adjusted_p > 0.02
    assert answer.steps == []
    assert answer.verdict == "no_discrepancy"
    content = record(answer, versions={}, data_sha256="", next_experiment=None)
    assert content["numerical_error_mm"] < content["noise_floor_mm"]
    assert "shorten [simulator] time_step" not in content["sentence"]
    assert "the findings are without it" in content["sentence"]


@pytest.mark.slow
def test_beside_an_error_of_the_mesh_below_the_noise_causes_are_named():
    """On unseen recordings the error is corrected as well: the cause explains all, and what remains is noise."""
    answer = audit(on_a_coarse_mesh(problem({**TRUTH, "play": 1.0}, 102), SMALL))
    assert [step.name for step in answer.steps] == ["play"]
    assert answer.target.forward.correction
    assert answer.verdict == "explained"
    assert answer.validation.gain.rmse_extended < 1.05 * answer.validation.gain.floor
    sizes = answer.problem.coordinates.values(answer.draws)[:, answer.problem.coordinates.names.index("play")]
    assert abs(sizes.mean() - 1.0) < 4 * sizes.std()


@pytest.mark.slow
def test_the_next_step_about_the_mesh_is_at_the_simulation():
    answer = audit(on_a_coarse_mesh(problem(TRUTH, 102)))
    words = next_experiment(answer)["sentence"]
    assert words.startswith("Refine the simulation: shorten [simulator] time_step")
    assert "robot" not in words


def test_the_same_seed_gives_the_same_audit():
    first, second = (found({}, 100, audited=each) for each in (audited, audited.__wrapped__))
    assert untimed(first) == untimed(second)


@pytest.mark.slow
def test_a_killed_audit_goes_on_where_it_was_and_says_the_same(tmp_path, monkeypatch):
    asked = problem({**TRUTH, "play": 1.0}, 1)

    def killed(line: str) -> None:
        if line.startswith("refit"):
            raise KeyboardInterrupt

    assert audit(asked, killed, Journal(tmp_path)).cost.stopped == "interrupt"
    assert list(tmp_path.glob("*.npz"))
    (tmp_path / "broken.npz").write_bytes(b"half of a file")
    lanes, calls = Lanes.roll, []
    monkeypatch.setattr(Lanes, "roll", lambda *given: calls.append(1) or lanes(*given))
    resumed = audit(asked, journal=Journal(tmp_path, resume=True))
    again, calls[:] = len(calls), []
    whole = audit(asked, journal=Journal(tmp_path / "other"))
    assert again < 0.9 * len(calls)
    # What the first part took counts: a resumed audit that looks nearly all up has a longer account than its own time.
    assert sum(resumed.cost.profile.values()) == resumed.cost.seconds
    assert {"base model", "screening", "joint test", "refits", "gain"} <= set(resumed.cost.profile)
    for path in set(tmp_path.glob("*.npz")) - {tmp_path / "broken.npz"}:
        with np.load(path) as kept:
            np.savez(path, **{**kept, **({"seconds": np.asarray(1e6)} if "seconds" in kept else {})})
    once_more = audit(asked, journal=Journal(tmp_path, resume=True))
    assert once_more.cost.seconds > 1e6
    first, second = (record(a, versions={}, data_sha256="", next_experiment=None) for a in (resumed, whole))
    assert untimed(first) == untimed(second)
    # Other data share nothing with what was kept; without resume, what was kept is gone.
    other = audit(problem({**TRUTH, "play": 1.0}, 2), journal=Journal(tmp_path, resume=True))
    assert other.base.log_evidence != whole.base.log_evidence
    Journal(tmp_path)
    assert not list(tmp_path.iterdir())


def test_commands_that_excite_only_one_of_two_effects_separate_them():
    """Hypotheses play (first cable) and delay (second): a recording that moves both separates, one at rest does not."""
    asked = problem({**TRUTH, "play": 1.0}, 1)
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(base)
    hypotheses = [Hypothesis(name, search.refit(base, tests.row(name))) for name in ("play", "delay")]
    like = asked.model.recordings.commands.of(0)
    still = like._replace(step=np.zeros_like(like.step))
    moving, resting = outlooks(target, base, hypotheses, [like, still])
    now = at_hand(target, hypotheses)[("play", "delay")]
    assert resting.separation == pytest.approx(now, rel=1e-6)
    assert moving.separation > now
    assert resting.information == pytest.approx(0.0, abs=1e-9)
    assert moving.information > 0.1


class Hurried(Deadline):
    """A deadline after a number of looks at the clock, each before a batch of rollouts."""

    def __init__(self, looks: int) -> None:
        super().__init__(minutes=1e9)
        self.looks = looks

    @property
    def remaining(self) -> float:
        return 1.0 if self.why or np.isinf(self.minutes) else float(self.looks)

    def check(self) -> None:
        self.looks -= 1
        super().check()


def stopped_at(beginning, stop):
    """The audit of play of ten times the size that is sure, stopped once it says a line that begins so."""
    clock = Hurried(10**9)
    asked = problem({**TRUTH, "play": 1.0}, 1)
    answer = audit(asked, lambda line: stop(clock) if line.startswith(beginning) else None, deadline=clock)
    return answer, record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))


def run_out(clock):
    clock.looks = 0


@pytest.mark.slow
def test_an_audit_whose_time_is_up_before_a_refit_says_which_candidates_stand_out():
    answer, content = stopped_at("joint test", run_out)
    assert (content["verdict"], content["out_of_time"], content["stopped"]) == ("no_verdict", True, "time")
    assert content["candidates"][0]["mechanism"] == "play"
    assert content["not_done"] == ["naming causes"]
    assert "significant: play" in content["sentence"]
    assert "Not done: naming causes" in content["sentence"]
    assert "Not done: naming causes" in render_audit(shown(answer), content, "", "")


def test_an_audit_whose_time_is_up_after_a_refit_has_its_cause_and_what_it_is_worth():
    _, content = stopped_at("refit with play", run_out)
    assert [finding["mechanism"] for finding in content["findings"]] == ["play"]
    assert content["gain"]["explained_fraction"] > 0.8
    assert content["verdict"] == "explained"
    assert content["adopted"] == ["play"]
    size = content["findings"][0]["parameters"]["play"]["mean"]
    assert content["optimum"]["play"][""] == pytest.approx(size, rel=0.02)  # where a calibration may start
    assert "the gain on unseen recordings" not in content["not_done"]
    assert "naming causes" not in content["not_done"]
    assert "The time was up" in content["sentence"]
    assert "--resume" in content["sentence"]


def interrupt(clock):
    if not clock.reached:
        raise KeyboardInterrupt


def test_ctrl_c_ends_an_audit_with_what_is_known():
    _, content = stopped_at("measuring the gain", interrupt)
    assert content["stopped"] == "interrupt"
    assert "The audit was stopped" in content["sentence"]
    assert [finding["mechanism"] for finding in content["findings"]] == ["play"]


@pytest.mark.slow
@pytest.mark.parametrize("start", [None, {"gain": 1.0, "bend": 0.0}])
def test_the_rollouts_that_are_announced_for_the_base_model_are_about_those_it_takes(start):
    lines: list[str] = []
    asked = replace(problem(TRUTH, 1), start=start)
    target, base = base_model(asked, 1, report=lines.append)
    assert asked.coordinates.named(base.x)["gain"] == pytest.approx(TRUTH["gain"], abs=0.02)
    (announced,) = [int(found[1]) for line in lines if (found := re.search(r"about (\d+) rollouts", line))]
    assert 0.5 < announced / target.forward.rollouts < 2.0


def test_the_pace_is_that_of_different_rollouts_that_fill_a_call():
    """A call of few is filled with copies, which a compiled engine simulates for nothing."""
    asked = problem(TRUTH, 1)
    forward = base_fit.first_target(asked, Journal()).forward
    null = forward.coordinates.null
    forward.observe(null[None])
    assert forward.pace == 0.0
    many = np.repeat(null[None], forward.lanes.width, axis=0)
    many[:, 0] += np.linspace(-0.1, 0.1, len(many))
    forward.observe(many, 3)
    assert forward.pace == 0.0  # of the first rows only
    forward.observe(many)
    assert forward.pace > 0.0


def test_a_base_model_without_the_time_for_its_fit_is_refused():
    asked = problem(TRUTH, 1)
    with pytest.raises(InputError, match=r"\[audit\] minutes: the time was up before the base model was fitted"):
        base_model(asked, asked.seed, deadline=Deadline(1e-6))


@pytest.mark.parametrize(
    "share", [pytest.param(0.0, marks=pytest.mark.slow), 0.5, pytest.param(0.95, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("stated", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_an_audit_without_the_time_for_a_base_fit_has_no_verdict_and_goes_on(tmp_path, share, stated):
    """The time is up at the start, in the search and in the last optimisation; with and without known noise."""
    asked = problem({**TRUTH, "play": 1.0}, 1)
    if not stated:
        asked = asked_of(asked, recordings({**TRUTH, "play": 1.0}, 1)[2:6], 2)
    clock = Hurried(10**9)
    base_model(asked, asked.seed, deadline=clock)
    clock = Hurried(int(share * (10**9 - clock.looks)))
    answer = audit(asked, journal=Journal(tmp_path), deadline=clock)
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert (content["verdict"], content["out_of_time"], content["findings"]) == ("no_verdict", True, [])
    assert not content["base_fit_converged"]
    assert "fit of the base model is not done" in content["sentence"]
    assert "--resume" in content["sentence"]
    assert "--resume" in content["next_experiment"]["sentence"]
    doubt = Caution(Code.RECORDING_DOUBTFUL, "run: markers change names")
    doubtful = record(answer, versions={}, data_sha256="", next_experiment=None, doubts=[doubt])
    assert doubtful["cautions"][0] == {"code": "recording_doubtful", "sentence": doubt.sentence, "grave": False}
    page = render_audit(shown(answer), doubtful, "", "")
    assert "<li>run: markers change names</li>" in page
    assert "no_verdict" in page.replace(" ", "_")
    assert ("No candidate was tested" in page) == (content["candidates"] == [])
    if stated and share > 0.5:
        resumed = audit(asked, journal=Journal(tmp_path, resume=True))
        assert resumed.verdict == "explained"


def test_rollouts_go_to_the_simulator_that_knows_their_candidates():
    class Without(Toy):
        parameters = tuple(s for s in Toy.parameters if s.name != "play")

    whole, fast = Lanes(Toy(), np.arange(4)), Lanes(Without(), np.arange(4))
    routed = RoutedLanes(fast, whole, {"play": 0.0})
    theta = np.tile([s.nominal for s in Toy.parameters], (4, 1))
    play = whole.physical.index("play")
    theta[:, 0] = 1.3
    theta[2, play] = 0.7
    commands, start = problem(TRUTH, 1).model.recordings.of(range(4)).commands, np.zeros((4, 7))
    slow = routed._needs_slow(theta)
    np.testing.assert_array_equal(slow, [False, False, True, False])
    (shown, status), (other, _) = (lanes.roll(theta, start, commands) for lanes in (routed, whole))
    assert list(status) == [0] * 4
    for name in shown:
        np.testing.assert_array_equal(shown[name], other[name])


@pytest.mark.parametrize("step", [1e-4, 0.03])
def test_differences_of_rollouts_are_the_derivatives(step):
    """To both sides, and at a bound to the side within; the motion is almost linear there."""
    forward = first_target(problem(TRUTH, 1), Journal()).forward.with_difference(step)
    points = np.repeat(forward.coordinates.encode(TRUTH)[None], 3, axis=0)
    points[2, 0] = forward.coordinates.bounds[1][0]
    directions = np.eye(points.shape[1])[[0, 1, 0]]
    found = forward.tangents(points, directions)["position"]
    own = forward.coordinates
    flat, start, commands = forward._per_lane(own.physical_values(points, forward.slots), points)
    along = own.physical_tangents(points, directions, forward.slots).reshape(flat.shape)

    def position(theta, start, commands):
        return forward.lanes._observe(theta, start, commands, commands.step.shape[0])[0]["position"]

    exact = jax.vmap(lambda t, d, *given: jax.jvp(lambda x: position(x, *given), (t,), (d,))[1])(
        flat, along, start, commands
    )
    exact = np.asarray(exact).reshape(found.shape)
    assert np.abs(exact).max(axis=(1, 2, 3)).min() > 0.0
    np.testing.assert_allclose(found, exact, atol=1e-4 * np.abs(exact).max())


def test_slopes_that_show_pass_over_a_kink():
    """Within a millionth of null the effect goes the other way, which no measurement shows."""

    class Kinked(Toy):
        def rollout(self, parameters, commands, steps=None):
            play = parameters["play"]
            return super().rollout({**parameters, "play": play - 2.0 * jnp.clip(play, -1e-6, 1e-6)}, commands, steps)

    asked = problem(TRUTH, 1)
    straight = first_target(asked, Journal())
    kinked = first_target(replace(asked, lanes=Lanes(Kinked(), np.arange(4)).with_difference(1e-7)), Journal())
    points = straight.forward.coordinates.encode(TRUTH)[None]
    direction = np.eye(points.shape[1])[[asked.coordinates.space.names.index("play")]]
    slope = straight.slopes(points, direction)[0]
    assert np.linalg.norm(slope) > 1.0
    np.testing.assert_allclose(kinked.slopes(points, direction)[0], -slope, atol=1e-6 * np.abs(slope).max())
    for target in (straight, kinked):
        found = target.visible_slopes(points, direction)
        np.testing.assert_allclose(found, slope, atol=1e-3 * np.abs(slope).max())


@pytest.mark.slow
def test_a_refit_finds_back_from_an_extrapolation_at_which_rollouts_fail(monkeypatch):
    """A large misfit makes the linear extrapolation a poor start; here no rollout ends well beyond a tenth of it."""

    class Brittle(Toy):
        def rollout(self, parameters, commands, steps=None):
            observed = super().rollout(parameters, commands, steps)
            return observed._replace(status=jnp.where(jnp.abs(parameters["play"]) > 4.0, 1, 0))

    asked = replace(problem({**TRUTH, "play": 1.0}, 1), lanes=Lanes(Brittle(), np.arange(4)))
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(base)
    index = asked.coordinates.space.names.index("play")
    far = base.x.copy()
    far[index] += 45.0
    monkeypatch.setattr(ExtensionSearch, "_lead", lambda *given: (1.0, far))
    fit = search.refit(base, tests.row("play"))
    assert fit.log_evidence > base.log_evidence + 10.0
    assert asked.coordinates.named(fit.x)["play"] == pytest.approx(1.0, abs=0.2)


class Turning(Toy):
    """A ``lag`` whose effect near null is another than that of a size that matters."""

    def rollout(self, parameters, commands, steps=None):
        values = {spec.name: jnp.asarray(spec.nominal) for spec in Toy.parameters} | dict(parameters)
        size = values["lag"]
        return super().rollout(values | {"lag": size**2, "play": values["play"] + 0.05 * size}, commands, steps)


@pytest.mark.slow
def test_a_large_effect_is_found_though_its_slope_at_null_points_elsewhere():
    asked = replace(problem({**TRUTH, "delay": 1.0}, 2), lanes=Lanes(Turning(), np.arange(4)))
    target, base = base_model(asked, 0)
    target = target.measured  # under whose noise so small a slope is seen
    base = optimise(target, base.x, base.free)
    tests = ExtensionSearch(target, asked.candidates, asked.rules, 0).score_tests(base)
    row = tests.row("lag")
    drop, start = lead(target, base, row.probe, row.lm)
    assert drop > 10.0 * row.lm
    assert drop > 0.8 * tests.row("delay").lm  # of which it can do the same at its size 1 or -1
    assert abs(start[asked.coordinates.space.names.index("lag")]) == pytest.approx(1.0, abs=0.35)


class Stopping(Toy):
    """A ``play`` that does nothing up to a threshold, and soon much beyond it, as a stop that cables seldom reach."""

    def rollout(self, parameters, commands, steps=None):
        values = {spec.name: jnp.asarray(spec.nominal) for spec in Toy.parameters} | dict(parameters)
        return super().rollout(values | {"play": 20.0 * jnp.maximum(values["play"] - 1.0, 0.0)}, commands, steps)


@pytest.mark.slow
def test_an_effect_is_found_between_a_point_that_does_nothing_and_one_that_does_far_too_much():
    asked = replace(problem({**TRUTH, "play": 0.4}, 2), lanes=Lanes(Stopping(), np.arange(4)))  # at 1.02 here
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(base)
    row = tests.row("play")
    drop, start = lead(target, base, row.probe, row.lm)
    index = asked.coordinates.space.names.index("play")
    assert start[index] == pytest.approx(1.02, abs=0.02)
    assert drop > 0.3 * row.lm
    assert asked.coordinates.named(search.refit(base, row).x)["play"] == pytest.approx(1.02, abs=0.003)


def test_a_candidate_that_brings_nearly_as_much_is_named_beside_the_best():
    """However little its signature is like that of the best: within three nats these data do not tell the two apart."""
    asked = problem({**TRUTH, "play": 1.0}, 1)
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, replace(asked.rules, level=1.0), 0)
    tests = search.score_tests(base)
    brings = {"play": 20.0, "creep": 18.0, "wall": 16.0}
    fits = {name: replace(base, log_evidence=base.log_evidence + nats) for name, nats in brings.items()}
    rows = tuple(tests.row(name) for name in brings)
    step = search.best(tests, Refits(rows, {row.name: row.lm for row in rows}, fits, ()), further=False)
    assert (step.name, step.members) == ("play", ("play", "creep"))


def test_a_rival_that_joins_the_model_later_is_no_rival_any_more():
    rest = {"before": None, "fit": None, "log_bayes_factor": 5.0, "refits": {}, "fit_target": None}
    steps = [Added("play", ("play", "creep", "wall"), **rest), Added("creep", ("creep", "lag"), **rest)]
    assert [step.members for step in without_each_other(steps)] == [("play", "wall"), ("creep", "lag")]
    asked = problem(TRUTH, 1)
    target, base = base_model(asked, 0)
    both = Named(ExtensionSearch(target, asked.candidates, asked.rules, 0), base, tuple(steps))
    first = Kept.of(both, both.extended(steps[:1]), None)
    assert (first.unsupported, first.named.steps[0].members) == (("creep",), ("play", "creep", "wall"))


def test_a_fit_with_better_points_beside_it_goes_on_from_them():
    asked = problem({**TRUTH, "play": 1.0}, 1)
    target, base = base_model(asked, 0)
    play = next(c for c in asked.candidates if c.name == "play")
    with_play = np.array([*base.free, *play.indices], dtype=int)
    early, whole = (optimise(target, base.x, with_play, **end) for end in ({"evaluations": 0}, {}))
    said = []
    first, *_, last = polled(target, early, "with play", said.append)
    assert first is early
    assert said[0].startswith("with play: sum of squares")
    assert last.converged
    assert last.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)


@pytest.mark.slow
def test_a_model_that_stopped_early_is_climbed_again_before_more_is_added_to_it():
    asked = problem({**TRUTH, "play": 1.0}, 1)
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(base)
    play, creep = (next(c for c in asked.candidates if c.name == name) for name in ("play", "creep"))
    with_play = np.array([*base.free, *play.indices], dtype=int)
    early = optimise(target, base.x, with_play, evaluations=0)
    whole = optimise(target, base.x, with_play)
    assert early.log_evidence < whole.log_evidence - 100.0  # what it is about
    both = optimise(target, whole.x, np.array([*with_play, *creep.indices], dtype=int))
    step = Added(
        "creep", ("creep",), replace(tests, fit=early), both, both.log_evidence - early.log_evidence, {}, target
    )
    again = optimised_again(search, step)
    assert again is not None
    assert again.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)
    assert optimised_again(search, replace(step, before=replace(tests, fit=whole))) is None


def test_repeats_whose_clocks_differ_are_not_joined_and_named():
    trajectories = recordings(TRUTH, 1)[:4]
    late = trajectories[1].dataset
    time = late["time"].values + 0.2 * STEP * (np.arange(ROWS) % 2)
    trajectories[1] = Trajectory(late.assign_coords(time=time))
    gathered = gather_recordings(Toy(), trajectories)
    channels = (Markers.gather(gathered, "repeats"),)
    measurements = gather_measurements(gathered, channels, trajectories)
    assert measurements.apart == ("r1",)
    assert measurements.members[0] == (0, 2)
    assert gather_measurements(gathered, channels).apart == ()


def unrepeated(truth: dict, seed: int):
    """Two recordings of different commands to fit, six to test."""
    trajectories = recordings({**TRUTH, **truth}, seed)
    single = [trajectories[index] for index in (0, 3, 4, 5, 6, 7, 8, 9)]
    asked = problem(TRUTH, seed)
    return asked_of(asked, single, 2)


def asked_of(asked, trajectories, fitted: int):
    """The same problem with other recordings."""
    gathered = gather_recordings(Toy(), trajectories)
    model = replace(asked.model, recordings=gathered, channels=(Markers.gather(gathered, "white"),))
    return replace(asked, model=model, trajectories=trajectories[:fitted])


@pytest.mark.slow
def test_without_repeats_the_noise_is_what_the_extended_model_leaves():
    """The noise is within 10 % (160 rows, 12 channels, half of them for memory: five standard errors), where the base
    model leaves several times as much."""
    asked = unrepeated({"play": 3.0}, 5)
    before, _ = base_model(asked, 0)
    assert np.mean(before.noise.scale) > 2.0 * NOISE
    answer = audit(asked)
    assert [step.name for step in answer.steps] == ["play"]
    assert answer.verdict == "explained"
    np.testing.assert_allclose(answer.target.noise.scale, NOISE, rtol=0.1)


@pytest.mark.parametrize(
    ("size", "play", "suspected"),
    [(1 / 3, 0.0, True), (1.0, 0.0, False), pytest.param(1.0, 3.0, False, marks=pytest.mark.slow)],
)
def test_a_stated_noise_that_is_too_small_is_suspected_and_a_right_one_is_not(size, play, suspected):
    stated = Stacked((Autoregression(np.full(12, size * NOISE), np.array([1.0, 0.6]), STATED, np.inf),))
    answer = audit(replace(unrepeated({"play": play}, 6), stated_noise=stated))
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert ("check [noise]" in content["sentence"]) == suspected
    if suspected:
        assert answer.verdict == "unexplained"
        np.testing.assert_allclose(content["noise"]["suspected_mm"], 1e3 * NOISE, rtol=0.1)
        assert "Repeat" in content["next_experiment"]["sentence"]


def test_where_nothing_is_wrong_a_stated_noise_is_not_suspected_however_low_the_passing_p():
    stated = Stacked((Autoregression(np.full(12, NOISE), np.array([1.0, 0.6]), STATED, np.inf),))
    asked = replace(unrepeated({}, 6), stated_noise=stated)
    strict = replace(asked, rules=replace(asked.rules, extended_passes=1.0))
    answer = audit(strict)
    assert answer.verdict == "no_discrepancy"
    assert answer.suspected is None


@pytest.mark.slow
def test_what_predicts_unseen_recordings_worse_is_named_and_not_adopted():
    """The test recordings have the effect with the other sign."""
    fitted = unrepeated({"delay": 1.0}, 7)
    single = [*fitted.trajectories, *recordings({**TRUTH, "delay": -1.0}, 7)[4:]]
    answer = audit(asked_of(fitted, single, 2))
    content = record(answer, versions={}, data_sha256="", next_experiment=None)
    assert answer.steps
    assert answer.adopted == []
    assert answer.verdict == "unexplained"
    assert "predicted worse" in content["sentence"]
    assert content["gain"]["rmse_extended_mm"] > content["gain"]["rmse_base_mm"]
    assert "extended.toml keeps the base model" in content["sentence"]


@pytest.mark.slow
def test_what_only_the_fitted_recordings_have_is_not_adopted_beside_what_all_have():
    """Play is in every recording, a delay in the fitted ones alone."""
    fitted = unrepeated({"play": 3.0, "delay": 0.3}, 7)
    single = [*fitted.trajectories, *recordings({**TRUTH, "play": 3.0}, 7)[4:]]
    answer = audit(asked_of(fitted, single, 2))
    content = record(answer, versions={}, data_sha256="", next_experiment=None)
    assert [step.name for step in answer.steps] == ["play"]
    assert [step.name for step in answer.adopted] == ["play"]
    assert content["unsupported"][0] in ("delay", "lag")
    assert "unseen recordings do not support: not adopted" in content["sentence"]
    assert len(content["omnibus"]) == 2
    assert content["gain"]["rmse_extended_mm"] < content["gain"]["rmse_base_mm"]


@pytest.mark.slow
def test_a_step_that_a_later_one_carries_is_not_adopted():
    """A search that named a useless step first, then play: only play is left, refitted, with the size that it has."""
    asked = unrepeated({"play": 3.0}, 7)
    target, base = base_model(asked, asked.seed)
    search = ExtensionSearch(target, asked.candidates, asked.rules, asked.seed)
    tests = search.score_tests(base)
    useless, play = (next(c for c in asked.candidates if c.name == name) for name in ("creep", "play"))
    first = optimise(target, base.x, np.array([*base.free, *useless.indices]))
    both = optimise(target, first.x, np.array([*first.free, *play.indices]))
    steps = [
        Added("creep", ("creep",), tests, first, 0.0, {}, target),
        Added("play", ("play",), tests, both, 9.0, {}, target),
    ]
    named = Named(search, base, tuple(steps), tests)
    held_out = held_out_module._predicted(asked, named)
    assert held_out.supported() == 2
    assert not held_out.gain(0, 1).clear
    kept, measured = held_out_module._without_carried(asked, named, held_out)
    assert kept.names == ["play"]
    assert set(kept.fit.free) == {*base.free, *play.indices}
    assert measured.gain(0, 1).clear
    # Where the first of the two is needed beside the second, both stay.
    swapped = [replace(steps[0], name="play", fit=optimise(target, base.x, np.array([*base.free, *play.indices])))]
    pair = [*swapped, replace(steps[1], name="creep")]
    always = replace(held_out, predictions=[held_out.predictions[k] for k in (0, 0, 2)])
    stayed, _ = held_out_module._without_carried(asked, named.extended(pair), always)
    assert stayed.names == ["play", "creep"]


@pytest.mark.slow
def test_a_step_that_a_later_one_makes_needless_is_taken_out():
    """A useless delay before play goes; play before a delay stays."""
    asked = unrepeated({"play": 3.0}, 7)
    target, base = base_model(asked, asked.seed)
    search = ExtensionSearch(target, asked.candidates, asked.rules, asked.seed)
    tests = search.score_tests(base)
    delay, play = (next(c for c in asked.candidates if c.name == name) for name in ("delay", "play"))
    order = {"delay": delay, "play": play}
    for first, second, left in (("delay", "play", ["play"]), ("play", "delay", ["play", "delay"])):
        one = optimise(target, base.x, np.array([*base.free, *order[first].indices]))
        both = optimise(target, one.x, np.array([*one.free, *order[second].indices]))
        beside = search.score_tests(one, [first])
        steps = [
            Added(first, (first,), tests, one, 1.0, {first: 1.0}, target),
            Added(second, (second,), beside, both, 1.0, {second: 2.0}, target),
        ]
        kept = simplified(search, base, steps)
        assert [step.name for step in kept] == left
        # The first step that is left stands on the base model.
        assert kept[0].before is tests
        assert kept[0].refits == {first: 1.0}
        assert set(kept[-1].fit.free) == {*base.free, *(index for name in left for index in order[name].indices)}
        assert kept[-1].fit.log_evidence >= both.log_evidence


def test_what_unseen_recordings_clearly_support_is_adopted_and_no_p_value_is_zero():
    content = found({"play": 1.0}, 1)
    assert content["adopted"] == ["play"]
    assert content["omnibus"][0]["p"] == 1 / (1 + content["bootstraps"])
    assert all(row["p"] > 0.0 for row in content["candidates"])
    assert min(content["where"]["block_p"]) > 0.0


def test_the_smallest_p_value_of_a_bootstrap_is_a_bound():
    assert p_in_words(1 / 200, 199) == "< 0.005"
    assert p_in_words(2 / 200, 199) == "= 0.01"
    assert p_value(1e-300) == "< 1e-16"
    assert p_value(0.012) == "0.012"


GAIN = Gain(2.0, 1.0, 50.0, 5.0, 0.02, {}, 0.5, (0.3, 0.7), 0.5, {"run": Difference(2.0, 1.0, 50.0)})
OPPOSED = {"a": Difference(2.0, 1.0, 54.0), "b": Difference(2.0, 2.1, -4.0)}
FOUR = {"a": Difference(2.0, 1.0, 18.0), "b": Difference(2.0, 1.0, 18.0), "c": Difference(2.0, 1.0, 18.0)} | {
    "d": Difference(2.0, 2.1, -4.3)
}


@pytest.mark.parametrize(
    ("changes", "worse", "clear"),
    [
        ({}, False, True),
        ({"rmse_extended": 2.1}, True, False),  # the error grows
        ({"interval": (-0.9, -0.1)}, True, False),
        ({"interval": (-0.1, 0.7)}, False, False),  # perhaps nothing
        ({"elpd_p": 0.06}, False, False),  # perhaps chance
        ({"elpd_difference": -1.0, "elpd_p": None}, False, False),
        ({"elpd_difference": 4.0, "elpd_p": None}, False, True),  # too few recordings to tell from chance
        ({"elpd_difference": 2.0, "elpd_p": None}, False, False),  # of few, a twentieth of a chance is allowed
        ({"elpd_p": None, "differences": OPPOSED}, False, False),  # one of these few speaks against it
        ({"elpd_p": None, "differences": FOUR}, False, True),  # of four, a right model loses 4.3 nats in one by chance
    ],
)
def test_a_verdict_agrees_with_the_errors(changes, worse, clear):
    gain = replace(GAIN, **changes)
    assert (gain.worse, gain.clear) == (worse, clear)
    verdict = decide(Rules(), 0.001, 0.5, [1], gain)
    assert (verdict == "unexplained") == worse
    if not clear:
        assert decide(Rules(), 0.001, 0.5, [1], replace(gain, explained=0.95)) not in ("explained", "equivalent")


@pytest.mark.parametrize("groups", [None, ((0,), (1,))])
def test_the_recording_that_speaks_against_an_extension_is_named(groups):
    """Groups are to be compared where they have not been."""
    gain = replace(GAIN, elpd_p=None, differences=OPPOSED)
    said = {"validation": SimpleNamespace(gain=gain), "unsupported": []}
    answer = SimpleNamespace(adopted=[], problem=SimpleNamespace(compared=groups), **said)
    assert _adoption(answer).startswith(" b is clearly less likely with this (2e+03 mm without, 2.1e+03 mm with it)")
    assert ("otherwise in b: compare groups of recordings with --between" in _doubt(answer)) == (groups is None)


def test_of_many_sizes_the_surest_are_said_in_their_order():
    means = enumerate((0, 5, -9, 1, 7, 6))
    sizes = {f"size_{k}": {"title": f"size_{k}", "mean": float(m), "sd": 1.0, "unit": "m"} for k, m in means}
    finding = {"mechanism": "glue", "group": "", "parameters": sizes, "relative": {}, "equivalence_class": ["glue"]}
    assert re.findall(r"size (\d)", _named(finding)) == ["1", "2", "4", "5"]


def test_of_a_mass_whose_ratio_to_the_modulus_is_seen_the_size_at_that_modulus_is_said():
    """A payload of 6 ± 2 g by itself, whose ratio to the modulus is known to 1 %."""
    load = {"title": "payload", "mean": 6e-3, "sd": 2e-3, "unit": "kg"}
    ratio = load | {"parameter": "payload", "power": 1, "young_modulus": 2e6, "mean": 3.1e-9, "sd": 3.1e-11}
    finding = {"mechanism": "load", "group": "", "parameters": {"payload": load}, "equivalence_class": ["load"]}
    assert _named(finding | {"relative": {"payload_over_young_modulus": ratio}}) == (
        "load (payload 0.0062 \u00b1 6.2e-05 kg for a Young's modulus of 2 MPa, as the data show the ratio)"
    )


@pytest.mark.parametrize("common", [0.07, 0.001])
def test_a_member_of_a_family_is_said_beside_the_others_if_only_that_is_known(common):
    """Gains of four cables beside a gain of all drives: the first is 12 % off the others to .3 %, and by itself to
    the deviation of what is common."""
    rng = np.random.default_rng(0)
    draws = np.array([-0.12, 0.0, 0.0, 0.0]) + 0.003 * rng.normal(size=(2000, 4)) + common * rng.normal(size=(2000, 1))
    specs = [SimpleNamespace(name=f"gain_{k}", unit="-") for k in range(4)]
    space = SimpleNamespace(parameters=[SimpleNamespace(spec=each) for each in specs])
    coordinates = SimpleNamespace(space=space, names=[each.name for each in specs], values=lambda points: points)
    found = differences(coordinates, draws, range(4))
    if common < 0.003:
        assert found == {}
        return
    assert found["gain_0_less_median"]["mean"] == pytest.approx(-0.12, abs=3e-3)
    assert found["gain_0_less_median"]["sd"] < 0.005
    assert differences(coordinates, draws, range(2)) == {}
    sizes = {s.name: {"title": s.name, "mean": -0.1, "sd": common, "unit": "-"} for s in specs}
    finding = {"mechanism": "gain", "group": "", "parameters": sizes, "relative": found, "equivalence_class": ["gain"]}
    assert _named(finding).startswith("gain (gain 0 less median -0.119 ")


def test_a_tie_with_the_same_mechanism_in_another_group_is_said():
    alike = ["glue@april", "slip@april", "glue@june", "glue"]
    finding = {"mechanism": "glue", "group": "april", "parameters": {}, "relative": {}, "equivalence_class": alike}
    assert "(indistinguishable from slip in april, glue in june, glue in these data)" in _named(finding)


def test_what_a_class_would_explain_is_shown_by_marker_and_by_recording():
    """As much of the sum of squares as the score statistic says, the same by rows, markers and recordings."""
    effect = class_effects(audited((("play", 1.0),), 1, ()))[0]
    assert effect.names == ("play",)
    (row,) = [each for each in found({"play": 1.0}, 1)["candidates"] if each["mechanism"] == "play"]
    assert effect.share == pytest.approx(row["would_explain"])
    assert set(effect.markers) == set(Toy.marker_names)
    assert all(after < 0.5 * before for before, after in effect.recordings.values())
    whole = np.mean([before for before, _ in effect.recordings.values()])  # all of which have as many rows
    assert np.mean(effect.before) == pytest.approx(whole)
    assert np.mean(effect.before) == pytest.approx(np.mean([before for before, _ in effect.markers.values()]))


def test_means_over_a_cause_are_those_of_its_values_or_of_as_many_rows():
    values = np.array([[1.0, 3.0, 5.0, 7.0]])
    centres, means = binned(np.array([-1.0, -1.0, 0.0, 1.0]), values)
    np.testing.assert_allclose(centres, [-1.0, 0.0, 1.0])
    np.testing.assert_allclose(means, [[2.0, 5.0, 7.0]])
    many = np.arange(600.0) ** 2
    centres, means = binned(many, many[None])
    assert len(centres) == 12
    np.testing.assert_allclose(means[0], centres)
