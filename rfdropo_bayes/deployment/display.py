"""The live view of a session in the terminal."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Table

from rfdropo_bayes.deployment.loop import Snapshot


def session_table(snapshot: Snapshot, mode: str) -> Table:
    """Cycle time, states, set-points, tensions, misses and time left."""
    phase = "-" if snapshot.phase is None else snapshot.phase.name.lower()
    title = (
        f"{mode}: {phase}, {snapshot.left:.1f} s left, late {1e3 * snapshot.lateness:.2f} ms, "
        f"missed {snapshot.missed}, policy {1e3 * snapshot.act_time:.2f} ms. Any of space, Enter, Esc, q stops."
    )
    table = Table(title=title, title_justify="left")
    for column in ("channel", "node", "state", "set-point [mm]", "actual [mm]", "tension [N]"):
        table.add_column(column, justify="left" if column in ("channel", "state") else "right")
    for drive, length in zip(snapshot.drives, snapshot.set_point, strict=True):
        axis = f" axis {drive.motor.axis}" if drive.motor.axis > 1 else ""
        node = f"{drive.motor.node}{axis}"
        if drive.reading is None:
            table.add_row(escape(drive.motor.channel), node, "silent", "", "", "")
            continue
        state = drive.state
        limit = drive.motor.tension_limit_n[1]
        tension = f"{drive.tension:.2f}"
        table.add_row(
            escape(drive.motor.channel),
            node,
            "unknown" if state is None else state.words,
            f"{1e3 * length:.2f}",
            f"{1e3 * drive.length:.2f}",
            f"[red]{tension}[/red]" if drive.tension > 0.8 * limit else tension,
        )
    return table
