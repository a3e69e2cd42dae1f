"""Known properties of the drives: limits of travel, start of the counters, and effect of commands beyond the limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, model_validator

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import whole
from rfdropo_bayes.robots.table import RobotTable
from rfdropo_bayes.tables import nearest

ROUNDING = 1e-9  # how far [m or rad] a sum of commands may be beyond a limit that it reaches exactly

Values = float | tuple[float, ...]


class DriveTravel(RobotTable):
    """Limits, start and size of drive counters, for some cables in some recordings.

    Numbers are counts, one for all cables of the table or one per cable.
    """

    cables: Literal["all"] | tuple[str, ...] = Field(
        default="all", description='"all", or names of the command channels with these limits'
    )
    recordings: str | tuple[str, ...] = Field(
        default="*", description="recordings with these limits: groups of [model.groups], names or wildcards"
    )
    low: Values | None = Field(default=None, description="least value of the counter; none by default")
    high: Values | None = Field(default=None, description="greatest value of the counter; none by default")
    start: Values | None = Field(
        default=None, description="counter at the start of a recording; by default the command in force at the start"
    )
    count_size: float = Field(
        default=1.0,
        description="pull per count [m or rad, as the commands]; negative if the counter falls as a cable is pulled",
    )
    beyond: Literal["lost", "kept", "clipped"] = Field(
        description='effect of a command beyond a limit: "lost", the drive ignores the whole command; "clipped", the '
        'drive goes to the limit and forgets the rest; "kept", the drive waits at the limit until the commands return'
    )

    @model_validator(mode="after")
    def _consistent(self) -> DriveTravel:
        if self.cables != "all" and (not self.cables or len(set(self.cables)) < len(self.cables)):
            raise ValueError("a drive table needs at least one cable, each listed once")
        if self.count_size == 0.0:
            raise ValueError("count_size of a drive table is zero")
        if self.low is None and self.high is None:
            raise ValueError("a drive table has neither low nor high: it states nothing")
        for name in ("low", "high", "start"):
            values = getattr(self, name)
            if isinstance(values, tuple) and (self.cables == "all" or len(values) != len(self.cables)):
                raise ValueError(f"{name} of a drive table needs one number, or one for each of its named cables")
        low, high, start = (self._each(name, 1 if self.cables == "all" else len(self.cables)) for name in _NUMBERS)
        if np.any(low >= high):
            raise ValueError("low of a drive table is not below high")
        if np.any(start < low) or np.any(start > high):
            raise ValueError("start of a drive table is not between low and high")
        return self

    def _each(self, name: str, count: int) -> Float[np.ndarray, " cable"]:
        """Values of one key for each cable; infinite without a limit, NaN without a start."""
        value = getattr(self, name)
        return np.broadcast_to(np.asarray(_NUMBERS[name] if value is None else value, float), (count,))

    def holds_for(self, recording: str, group: str) -> bool:
        """Whether the table applies to a recording of a group, or to a piece of it."""
        patterns = (self.recordings,) if isinstance(self.recordings, str) else self.recordings
        return group in patterns or any(fnmatchcase(whole(recording), pattern) for pattern in patterns)

    def columns(self, channels: Sequence[str]) -> list[int]:
        """Indices of the table's cables among the command channels.

        Raises:
            InputError: a cable that is no channel.
        """
        named = channels if self.cables == "all" else self.cables
        for name in named:
            if name not in channels:
                raise InputError(f"unknown cable {name!r}", where="[[drives]] cables", remedy=nearest(name, channels))
        return [list(channels).index(name) for name in named]


_NUMBERS = {"low": -np.inf, "high": np.inf, "start": np.nan}


@dataclass(frozen=True)
class Travel:
    """Limits of every channel in one recording, as commands [m or rad], and their effect on commands."""

    low: Float[np.ndarray, " channel"]
    high: Float[np.ndarray, " channel"]
    lost: Bool[np.ndarray, " channel"]
    kept: Bool[np.ndarray, " channel"]

    def follow(
        self, initial: Float[np.ndarray, " channel"], command: Float[np.ndarray, "command channel"]
    ) -> Float[np.ndarray, "command channel"]:
        """Commands after the limits of the drives, from sent commands, cumulative [m or rad]."""
        forgotten, before = np.zeros_like(initial, float), np.asarray(initial, float)
        taken = np.empty_like(command, dtype=float)
        for row, sent in enumerate(np.asarray(command, float)):
            forgotten, before = self.advance(forgotten, before, sent)
            taken[row] = before
        return taken

    def advance(
        self,
        forgotten: Float[np.ndarray, "*lane channel"],
        before: Float[np.ndarray, "*lane channel"],
        sent: Float[np.ndarray, "*lane channel"],
    ) -> tuple[Float[np.ndarray, "*lane channel"], Float[np.ndarray, "*lane channel"]]:
        """The sum of forgotten motion after a command, and the command after the limits.

        Args:
            forgotten: sum of forgotten motion before.
            before: last command after the limits.
            sent: the command, cumulative.
        """
        asked = sent - forgotten
        held = np.clip(asked, self.low, self.high)
        over = np.abs(asked - held) > ROUNDING
        taken = np.where(over & self.lost, before, np.where(over, held, asked))
        return np.where(self.kept, 0.0, sent - taken), taken


def travel_in(
    tables: Sequence[DriveTravel],
    channels: Sequence[str],
    recording: str,
    initial: Float[np.ndarray, " channel"],
    group: str = "",
) -> Travel | None:
    """Stated limits of the drives in one recording; None if nothing is stated.

    Args:
        tables: tables of a robot and its experiment.
        channels: names of the command channels.
        recording: name of the recording.
        initial: command before the first row [m or rad].
        group: group of the recording.

    Raises:
        InputError: an unknown cable, two tables that state the travel of one cable, or a recording that begins outside.
    """
    holding = [table for table in tables if table.holds_for(recording, group)]
    if not holding:
        return None
    size = len(channels)
    low, high, beyond = np.full(size, -np.inf), np.full(size, np.inf), np.full(size, "kept", dtype="<U7")
    stated = np.zeros(size, bool)
    for table in holding:
        columns = table.columns(channels)
        if stated[columns].any():
            twice = channels[columns[int(np.argmax(stated[columns]))]]
            raise InputError(
                f"two tables state the travel of {twice} in {recording}",
                where="[[drives]] of the robot, [[model.drives]] of the experiment",
                remedy="keep one of them, or narrow their recordings",
            )
        stated[columns], beyond[columns] = True, table.beyond
        least, most, start = (table._each(name, len(columns)) for name in _NUMBERS)
        begun = np.asarray(initial, float)[columns]
        zero = np.where(np.isnan(start), 0.0, start * table.count_size - begun)
        ends = np.sort(np.stack([least, most]) * table.count_size - zero, axis=0)
        if np.any(begun < ends[0] - ROUNDING) or np.any(begun > ends[1] + ROUNDING):
            cable = channels[columns[int(np.argmax((begun < ends[0] - ROUNDING) | (begun > ends[1] + ROUNDING)))]]
            raise InputError(
                f"{recording} begins outside the travel of {cable}", where="[[drives]]", remedy="state its start"
            )
        low[columns], high[columns] = ends
    return Travel(low, high, beyond == "lost", beyond == "kept")


def unstated_travel(
    tables: Sequence[DriveTravel], channels: Sequence[str], belonging: Mapping[str, str]
) -> list[Caution]:
    """A caution if the travel of cables is stated for other recordings, but not for some of these.

    Args:
        tables: tables of a robot and its experiment.
        channels: names of the command channels.
        belonging: the group of each recording.
    """
    stated = {column for table in tables for column in table.columns(channels)}
    lacking: dict[tuple[int, ...], list[str]] = {}
    for recording, group in belonging.items():
        held = {column for table in tables if table.holds_for(recording, group) for column in table.columns(channels)}
        if stated - held:
            lacking.setdefault(tuple(sorted(stated - held)), []).append(recording)
    return [
        Caution(
            Code.DRIVES_UNSTATED,
            f"the travel of {', '.join(channels[column] for column in columns)} is stated for other recordings and not "
            f"for {', '.join(recordings)}: commands are taken as they were sent; name it in recordings of "
            "[[model.drives]]",
        )
        for columns, recordings in lacking.items()
    ]
