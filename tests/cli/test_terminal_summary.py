"""What is shown of a result in a terminal: text as it is, whatever brackets it holds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from rfdropo_bayes.cli.main import app
from rfdropo_bayes.cli.options import same_command
from rfdropo_bayes.cli.terminal_summary import show_audit, show_calibration
from rfdropo_bayes.inference.progress import Progress

WORDS = "raise [simulator] refine, [bold]never[/bold] [/] :warning: [model.groups]"
FOLDER = Path("runs [red] :bomb:")
ROW = {"mean": 1.0, "sd": 0.1, "q05": 0.9, "q95": 1.1, "unit": "[m]"}


def test_an_audit_is_shown_as_it_is(capsys):
    finding = {"mechanism": "play", "parameters": {"play@[red]": ROW}, "relative": {}}
    found = {"verdict": "explained", "sentence": WORDS, "findings": [finding], "next_experiment": {"sentence": WORDS}}
    cautions = [{"code": "recording_doubtful", "sentence": WORDS, "grave": False}]
    show_audit({**found, "adopted": ["play"], "cautions": cautions}, FOLDER, starts=True)
    shown = capsys.readouterr().out
    assert shown.count(WORDS) == 3
    assert shown.count(str(FOLDER)) == 4
    start = "--from 'runs [red] :bomb:'"
    assert f"then: rfdropo calibrate 'runs [red] :bomb:/extended.toml' {start} --out OUT" in shown
    assert "play@[red]" in shown


def test_a_calibration_is_shown_as_it_is(capsys):
    content = {
        "headline": [WORDS],
        "details": {},
        "parameters": {f"{k}@[red]": ROW for k in range(50)},
        "method": "adapt",
        "recordings": [{"split": "fit", "masked": 1, "positions": 2}],
    }
    caution = SimpleNamespace(sentence=WORDS, grave=True)
    found = SimpleNamespace(content=content, folder=FOLDER, verdict="safe", sentence="", cautions=[caution])
    show_calibration(found, Path("a.toml"))
    shown = capsys.readouterr().out
    assert shown.count(WORDS) == 2
    assert shown.count(str(FOLDER)) == 3  # the rest of the parameters, what to run next, the report
    assert "3@[red]" in shown


@pytest.mark.parametrize(
    ("verdict", "words"),
    [("safe", "predict fit --commands FILE --out OUT"), ("unsafe", "audit 'own arm.toml' --from fit --out OUT")],
)
def test_a_calibration_says_what_to_type_next(capsys, verdict, words):
    content = {"headline": [], "details": {}, "parameters": {"modulus": ROW}, "method": "laplace"}
    found = SimpleNamespace(content=content, folder=Path("fit"), verdict=verdict, sentence="", cautions=[])
    show_calibration(found, Path("own arm.toml"))
    assert f"\nnext: rfdropo {words}\n" in capsys.readouterr().out


def test_an_audit_that_adopts_nothing_has_no_model_to_fit(capsys):
    found = {"verdict": "unexplained", "sentence": "", "findings": [], "adopted": [], "cautions": []}
    show_audit({**found, "next_experiment": {"sentence": ""}}, FOLDER, starts=True)
    assert "then:" not in capsys.readouterr().out


def test_a_bar_shows_its_title_as_it_is(capsys):
    with Progress("[red] fit", show=True) as progress:
        progress.stage(0.5)
    assert "[red] fit" in capsys.readouterr().err


def test_a_prediction_says_what_it_does_before_it_has_done_it(tmp_path, monkeypatch):
    """What it says is no part of the result."""
    (tmp_path / "posterior.nc").touch()
    monkeypatch.setattr("rfdropo_bayes.cli.prediction_commands.see_calibration", lambda *_: None)
    monkeypatch.setattr("rfdropo_bayes.cli.prediction_commands.look_through", lambda *_: None)
    monkeypatch.setattr("rfdropo_bayes.cli.prediction_commands.show_prediction", lambda *_, **__: None)
    monkeypatch.setattr("rfdropo_bayes.model.model.Model.read", lambda *_: None)
    monkeypatch.setattr("rfdropo_bayes.results.calibrated.Calibration.of_posterior", lambda *_: None)
    monkeypatch.setattr("rfdropo_bayes.verbs.predict.predict", lambda *_, **__: SimpleNamespace(content={}))
    asked = ["predict", str(tmp_path), "--commands", "next.csv", "--out", str(tmp_path / "out")]
    spoken = CliRunner().invoke(app, asked)
    assert spoken.stderr == f"predicting next.csv with draws of {tmp_path}\n"
    assert spoken.stdout == ""


def test_the_command_that_goes_on_sets_a_key_once(monkeypatch):
    words = ["rfdropo", "audit", "arm.toml", "--set", "audit.minutes=14", "--set", "seed=2", "--overwrite"]
    monkeypatch.setattr("sys.argv", words)
    again = same_command("rfdropo", "--resume", "--set", "audit.minutes=28")
    assert again == "rfdropo audit arm.toml --set seed=2 --resume --set audit.minutes=28"
    assert same_command("rfdropo", "--resume") == "rfdropo audit arm.toml --set audit.minutes=14 --set seed=2 --resume"


def test_a_family_is_shown_by_what_the_data_determine(capsys):
    apart = {"gain_1_less_median": {**ROW, "power": 0, "parameter": "gain_1"}}
    finding = {"mechanism": "cable_gain", "parameters": {"gain_1": ROW}, "relative": apart}
    found = {"verdict": "explained", "sentence": "", "findings": [finding], "next_experiment": {"sentence": ""}}
    show_audit({**found, "adopted": [], "cautions": []}, FOLDER, starts=True)
    shown = capsys.readouterr().out
    assert "gain_1_less_median" in shown
    assert "gain_1 " not in shown
