"""Sensors: what is seen, what is lost, and NatNet's frames in the robot's own frame."""

from __future__ import annotations

import socket
import time
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.deployment.bench.plant import PlantProcess, SpringCables, build_plant
from rfdropo_bayes.deployment.bench.simulated_bus import DATAGRAM, MAGIC
from rfdropo_bayes.deployment.sensors import (
    MarkerView,
    NatNetMarkers,
    NoSensor,
    SensorTable,
    Sighting,
    SimulatedMarkers,
)
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

NAMES = ("a", "b")


class Scripted:
    """A sensor that shows what the test says."""

    def __init__(self) -> None:
        self.sighting = Sighting(0, 0.0, np.zeros((2, 3)), np.zeros(2, dtype=bool))

    def show(
        self, now: float, position: float, seen: tuple[bool, bool] = (True, True), pose: np.ndarray | None = None
    ) -> None:
        self.sighting = Sighting(self.sighting.number + 1, now, np.full((2, 3), position), np.array(seen), pose)

    def latest(self) -> Sighting:
        return self.sighting

    def close(self) -> None:
        pass


def test_a_marker_is_held_then_stale_then_lost() -> None:
    sensor, table = Scripted(), SensorTable(stale_s=0.02, lost_s=0.05)
    view = MarkerView(sensor, table, NAMES)
    sensor.show(10.0, 0.1)
    view.update(10.0)
    assert view.fresh.all()
    assert not view.lost(10.04)
    view.update(10.01)  # the same frame again
    assert not view.fresh.any()
    np.testing.assert_allclose(view.position, 0.1)
    sensor.show(10.02, 0.2, (True, False))
    view.update(10.02)
    assert view.fresh.tolist() == [True, False]
    np.testing.assert_allclose(view.position[:, 0], [0.2, 0.1])
    assert view.lost(10.06) == "b"


def test_an_object_is_held_then_lost() -> None:
    sensor, pose = Scripted(), np.array([0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8])
    view = MarkerView(sensor, SensorTable(stale_s=0.02, lost_s=0.05), NAMES)
    assert view.object_lost(10.0)
    sensor.show(10.0, 0.1, pose=pose)
    view.update(10.0)
    assert view.object_fresh
    sensor.show(10.03, 0.1)  # markers alone
    view.update(10.03)
    assert not view.object_fresh
    np.testing.assert_allclose(view.object_pose, pose)
    assert not view.object_lost(10.04)
    assert view.object_lost(10.06)
    assert not view.lost(10.06)


def test_a_frame_that_is_old_when_it_comes_does_not_count() -> None:
    sensor = Scripted()
    view = MarkerView(sensor, SensorTable(stale_s=0.02), NAMES)
    sensor.show(9.0, 0.1)
    view.update(10.0)
    assert not view.fresh.any()
    assert view.lost(10.0)


def test_positions_that_are_no_numbers_are_lost() -> None:
    sensor = Scripted()
    view = MarkerView(sensor, SensorTable(), NAMES)
    sensor.show(10.0, np.nan)
    view.update(10.0)
    assert not view.fresh.any()
    assert np.all(np.isfinite(view.position))


def test_motion_is_between_acts() -> None:
    sensor = Scripted()
    view = MarkerView(sensor, SensorTable(), NAMES)
    for number in range(3):
        sensor.show(10.0 + 0.1 * number, 0.03 * number)
        view.update(10.0 + 0.1 * number)
        view.act()
    np.testing.assert_allclose(view.moved, 0.03)


def test_no_sensor_sees_nothing() -> None:
    view = MarkerView(NoSensor(2), SensorTable(), NAMES)
    view.update(1.0)
    assert view.lost(1.0) == "a"


def test_simulated_markers_take_the_newest_of_their_size() -> None:
    sensor = SimulatedMarkers(2)
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    host, port = sensor.address.split(":")
    for number in (1, 2):
        out.sendto(DATAGRAM.pack(MAGIC, number, 0.0) + np.full(6, 0.1 * number).tobytes(), (host, int(port)))
    out.sendto(DATAGRAM.pack(MAGIC, 3, 0.0) + np.full(9, 9.0).tobytes(), (host, int(port)))  # another robot's
    out.sendto(b"noise", (host, int(port)))
    time.sleep(0.05)
    sighting = sensor.latest()
    assert sighting.number == 2
    np.testing.assert_allclose(sighting.position, 0.2)
    assert sighting.object_pose is None
    numbers = np.append(np.full(6, 0.4), np.arange(7.0))
    out.sendto(DATAGRAM.pack(MAGIC, 4, 0.0) + numbers.tobytes(), (host, int(port)))
    time.sleep(0.05)
    np.testing.assert_allclose(sensor.latest().position, 0.4)
    np.testing.assert_allclose(sensor.latest().object_pose, np.arange(7.0))
    out.close()
    sensor.close()


def body(
    number: int,
    position: tuple[float, float, float],
    valid: bool = True,
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
) -> SimpleNamespace:
    return SimpleNamespace(id_num=number, pos=position, tracking_valid=valid, rot=rotation)


def test_rigid_bodies_are_turned_into_the_robots_frame(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Motive has y up; a trunk that hangs has z down: x = x, y = z, z = -y."""
    monkeypatch.setattr(NatNetMarkers, "_connect", lambda self, table: None)
    table = SensorTable(
        kind="natnet", rigid_bodies={"m1": 11, "m2": 12, "m3": 13, "m4": 14},
        rotation=((1, 0, 0), (0, 0, 1), (0, -1, 0)), origin_m=(0.0, 2.0, 0.0),
    )  # fmt: skip
    sensor = NatNetMarkers(table, robot)
    sensor.receive(
        SimpleNamespace(rigid_bodies=[body(13, (0.1, 1.7, 0.2)), body(12, (1, 1, 1), False), body(99, (5, 5, 5))])
    )
    sighting = sensor.latest()
    assert sighting.seen.tolist() == [False, False, True, False]
    np.testing.assert_allclose(sighting.position[2], [0.1, 0.2, 0.3])


def test_a_turn_of_the_object_is_about_the_same_axis_in_the_robots_frame(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Motive's vertical, y, is the robot's -z: a turn of 0.2 rad about it is one of -0.2 rad about z, whatever the sign
    of the quaternion."""
    monkeypatch.setattr(NatNetMarkers, "_connect", lambda self, table: None)
    table = SensorTable(
        kind="natnet", rigid_bodies={"m1": 11, "m2": 12, "m3": 13, "m4": 14}, object_body=20,
        rotation=((1, 0, 0), (0, 0, 1), (0, -1, 0)), origin_m=(0.0, 2.0, 0.0),
    )  # fmt: skip
    sensor = NatNetMarkers(table, robot)
    half = np.array([0.0, np.sin(0.1), 0.0, np.cos(0.1)])
    for sign in (1.0, -1.0):
        sensor.receive(SimpleNamespace(rigid_bodies=[body(20, (0.1, 1.7, 0.2), rotation=tuple(sign * half))]))
        expected = [0.1, 0.2, 0.3, 0.0, 0.0, -np.sin(0.1), np.cos(0.1)]
        np.testing.assert_allclose(sensor.latest().object_pose, expected, atol=1e-12)
    sensor.receive(SimpleNamespace(rigid_bodies=[body(20, (0.1, 1.7, 0.2), valid=False)]))
    assert sensor.latest().object_pose is None
    with pytest.raises(InputError, match=r"sensor.object_body: a marker and the object have the same rigid body"):
        NatNetMarkers(table.model_copy(update={"object_body": 13}), robot)


def test_a_marker_without_a_rigid_body_is_refused(robot: Robot) -> None:
    with pytest.raises(InputError, match="marker 'm1' has no rigid body"):
        NatNetMarkers(SensorTable(kind="natnet"), robot)


def test_two_markers_of_one_rigid_body_are_refused(robot: Robot) -> None:
    """One of them would count as lost for ever."""
    with pytest.raises(InputError, match=r"sensor.rigid_bodies: two markers have the same rigid body"):
        NatNetMarkers(SensorTable(kind="natnet", rigid_bodies={"m1": 1, "m2": 2, "m3": 2, "m4": 4}), robot)


def test_springs_have_their_closed_form(robot: Robot) -> None:
    plant = SpringCables(robot, stiffness=100.0, pretension=1.0, lean=2.0)
    state = plant.advance(np.array([0.01, -0.02, 0.0, 0.0]), 0.01)
    np.testing.assert_allclose(state.tension, [2.0, 0.0, 1.0, 1.0])
    # Cable "up" at 90 deg, "left" at 180 deg: the tip, at the full height, moves (-1)(-0.02) x 2 across and 0.01 x 2
    # up.
    np.testing.assert_allclose(state.position[-1] - robot.marker_points()[-1], [0.04, 0.02, 0.0], atol=1e-12)


def test_a_plant_in_its_own_process_gives_the_same(robot: Robot) -> None:
    plant = PlantProcess("springs", robot, {"stiffness": 100.0, "pretension": 1.0})
    length = np.array([0.01, 0.0, 0.0, 0.0])
    end = time.monotonic() + 10.0
    plant.request(length, 0.01)
    while plant.newest().tension[0] != 2.0:
        assert time.monotonic() < end
        time.sleep(0.005)
    assert plant.late == 0.0
    np.testing.assert_allclose(plant.newest().position, build_plant("springs", robot).advance(length, 0.0).position)
    plant.close()


@pytest.mark.parametrize("name", ["nothing", "os:nothing", "no.such.module:plant"])
def test_an_unknown_plant_is_refused(robot: Robot, name: str) -> None:
    with pytest.raises(InputError, match="cannot load the plant"):
        build_plant(name, robot)
