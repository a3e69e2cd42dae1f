"""Causes that end a session, and the reaction to each."""

from __future__ import annotations

from enum import Enum


class Reaction(Enum):
    """Way in which the drives stop.

    ``RAMP`` slows the set-points down within the limits and holds; drives and bus must work. ``QUICK_STOP``
    lets each drive brake on its own ramp and hold.
    """

    RAMP = "ramp"
    QUICK_STOP = "quick_stop"


class Cause(Enum):
    """Why a session ends: the word in the log, and the reaction."""

    FINISHED = ("finished", Reaction.RAMP)
    EMERGENCY_STOP = ("emergency_stop", Reaction.QUICK_STOP)
    DEADLINES = ("deadlines_missed", Reaction.QUICK_STOP)
    SEND_ERROR = ("send_error", Reaction.QUICK_STOP)
    STALE_STATUS = ("stale_status", Reaction.QUICK_STOP)
    SHORT_FRAME = ("short_frame", Reaction.QUICK_STOP)
    HEARTBEAT_LOST = ("heartbeat_lost", Reaction.QUICK_STOP)
    NODE_STATE = ("node_state", Reaction.QUICK_STOP)
    EMERGENCY_MESSAGE = ("emergency_message", Reaction.QUICK_STOP)
    DRIVE_STATE = ("drive_state", Reaction.QUICK_STOP)
    FOLLOWING_ERROR = ("following_error", Reaction.QUICK_STOP)
    TENSION = ("tension", Reaction.RAMP)
    ACTION_NOT_FINITE = ("action_not_finite", Reaction.RAMP)
    ACTION_OUTSIDE = ("action_outside", Reaction.RAMP)
    MARKERS_LOST = ("markers_lost", Reaction.RAMP)
    POLICY_FAILED = ("policy_failed", Reaction.RAMP)
    HOMING_FAILED = ("homing_failed", Reaction.RAMP)
    NOT_ENABLED = ("not_enabled", Reaction.QUICK_STOP)
    PROGRAM_ERROR = ("program_error", Reaction.QUICK_STOP)

    @property
    def word(self) -> str:
        """The word in the log."""
        return self.value[0]

    @property
    def reaction(self) -> Reaction:
        """Reaction of the drives to this cause."""
        return self.value[1]


class Stop(Exception):
    """Ends a session: a cause, and one line with the place of detection."""

    def __init__(self, cause: Cause, detail: str = "") -> None:
        self.cause, self.detail = cause, detail
        super().__init__(f"{cause.word}: {detail}" if detail else cause.word)
