"""What is shown of a result in a terminal: text as it is, whatever brackets it holds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from rfdropo_bayes.cli.terminal_summary import show_audit, show_calibration
from rfdropo_bayes.inference.progress import Progress

WORDS = "raise [simulator] refine, [bold]never[/bold] [/] :warning: [model.groups]"
FOLDER = Path("runs [red] :bomb:")
ROW = {"mean": 1.0, "sd": 0.1, "q05": 0.9, "q95": 1.1, "unit": "[m]"}


def test_an_audit_is_shown_as_it_is(capsys):
    finding = {"mechanism": "play", "parameters": {"play@[red]": ROW}}
    found = {"verdict": "explained", "sentence": WORDS, "findings": [finding], "next_experiment": {"sentence": WORDS}}
    show_audit(found, FOLDER, quiet=False, as_json=False)
    shown = capsys.readouterr().out
    assert shown.count(WORDS) == 2
    assert shown.count(str(FOLDER)) == 2
    assert "play@[red]" in shown


def test_a_calibration_is_shown_as_it_is(capsys):
    content = {
        "headline": [WORDS],
        "details": {},
        "parameters": {f"{k}@[red]": ROW for k in range(30)},
        "method": "adapt",
        "recordings": [{"split": "fit", "masked": 1, "positions": 2}],
    }
    caution = SimpleNamespace(sentence=WORDS, grave=True)
    found = SimpleNamespace(content=content, folder=FOLDER, verdict="safe", sentence="", cautions=[caution])
    show_calibration(found, quiet=False, as_json=False)
    shown = capsys.readouterr().out
    assert shown.count(WORDS) == 2
    assert shown.count(str(FOLDER)) == 3  # the rest of the parameters, what to run next, the report
    assert "3@[red]" in shown


def test_a_bar_shows_its_title_as_it_is(capsys):
    with Progress("[red] fit", show=True) as progress:
        progress.stage(0.5)
    assert "[red] fit" in capsys.readouterr().err
