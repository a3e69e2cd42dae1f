"""Targets that are drawn: a seed says all, every row sees the same recordings, unknown laws are as they say."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.policies.tasks import TASKS, layout_of
from studies import table2
from studies.fresh_laws import BOUC_WEN_WAY, LAWS, Crosstalk, HystereticCable, SlippingCable
from studies.fresh_targets import KINDS, RECORDINGS, draw_flaws, make_target
from studies.table2 import ROWS, Study, Table2Size


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    """Files of a target, by name."""
    return make_target("unknown", 0, tmp_path_factory.mktemp("target"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_draws_one_target(kind) -> None:
    assert draw_flaws(kind, 0) == draw_flaws(kind, 0)
    assert draw_flaws(kind, 0) != draw_flaws(kind, 3)
    assert draw_flaws(KINDS[0], 0)["mechanisms"] != draw_flaws(KINDS[1], 0)["mechanisms"]


def test_laws_of_the_trunk_act_on_four_cables_each() -> None:
    model = draw_flaws("unknown", 1, "push")
    assert model["mechanisms"] == ["studies.fresh_laws:HystereticCable"]
    assert len([name for name in model["fixed"] if name.startswith("fresh_")]) == 4


def test_a_seed_makes_the_same_files_and_recordings(target, tmp_path) -> None:
    again = make_target("unknown", 0, tmp_path)
    for name, path in target.items():
        assert path.read_text() == again[name].read_text()
    first, second = ([Trajectory.load(files["truth"].parent / f"{name}.nc") for name in RECORDINGS]
                     for files in (target, again))  # fmt: skip
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
    assert len({recording.command.tobytes() for recording in first}) == len(RECORDINGS)


def test_a_folder_keeps_its_target_if_the_seed_would_draw_another(target, tmp_path) -> None:
    for path in target.values():
        shutil.copy(path, tmp_path)
    make_target("unknown", 1, tmp_path)
    for path in target.values():
        assert (tmp_path / path.name).read_text() == path.read_text()
    assert all((tmp_path / f"{name}.nc").exists() for name in RECORDINGS)


def test_recordings_and_files_of_fits_do_not_tell_the_truth(target) -> None:
    drawn = set(read_tables(target["truth"])["model"]["fixed"])
    for name in RECORDINGS:
        attributes = str(Trajectory.load(target["truth"].parent / f"{name}.nc").dataset.attrs)
        assert not [each for each in drawn if each in attributes]
    for name in ("reach", "audit"):
        assert not {"fixed", "mechanisms"} & set(read_tables(target[name])["model"])


def test_a_target_in_mujoco_is_played_by_policies_of_our_body(tmp_path) -> None:
    """Its recordings have the robot's markers and channels, and a policy's observation and action are the model's."""
    pytest.importorskip("mujoco")
    files = make_target("mujoco", 0, tmp_path)
    truth, fitted = (Model.read(files[name]) for name in ("truth", "reach"))
    model = draw_flaws("mujoco", 0)
    assert len(model["mechanisms"]) == 2
    assert not set(model["mechanisms"]) & set(files["truth"].read_text().split('"'))
    first = fitted.recordings("fit")[0]
    assert np.ptp(first.position[:, -1], axis=0).max() > 0.01
    layouts = [layout_of(TASKS["TrunkReach-v0"], m.simulator.robot, "continuous", "full") for m in (truth, fitted)]
    assert layouts[0] == layouts[1]


def test_only_the_arm_that_reaches_is_made_in_mujoco() -> None:
    with pytest.raises(InputError, match="only the arm that reaches"):
        draw_flaws("mujoco", 0, "push")


def test_every_row_sees_the_same_six_recordings(target, tmp_path, monkeypatch) -> None:
    """Fits of all rows read six; the audit fits some of the six and measures the gain in the others."""
    seen: dict[str, list[str]] = {}

    def remember(model: Model, out: Path, resume: bool) -> None:
        out.mkdir(parents=True)
        seen[out.name] = [recording.name for recording in model.recordings("fit")]

    monkeypatch.setattr(table2, "calibrate", remember)
    monkeypatch.setattr(table2, "_with_causes", lambda study, tables: tables)
    study = Study({"reach": target["reach"]}, target["truth"], target["audit"], tmp_path, Table2Size())
    fitted = [row for row, chosen in ROWS.items() if chosen.method]
    for row in fitted:
        table2._fitted(study, "reach", row, None)
    assert len(seen) == len(fitted)
    assert all(names == list(RECORDINGS) for names in seen.values())
    data = read_tables(target["audit"])["data"]
    assert data["fit"] + data["test"] == [f"{name}.nc" for name in RECORDINGS]


@pytest.mark.parametrize("law", LAWS)
def test_a_law_of_no_size_changes_nothing_and_acts_on_its_cable_alone(law) -> None:
    made = law(("up", "left", "down"))
    sent = jnp.asarray(np.cumsum(np.random.default_rng(0).normal(0.0, 2e-3, (40, 3)), axis=0))
    none = {spec.name: jnp.zeros(()) for spec in made.parameters}
    start = jnp.zeros(3)
    np.testing.assert_array_equal(made.actuate(none, sent, start, 0.01), sent)
    some = none | {made.parameters[1].name: jnp.asarray(law.size.prior["scale"])}
    moved = np.asarray(made.actuate(some, sent, start, 0.01) - sent)
    assert np.abs(moved[:, 1]).max() > 1e-4
    assert not moved[:, [0, 2]].any()


def test_laws_are_what_they_say() -> None:
    """Closed forms, for a cable that is pulled by 10 mm in one step and held."""
    sent, start = jnp.full((200, 2), 0.01), jnp.zeros(2)

    def reached(law, size: float) -> np.ndarray:
        made = law(("a", "b"))
        values = {made.parameters[0].name: jnp.asarray(size), made.parameters[1].name: jnp.zeros(())}
        return np.asarray(made.actuate(values, sent, start, 0.01))[:, 0]

    np.testing.assert_allclose(reached(Crosstalk, 20.0), 0.01 + 20.0 * 1e-4)
    np.testing.assert_allclose(reached(SlippingCable, 0.1), 0.009)
    np.testing.assert_allclose(reached(HystereticCable, 1e-3), 0.01 - 1e-3)  # saturated: 10 mm is far over
    assert BOUC_WEN_WAY < 0.01


def test_an_unknown_scene_is_refused() -> None:
    with pytest.raises(InputError, match="unknown scene"):
        draw_flaws("unknown", 0, "fly")


def test_an_unknown_kind_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="unknown kind 'known'"):
        make_target("known", 0, tmp_path)
