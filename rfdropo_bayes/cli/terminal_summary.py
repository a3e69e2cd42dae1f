"""Result of a calibration or an audit on the terminal: the verdict, a table of parameters, the path of the report."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rfdropo_bayes.results.calibrated import Calibration

GOOD, FAIR, BAD = "green", "yellow", "red"
COLOURS = {
    "safe": GOOD,
    "with care": FAIR,
    "unsafe": BAD,
    "no_discrepancy": GOOD,
    "no_verdict": FAIR,
    "explained": GOOD,
    "equivalent": FAIR,
    "partly_explained": FAIR,
    "unexplained": BAD,
}
MOST_ROWS = 40


def show_calibration(calibration: Calibration, experiment: Path | None = None) -> None:
    """Print the result of a finished calibration: headline, table of parameters, cautions, next command, and path of
    the report. The next command is an audit of ``experiment`` if there are cautions.
    """
    summary, folder = calibration.content, calibration.folder or Path()
    report = folder / "report.html"
    console = _console()
    for sentence in summary["headline"]:
        style = COLOURS[calibration.verdict] if sentence == calibration.sentence else ""
        console.print(Text(sentence, style=style), soft_wrap=True)
    moved = summary["details"].get("moved", [])  # by an adaptation: its main result
    rows = [(name, row, "derived" if row.get("derived") else "") for name, row in summary["parameters"].items()]
    rows.sort(key=lambda row: row[0] not in moved)
    console.print(_parameters(rows[:MOST_ROWS]))
    if len(rows) > MOST_ROWS:
        console.print(f"and {len(rows) - MOST_ROWS} more in {folder / 'summary.json'}", soft_wrap=True)
    for caution in calibration.cautions:
        console.print(Text(f"caution: {caution.sentence}", style=BAD if caution.grave else FAIR), soft_wrap=True)
    if summary["method"] == "adapt":
        seen = next(run for run in summary["recordings"] if run["split"] == "fit")
        if seen["masked"]:
            console.print(f"left out: {seen['masked']} of {seen['positions']} positions", soft_wrap=True)
        for sentence in summary["details"].get("compared", ()):
            console.print(sentence, soft_wrap=True)
    ready = experiment is None or (calibration.verdict == "safe" and not calibration.cautions)
    words = (
        ["predict", str(folder), "--commands", "FILE"] if ready else ["audit", str(experiment), "--from", str(folder)]
    )
    console.print(f"next: {shlex.join(['rfdropo', *words, '--out', 'OUT'])}", soft_wrap=True)
    console.print(f"report: {report}", soft_wrap=True)


def show_audit(content: Mapping[str, Any], folder: Path, *, starts: bool) -> None:
    """Print the result of an audit: ``content`` of audit.json. With ``starts`` the calibration that is proposed starts
    from it.
    """
    from rfdropo_bayes.report.sentences import sentences

    console = _console()
    verdict = Text(content["verdict"], style=f"bold {COLOURS.get(content['verdict'], '')}")
    first, *further = sentences(content["sentence"])
    console.print(verdict + Text(f": {first}", style="not bold"), soft_wrap=True)
    for sentence in further:
        console.print(Text(sentence), soft_wrap=True)
    for caution in content["cautions"]:
        console.print(Text(f"caution: {caution['sentence']}", style=FAIR), soft_wrap=True)
    rows = [
        (name, row, finding["mechanism"].replace("_", " "))
        for finding in content["findings"]
        for name, row in (_differences(finding) or finding["parameters"]).items()
    ]
    if rows:
        console.print(_parameters(rows[:MOST_ROWS]))
    console.print(f"next: {content['next_experiment']['sentence']}", soft_wrap=True)
    if content["adopted"]:
        start = ["--from", str(folder)] if starts else []
        again = shlex.join(["rfdropo", "calibrate", str(folder / "extended.toml"), *start, "--out", "OUT"])
        console.print(f"then: {again}", soft_wrap=True)
    console.print(f"report: {folder / 'report.html'}; extended model: {folder / 'extended.toml'}", soft_wrap=True)


def _differences(finding: Mapping[str, Any]) -> dict[str, Any]:
    """Members of a family less their median, if the data determine only these."""
    return {name: row for name, row in finding["relative"].items() if row["power"] == 0}


def show_simulation(content: Mapping[str, Any]) -> None:
    """Print the distance of a simulation from its recordings; ``content`` is of simulation.json."""
    runs = content["recordings"].items()
    lines = [f"{name}: {run['status']}{_off(run['error_mm'])}; {run['files'][0]}" for name, run in runs]
    if content["error_mm"] is not None and len(lines) > 1:
        lines.append(f"all of them{_off(content['error_mm'])}")
    typer.echo("\n".join(lines))


def _off(error: Mapping[str, float] | None) -> str:
    """Error of the markers."""
    if error is None:
        return ""
    return (
        f", the last marker off by {error['rms_last_marker']:.3g} mm in root mean square, "
        f"all markers by {error['mean']:.3g} mm on average and {error['max']:.3g} mm at most"
    )


def show_prediction(facts: Mapping[str, Any], files: Sequence[Path]) -> None:
    """Print a description of a prediction and its files; ``facts`` is the content of prediction.json."""
    start = "from the measured first row" if facts["start_pose_known"] else "without a measured first row"
    lines = [f"{facts['rows']} rows {start}, under {facts['draws']} draws of {facts['posterior']}"]
    if facts["group_fitted"] is not None:
        values = "fitted" if facts["group_fitted"] else "not fitted: its values are drawn from the spread of groups"
        lines.append(f"group {facts['group']}, {values}")
    if facts.get("unseen_session"):
        lines.append(facts["unseen_session"])
    if facts.get("compared"):
        found = facts["compared"]
        errors = ", ".join(f"{error:.3g} mm at {name}" for name, error in reversed(found["rms_mm"].items()))
        held = f"the 90 % bands hold {100.0 * found['in_90_percent_bands']:.0f} % of the coordinates"
        lines.append(f"beside the {found['rows']} later rows of the file, off by {errors} (root mean square); {held}")
    lines += [f"caution: {caution['sentence']}" for caution in facts["cautions"]]
    lines += ["mean, 50 and 90 % bands in m:", *(f"  {file}" for file in files)]
    typer.echo("\n".join(lines))


def _console() -> Console:
    """A terminal that shows text as it is: "[simulator] refine" is a table of a file, not a style."""
    return Console(highlight=False, markup=False, emoji=False)


def _parameters(rows: Iterable[tuple[str, Mapping[str, Any], str]]) -> Table:
    """Name, unit, mean, 5 and 95 % quantiles, and a remark."""
    from rfdropo_bayes.report.units import display_unit

    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("parameter", overflow="fold")
    table.add_column("unit")
    for title in ("mean", "5 %", "95 %"):
        table.add_column(title, justify="right")
    table.add_column("")
    for name, row, remark in rows:
        factor, unit = display_unit(row["unit"], max(abs(row["q05"]), abs(row["q95"])))
        bound = Text("at a bound", style=BAD) if row.get("at_bound") else Text(remark, style="dim")
        table.add_row(Text(name), Text(unit), *(f"{row[key] / factor:.4g}" for key in ("mean", "q05", "q95")), bound)
    return table
