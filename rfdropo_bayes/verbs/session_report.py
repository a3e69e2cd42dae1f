"""report.html of a motor session, from the files that the session left."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.log import EVENTS, SESSION, SUMMARY
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import read_lines, write_text
from rfdropo_bayes.report.session_page import MotorSession, render_session

PAGE = "report.html"
CONFIG = "config.toml"


def write_session_page(folder: Path) -> Path:
    """Write the page of a session.

    Args:
        folder: folder of the session.

    Returns:
        the page.

    Raises:
        InputError: the folder lacks a file of a session, or cannot be written to.
    """
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        config = (folder / CONFIG).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(
            f"is not a complete session ({error})", where=str(folder), remedy="give a folder that rfdropo deploy wrote"
        ) from None
    recording = Trajectory.load(folder / SESSION) if (folder / SESSION).is_file() else None
    goal = tomllib.loads(config).get("goal", {})
    page = folder / PAGE
    name = folder.resolve().name
    session = MotorSession(name, summary, read_lines(folder / EVENTS), config, goal, recording)
    write_text(page, render_session(session))
    return page
