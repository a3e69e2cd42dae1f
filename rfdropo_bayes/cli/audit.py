"""Commands around the audit: what the simulator lacks, what to measure next, how often the audit is right."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def audit(
    experiment: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="the experiment file")],
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write to; reports/<experiment> by default")
    ] = None,
    base: Annotated[
        Path | None, typer.Option("--base", help="folder of an earlier calibration, to start the base model from")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="seed of the audit; that of the experiment file by default")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="name=value: a parameter's value, or table.key=value of the experiment file"),
    ] = None,
) -> None:
    """Say what the simulator lacks, by name: writes audit.json, extended.toml and report.html."""
    from rfdropo_bayes.workflow.audit import run_audit

    folder = out or Path("reports") / experiment.stem
    found = run_audit(
        experiment,
        folder,
        overrides=overrides or [],
        base=base,
        seed=seed,
        report=lambda line: typer.echo(f"  {line}", err=True),
    )
    typer.echo(f"{found['verdict']}: {found['sentence']}")
    typer.echo(f"report: {folder / 'report.html'}; extended model: {folder / 'extended.toml'}")


def design(
    experiment: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="the experiment file")],
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write to; reports/<experiment> by default")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="seed; that of the experiment file by default")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="name=value: a parameter's value, or table.key=value of the experiment file"),
    ] = None,
) -> None:
    """Propose the commands that best separate the leading explanations: writes next_commands.csv and design.json."""
    from rfdropo_bayes.workflow.design import run_design

    folder = out or Path("reports") / experiment.stem
    found = run_design(
        experiment,
        folder,
        overrides=overrides or [],
        seed=seed,
        report=lambda line: typer.echo(f"  {line}", err=True),
    )
    typer.echo(found["sentence"])


def benchmark_audit(
    datasets: Annotated[int, typer.Option(help="data sets per condition")] = 100,
    seed: Annotated[int, typer.Option(help="seed of the study")] = 0,
    workers: Annotated[int, typer.Option(help="processes")] = 1,
    condition: Annotated[list[str] | None, typer.Option(help="one condition; may be given several times")] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(help="mechanism to leave out; may be given several times")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="folder to write to")] = Path("reports/audit_power"),
) -> None:
    """Hide effects in recordings, audit them, and count hits, misses and confusions; goes on where it was stopped."""
    from rfdropo_bayes.workflow.audit_study import TABLE, run_study

    run_study(
        out,
        datasets,
        seed,
        workers=workers,
        conditions=condition or [],
        exclude=exclude or [],
        report=lambda line: typer.echo(line, err=True),
    )
    typer.echo((out / TABLE).read_text(encoding="utf-8"))
