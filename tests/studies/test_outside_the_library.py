"""Effects that no mechanism of the library describes, put into recordings where nothing else is wrong: the audit must
not call them explained. Recordings are short, layers and steps coarse; seeds are fixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.verbs.audit import audit
from studies.hidden_effects import Setting, hide

SHOP: dict = {}
COARSE = {"refine": 1, "time_step": 0.01}
FULL = Setting()
SETTING = replace(
    FULL, commands=FULL.commands.model_copy(update={"duration": 2.5}), audited=COARSE, made={"refine": 2, **COARSE}
)

Change = Callable[[np.ndarray, Trajectory], np.ndarray]


def warped(position: np.ndarray, recording: Trajectory) -> np.ndarray:
    """A camera whose image is bent: points move along x and y with the product of where they are."""
    x, y, z = np.moveaxis(position, -1, 0)
    return np.stack([40.0 * x * y, 25.0 * x**2 - 8.0 * y * z, 0.0 * z], axis=-1)


def swaying(position: np.ndarray, recording: Trajectory) -> np.ndarray:
    """A periodic force across the arm, which starts with the recording: it sways at 1.7 Hz, the tip by 2 mm."""
    share = (position[:1, :, 2] / position[0, -1, 2]) ** 2
    wave = 2e-3 * np.sin(2 * np.pi * 1.7 * recording.time)[:, None]
    return np.stack([wave * share, 0.4 * wave * share, 0.0 * share * wave], axis=-1)


def change(folder: Path, what: Change) -> None:
    """Put an effect into all recordings of a data set."""
    for path in folder.glob("*.nc"):
        recording = Trajectory.load(path)
        position = recording.dataset["position"]
        moved = position.values + what(position.values, recording)
        dataset = recording.dataset.copy()
        dataset["position"] = position.copy(data=moved)
        Trajectory(dataset).save(path)


@pytest.mark.slow
@pytest.mark.parametrize("what", [warped, swaying])
def test_what_the_library_lacks_is_never_explained(tmp_path, what):
    found = hide(SETTING, [], 0.0, 11, tmp_path, workshop=SHOP)
    assert found is not None
    change(tmp_path, what)
    content = audit(Model.read(found.experiment), out=tmp_path / "audit", workshop=SHOP).content
    assert content["verdict"] in ("unexplained", "partly_explained"), content["sentence"]
