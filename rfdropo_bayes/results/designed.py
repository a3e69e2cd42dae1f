"""The commands to record next, as an object that shows itself and writes its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from rfdropo_bayes.files import output_folder, whole, write_json

COMMANDS, DESIGN = "next_commands.csv", "design.json"


@dataclass(frozen=True, repr=False)
class Design:
    """The commands to record next, and the question they decide.

    Attributes:
        content: content of design.json.
        commands: the proposal, a column for the time and one for each channel, as the recordings have them.
    """

    content: Mapping[str, Any]
    commands: pd.DataFrame

    @property
    def sentence(self) -> str:
        """The recommended recording and its expected result."""
        return str(self.content["sentence"])

    def save(self, folder: Path | str) -> Path:
        """Write next_commands.csv and design.json; return the path of the commands."""
        folder = output_folder(Path(folder))
        with whole(folder / COMMANDS) as partial:
            self.commands.to_csv(partial, index=False, float_format="%.6f")
        write_json(folder / DESIGN, {**self.content, "commands": str(folder / COMMANDS)})
        return folder / COMMANDS

    def __repr__(self) -> str:
        return f"{self.sentence}\n{self.commands.head().to_string()}"

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.sentence)}</p>{self.commands.head().to_html()}"
