"""Commands that list robots, methods, mechanisms and formats."""

from __future__ import annotations

import shutil
import sys
import textwrap
from typing import Annotated

import typer

ROBOT_HELP = "name of a robot, or path of a robot file, to describe"


def robots(name: Annotated[str | None, typer.Argument(metavar="[ROBOT]", help=ROBOT_HELP)] = None) -> None:
    """List the robots, or describe a robot. Its geometry, cables, markers and parameters."""
    from rfdropo_bayes.model.robot_listings import named_robot_facts, robot_rows

    if name is None:
        _show(robot_rows())
        typer.echo("\nrfdropo robots NAME describes a robot and its file; rfdropo init writes one for your own.")
    else:
        _say(named_robot_facts(name))


def mechanisms(
    name: Annotated[str | None, typer.Argument(metavar="[MECHANISM]", help="describe this mechanism")] = None,
) -> None:
    """List the mechanisms, or describe a mechanism. Its cause, remedy, parameters and priors."""
    from rfdropo_bayes.model.mechanism_listings import mechanism_facts, mechanism_rows

    if name is None:
        _show(mechanism_rows())
        typer.echo("\nrfdropo mechanisms NAME describes a mechanism: parameters, default priors, remedy.")
    else:
        facts, parameters = mechanism_facts(name)
        _say(facts)
        typer.echo()
        _show(parameters)


def formats() -> None:
    """List the formats of recordings."""
    from rfdropo_bayes.model.robot_listings import format_rows

    _show(format_rows())


def methods() -> None:
    """List the methods of inference."""
    from rfdropo_bayes.model.mechanism_listings import method_rows

    _show(method_rows())


def _show(rows: list[dict[str, str]]) -> None:
    """A table; its last column is wrapped to the width of a terminal."""
    *columns, last = rows[0]
    widths = [max(len(row[key]) for row in [*rows, {key: key for key in columns}]) for key in columns]
    terminal = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
    indent = sum(widths) + 2 * len(widths)
    for row in ({key: key for key in rows[0]}, *rows):
        head = "".join(f"{row[key]:<{width}}  " for key, width in zip(columns, widths, strict=True))
        text = textwrap.wrap(row[last], max(terminal - indent, 30)) or [""]
        typer.echo(head + f"\n{' ' * indent}".join(text))


def _say(facts: dict[str, str]) -> None:
    """One line for each fact."""
    width = max(map(len, facts))
    for key, value in facts.items():
        typer.echo(f"{key:<{width}}  {value}")
