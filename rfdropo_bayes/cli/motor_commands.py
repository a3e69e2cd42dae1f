"""Commands around motors: simulated drives, a session on drives, and checks of this machine."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from rfdropo_bayes.errors import InputError

FAILED = 1

Interface = Annotated[str, typer.Option(help="hub, or an interface of python-can")]
Channel = Annotated[str, typer.Option(help="channel of the interface; HOST:PORT or a path for the hub")]


def register(app: typer.Typer) -> None:
    """Add these commands."""
    app.command()(deploy)
    app.command()(drives)
    app.command()(doctor)


def deploy(
    deployment: Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="the deployment file")],
    mode: Annotated[str, typer.Option(help="check, home, dry-run, shadow, run or replay")] = "dry-run",
    out: Annotated[Path | None, typer.Option("--out", help="folder of the session; by default runs/NAME-TIME")] = None,
    recording: Annotated[Path | None, typer.Option(help="session folder or trajectory to replay")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="print no live view")] = False,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="value of an entry of the deployment file, KEY=VALUE or TABLE.KEY=VALUE; may be repeated",
        ),
    ] = None,
) -> None:
    """Run a policy on drives, or try it. Writes report.html, session.nc, the CAN frames, log.jsonl and summary.json."""
    from rfdropo_bayes.deployment.session import Mode
    from rfdropo_bayes.deployment.session import deploy as run_session
    from rfdropo_bayes.deployment.settings import load_deployment

    if mode not in set(Mode):
        raise InputError(f"unknown mode {mode!r}", where="--mode", remedy=f"choose one of {', '.join(Mode)}")
    folder = out or Path("runs") / f"{deployment.stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    show = not quiet and sys.stdout.isatty() and mode != "check"
    settings = load_deployment(deployment, overrides or [])
    if not quiet and mode == Mode.DRY_RUN:
        typer.echo("starting the simulated drives; the first start of a trunk compiles, for minutes", err=True)
    outcome = run_session(settings, mode, folder, commands=recording, show=show, keyboard=True)
    for channel, identity in outcome.drives.items() if mode == "check" else ():
        typer.echo(f"{channel}: " + ", ".join(f"{name} {value:#x}" for name, value in identity.items()))
    for channel, lacking in outcome.without.items() if mode == "check" else ():
        for line in lacking:
            typer.echo(f"{channel} is without {line}")
    typer.echo(f"{outcome.cause.word}{': ' if outcome.detail else ''}{outcome.detail}")
    for line in _figures(outcome.figures):
        typer.echo(line)
    typer.echo(f"session: {folder}")
    from rfdropo_bayes.verbs.session_report import write_session_page  # with the drives at rest: it loads the figures

    typer.echo(f"report: {write_session_page(folder)}")
    if not outcome.finished:
        raise typer.Exit(FAILED)


def _figures(figures: dict[str, Any]) -> list[str]:
    if not figures:
        return []
    late, act = figures["lateness_s"], figures["act_s"]
    return [
        f"{figures['cycles']} cycles of {1e3 * figures['period_s']:g} ms, {figures['missed']} missed; "
        f"late by {1e3 * late['p50']:.2f} ms (median), {1e3 * late['p99']:.2f} (p99), {1e3 * late['max']:.2f} (most)",
        f"policy: {1e3 * act['p50']:.3f} ms (median), {1e3 * act['p99']:.3f} (p99)",
    ]


def drives(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="name or file of a robot with motors")],
    interface: Interface = "hub",
    channel: Channel = "127.0.0.1:29536",
    plant: Annotated[str, typer.Option(help="springs, or MODULE:CALLABLE")] = "springs",
    markers: Annotated[str, typer.Option(help="HOST:PORT to send markers to")] = "",
) -> None:
    """Simulate the drives of a robot and their bus. Runs until Ctrl-C."""
    from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, serve
    from rfdropo_bayes.deployment.bus import BusTable

    table = BusTable(interface=interface, channel=channel)
    typer.echo(f"drives of {robot} on {interface} {channel}; interrupt to end", err=True)
    serve(SimulationTable(robot, table, plant, markers=markers))


def doctor(
    deployment: Annotated[
        Path | None, typer.Argument(metavar="[DEPLOYMENT.toml]", help="deployment file that names the bus")
    ] = None,
) -> None:
    """Test this machine, its clock and its bus. Prints JSON; the exit status is 1 if something is wrong."""
    from rfdropo_bayes.deployment.doctor import examine
    from rfdropo_bayes.deployment.settings import load_deployment

    settings = None if deployment is None else load_deployment(deployment)
    rate = 100.0 if settings is None else settings.rate_hz
    report = examine(None if settings is None else settings.bus, rate)
    typer.echo(json.dumps(report, indent=2))
    if report["problems"]:
        raise typer.Exit(FAILED)
