"""A training is warned of a posterior that its own record, or an audit of its recordings, speaks against."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.verbs.unsafe_posterior import posterior_caution

UNSAFE = {"verdict": "unsafe", "reasons": ["the best optimisation stopped", "second", "third", "fourth"]}
CAREFUL = {"verdict": "with care", "reasons": ["no recording was kept back to test it on"]}
MODEL = '[model]\nnoise = "white"\n'
TILTED = '[model]\nmechanisms = ["base_tilt"]\n'


def written(folder: Path, file: str, content: Any, config: str = MODEL) -> Path:
    """A folder of a run that holds a JSON file and its experiment."""
    folder.mkdir()
    (folder / file).write_text(json.dumps(content))
    (folder / "config.toml").write_text(config)
    return folder


def fit(folder: Path, judged: dict[str, Any] = CAREFUL) -> Path:
    return written(folder / "fit", "summary.json", {"randomisation": judged, "data_sha256": "a1"})


def test_a_calibration_that_its_own_record_calls_unsafe_is_warned_of_and_no_other(tmp_path) -> None:
    folder = fit(tmp_path, UNSAFE)
    found = posterior_caution(folder)
    assert found is not None
    assert found.code is Code.UNSAFE_POSTERIOR
    assert "the best optimisation stopped; second; third. " in found.sentence
    assert posterior_caution(folder / "posterior.nc") == found
    assert found.sentence.endswith("or draw wider with [training] width")
    assert str(posterior_caution(folder, 3.0)).count("Width 3 may make up") == 1
    memory = posterior_caution(Calibration(None, {"randomisation": UNSAFE}, ""))  # type: ignore[arg-type]
    assert memory is not None
    assert memory.sentence.startswith("the posterior is not safe to train on")


def test_a_calibration_without_a_grave_reason_is_not_warned_of(tmp_path) -> None:
    assert posterior_caution(fit(tmp_path)) is None
    assert posterior_caution(tmp_path / "nowhere") is None
    assert posterior_caution(Calibration(None, {"title": "one that says nothing"}, "")) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("verdict", "extended", "told"),
    [
        ("unexplained", MODEL, "leaves a discrepancy unexplained"),
        ("explained", TILTED, "names the effects that its model lacks, see"),
        ("partly_explained", TILTED, "names the effects that its model lacks, see"),
        ("described", '[model]\n[[model.laws]]\nport = "cable left"\n', "names the effects that its model lacks, see"),
        ("no_discrepancy", MODEL, None),
        ("no_verdict", MODEL, None),
    ],
)
def test_an_audit_of_the_same_recordings_is_heard(tmp_path, verdict, extended, told) -> None:
    folder = fit(tmp_path)
    audit = {"verdict": verdict, "data_sha256": "a1"}
    (written(tmp_path / "audited", "audit.json", audit, "[model]\n") / "extended.toml").write_text(extended)
    written(tmp_path / "of_others", "audit.json", {"verdict": "unexplained", "data_sha256": "b2"})
    found = posterior_caution(folder)
    assert (found is None) == (told is None)
    if found is not None:
        assert found.sentence.count(told) == 1
        assert "of_others" not in found.sentence


def test_a_model_that_has_what_an_audit_found_is_judged_by_what_is_left(tmp_path) -> None:
    """A part is unexplained, until an audit of this very model says that nothing is left; recordings may overlap."""
    folder = fit(tmp_path)
    (folder / "config.toml").write_text(TILTED)
    for name, verdict, config in (("a1", "partly_explained", MODEL), ("a2", "negligible", TILTED)):
        place = written(tmp_path / name, "audit.json", {"verdict": verdict, "data_sha256": name}, config)
        (place / "extended.toml").write_text(TILTED)
        (place / "run.json").write_text(json.dumps({"settings": {"data": {"one": "aa", name: name}}}))
        if name == "a1":
            assert posterior_caution(folder) is not None  # by the hash of all recordings
            (folder / "run.json").write_text(json.dumps({"settings": {"data": {"one": "aa"}}}))
            found = posterior_caution(folder)
            assert found is not None
            assert "a1 leaves a discrepancy unexplained" in found.sentence
            assert "names the effects that its model lacks" not in found.sentence
    assert posterior_caution(folder) is None


def test_a_damaged_audit_does_not_stop_a_training(tmp_path) -> None:
    folder = fit(tmp_path)
    (written(tmp_path / "audited", "audit.json", {}) / "audit.json").write_text("{")
    assert posterior_caution(folder) is None
