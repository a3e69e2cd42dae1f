"""What is doubtful of recordings is said of every answer that is made of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.faults import NOTES
from rfdropo_bayes.data.named_columns import UNTIMED
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction
from rfdropo_bayes.results.audited import Audit
from rfdropo_bayes.results.predicted import Prediction
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.recording_doubts import (
    cautions_after,
    cautions_of_fit,
    recorded_doubts,
    recording_cautions,
    with_doubts,
)

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo" / "demo_1.nc"
SWAPPED = "markers change names in row 30"


@pytest.fixture(scope="module")
def demo() -> Trajectory:
    return Trajectory.load(DEMO)


def noted(demo: Trajectory, name: str = "demo_1") -> Trajectory:
    """A recording in which two markers swapped names for some rows, as the reader notes it."""
    return demo.with_attributes(name=name, settings={NOTES: [SWAPPED]})


def empty_record(attrs: dict | None = None) -> PosteriorRecord:
    return PosteriorRecord((), {}, {}, (), attrs=attrs or {})


def predicted(demo: Trajectory, motion: np.ndarray, draws: int = 10) -> RecordingPrediction:
    """A fitted recording whose motion under the prior was ``motion``."""
    return RecordingPrediction(
        name=demo.name,
        split="fit",
        time=demo.time,
        marker_names=demo.marker_names,
        observed=demo.position,
        mask=demo.position_mask,
        predicted=np.repeat(motion[None], draws, axis=0),
        prior_predicted=np.repeat(motion[None], draws, axis=0),
    )


def test_what_the_reader_notes_is_a_caution_with_a_code_and_a_name(demo):
    (caution,) = recording_cautions(Robot.load("smooth_arm"), [noted(demo)])
    assert caution == Caution(Code.RECORDING_DOUBTFUL, f"demo_1: {SWAPPED}")
    assert recording_cautions(Robot.load("smooth_arm"), [demo]) == []


def test_a_fit_keeps_the_doubts_and_later_answers_say_them_once(demo):
    model = Model(Robot.load("smooth_arm"))
    (found,) = cautions_of_fit(model, [noted(demo)], [predicted(demo, demo.position)])
    fit = with_doubts(empty_record({"seed": 1}), [found])
    assert recorded_doubts(fit) == [found]
    assert fit.attrs["seed"] == 1
    assert cautions_after(fit, model, [noted(demo)]) == [found]
    other = cautions_after(fit, model, [noted(demo, "tuesday")])
    assert [caution.sentence.partition(":")[0] for caution in other] == ["demo_1", "tuesday"]


@pytest.mark.parametrize(
    ("turn", "factor", "code"),
    [
        (np.eye(3), 1.0, None),
        (np.diag([-1.0, -1.0, 1.0]), 1.0, Code.FRAME_DOUBTFUL),
        (np.eye(3), 0.1, Code.UNIT_DOUBTFUL),
    ],
)
def test_a_motion_unlike_that_under_the_prior_is_doubtful(demo, turn, factor, code):
    middle = demo.position.mean(axis=0)
    motion = middle + factor * (demo.position - middle) @ turn.T
    found = cautions_of_fit(Model(Robot.load("smooth_arm")), [demo], [predicted(demo, motion)])
    assert [caution.code for caution in found] == ([] if code is None else [code])
    assert cautions_of_fit(Model(Robot.load("smooth_arm")), [demo], [predicted(demo, motion, draws=3)]) == []


def test_an_answer_without_findings_still_shows_the_doubts(demo):
    """Of an audit and a prediction, in a terminal and in a notebook."""
    (caution,) = recording_cautions(Robot.load("smooth_arm"), [noted(demo)])
    content = {"verdict": "no_discrepancy", "sentence": "Nothing.", "findings": [], "cautions": [caution.as_dict()]}
    audit = Audit(content, {}, "", None, Path(), None, None)
    for shown in (repr(audit), audit._repr_html_()):
        assert f"demo_1: {SWAPPED}" in shown
    bands = SimpleNamespace(values=demo.time), SimpleNamespace(values=demo.marker_names)
    prediction = Prediction({"time": bands[0], "marker": bands[1]}, None, cautions=[caution])
    assert f"demo_1: {SWAPPED}" in repr(prediction)


@pytest.mark.parametrize(("pulled", "doubts"), [(0.0, 1), (0.01, 0)])
def test_a_first_row_far_away_is_doubted_unless_cables_were_pulled(pulled, doubts):
    robot = Robot.outline(name="arm", length=0.2, radius=0.01, markers={"tip": 0.2}, cables=1)
    bent = Trajectory.from_arrays(
        time=[0.0, 1.0],
        position=np.tile([0.15, 0.0, 0.1], (2, 1, 1)),
        markers=["tip"],
        channels=["pull_1"],
        command=[[pulled], [0.01]],
        initial_command="first",
    )
    found = recording_cautions(robot, [bent])
    assert sum("off the undeformed robot" in each.sentence for each in found) == doubts


@pytest.mark.parametrize(("apart", "doubts"), [(True, 0), (False, 1)])
def test_rows_without_times_are_doubted_unless_each_is_a_pose_of_its_own(apart, doubts):
    robot = Robot.outline(name="arm", length=0.2, radius=0.01, markers={"tip": 0.2}, cables=1)
    pulled = 0.01 * (np.random.default_rng(0).random(60) if apart else np.sin(np.linspace(0.0, 3.0, 60)) ** 2)
    still = 3e-4 * np.random.default_rng(1).normal(size=60)
    poses = Trajectory.from_arrays(
        time=np.arange(60.0),
        position=np.stack([pulled, still, 0.2 + still], axis=1)[:, None],
        markers=["tip"],
        channels=["pull_1"],
        command=pulled[:, None],
        command_time=np.arange(60.0) - 0.5,
        initial_command="first",
    ).with_attributes(name="poses", settings={NOTES: [UNTIMED]})
    assert len(recording_cautions(robot, [poses])) == doubts
