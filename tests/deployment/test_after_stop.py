"""After a quick stop drives must hold: those that enable themselves again, or let go, are named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from rfdropo_bayes.deployment.bench.simulated_node import SimulatedFault
from rfdropo_bayes.deployment.causes import Cause
from rfdropo_bayes.deployment.cia402 import DriveState
from rfdropo_bayes.deployment.loop import ControlLoop
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.deployment.watch import AfterStop

ENABLED, STOPPED = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE
DISABLED, FAULT = DriveState.SWITCH_ON_DISABLED, DriveState.FAULT


class Shown:
    """A drive that shows a state."""

    name = "drive"

    def __init__(self, state: DriveState | None, unguarded: tuple[int, ...] = ()) -> None:
        self.state, self.unguarded = state, unguarded


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ((ENABLED, ENABLED, STOPPED, STOPPED), []),
        ((ENABLED, STOPPED, ENABLED, ENABLED), ["enabled itself again"]),
        ((ENABLED, STOPPED, DISABLED, DISABLED), ["let its cable go after the quick stop: it is in switch"]),
        ((ENABLED, DISABLED), ["let its cable go"]),  # a quick stop that it does not hold
        ((ENABLED, STOPPED, FAULT), ["it is in fault"]),
        ((STOPPED, None), ["unknown state"]),
        ((FAULT, FAULT, DISABLED), []),  # it held nothing before the stop
        ((DISABLED, DISABLED), []),
    ],
)
def test_what_a_drive_does_after_a_quick_stop_is_told_once(states, words) -> None:
    drive = Shown(states[0])
    after = AfterStop(SimpleNamespace(all=(drive,)))  # type: ignore[arg-type]
    for state in states[1:]:
        drive.state = state
        after.look()
    assert len(after.events) == len(words)
    assert all(word in line for word, line in zip(words, after.events, strict=True))


def test_a_drive_may_let_go_if_its_owner_bears_that() -> None:
    drive = Shown(STOPPED, (Object.QUICK_STOP_OPTION,))
    after = AfterStop(SimpleNamespace(all=(drive,)))  # type: ignore[arg-type]
    drive.state = DISABLED
    assert after.look() == []


def test_a_session_names_the_drives_that_did_not_hold(rig, tmp_path: Path) -> None:
    """It had ended as planned, and has not."""
    with rig.session(tmp_path) as session:

        def phases(loop: ControlLoop) -> None:
            loop.enable()
            for drive, fault in zip(
                loop.drives.all[1:3], (SimulatedFault.ENABLES_ITSELF, SimulatedFault.LETS_GO), strict=True
            ):
                drive.write(Object.SIMULATED_FAULT, fault, read_back=False)

        stop = session.loop.run(phases)
    assert stop.cause is Cause.DRIVE_STATE
    assert "'left' (node 2) enabled itself again" in stop.detail
    assert "'down' (node 3) let its cable go" in stop.detail
    assert "'up'" not in stop.detail
    assert any("'left' (node 2) has not shown that it stands" in line for line in session.said)
