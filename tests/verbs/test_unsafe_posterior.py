"""A training is warned of a posterior that its own record, or an audit of its recordings, speaks against."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.verbs.unsafe_posterior import posterior_caution

UNSAFE = {"verdict": "unsafe", "reasons": ["the best climb stopped", "second", "third", "fourth"]}
CAREFUL = {"verdict": "with care", "reasons": ["no recording was kept back to test it on"]}
MODEL = '[model]\nnoise = "white"\n'


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
    assert "the best climb stopped; second; third. " in found.sentence
    assert posterior_caution(folder / "posterior.nc") == found
    memory = posterior_caution(Calibration(None, {"randomisation": UNSAFE}, ""))  # type: ignore[arg-type]
    assert memory is not None
    assert memory.sentence.startswith("the posterior is not safe to train on")


def test_a_calibration_without_a_grave_reason_is_not_warned_of(tmp_path) -> None:
    assert posterior_caution(fit(tmp_path)) is None
    assert posterior_caution(tmp_path / "nowhere") is None
    assert posterior_caution(Calibration(None, {"title": "one that says nothing"}, "")) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("verdict", "config", "told"),
    [
        ("unexplained", MODEL, "leaves a discrepancy unexplained"),
        ("partly_explained", '[model]\nnoise = "lasting"\n', "leaves a discrepancy unexplained"),
        ("explained", MODEL, "names what it lacks, see"),
        ("described", MODEL, "names what it lacks, see"),
        ("explained", '[model]\nnoise = "lasting"\n', None),  # what is calibrated is another model: the extended one
        ("no_discrepancy", MODEL, None),
        ("no_verdict", MODEL, None),
    ],
)
def test_an_audit_of_the_same_recordings_is_heard(tmp_path, verdict, config, told) -> None:
    folder = fit(tmp_path)
    audit = {"verdict": verdict, "data_sha256": "a1"}
    written(tmp_path / "audited", "audit.json", audit, config)
    written(tmp_path / "of_others", "audit.json", {"verdict": "unexplained", "data_sha256": "b2"})
    found = posterior_caution(folder)
    assert (found is None) == (told is None)
    if found is not None:
        assert found.sentence.count(told) == 1
        assert "of_others" not in found.sentence


def test_a_damaged_audit_does_not_stop_a_training(tmp_path) -> None:
    folder = fit(tmp_path)
    (written(tmp_path / "audited", "audit.json", {}) / "audit.json").write_text("{")
    assert posterior_caution(folder) is None
