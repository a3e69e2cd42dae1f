"""Recordings of another robot are told by name, number, order and unit."""

from __future__ import annotations

import pytest

from rfdropo_bayes.data import check_channels, shared_markers
from rfdropo_bayes.errors import InputError


def test_markers_that_do_not_match_by_name(build):
    own = build(format="csv")
    with pytest.raises(InputError) as caught:
        shared_markers([own], ["low", "up"])
    assert str(caught.value) == (
        "made: no marker matches by name: recording has m1, m2, robot has low, up; "
        "name them under [data.columns] markers"
    )
    with pytest.raises(InputError, match="use the robot that was recorded"):
        shared_markers([build(format="netcdf")], ["low", "up"])
    for format in ("motive-csv", "rosbag", "lerobot"):  # these have [data.columns], too
        with pytest.raises(InputError, match=r"name them under \[data.columns\] markers"):
            shared_markers([build(format=format)], ["low", "up"])
        with pytest.raises(InputError, match=r"list the columns under \[data.columns\]"):
            check_channels(build(format=format), ["b", "a"], "m")


def test_markers_are_those_that_all_recordings_share_in_the_robot_s_order(build):
    other = build(name="other", marker_names=["m2", "m3"])
    assert shared_markers([build()], ["m2", "m0", "m1"]) == ("m2", "m1")
    assert shared_markers([build(), other], ["m1", "m2", "m3"]) == ("m2",)
    with pytest.raises(InputError, match="is in all recordings: made has m1, m2; last has m3, m4"):
        shared_markers([build(), build(name="last", marker_names=["m3", "m4"])], ["m1", "m2", "m3", "m4"])


@pytest.mark.parametrize(
    ("channels", "unit", "message"),
    [
        (
            ["u"],
            "m",
            r"made: recording has 2 channels of commands \(a, b\), robot has 1 channel of commands \(u\); list",
        ),
        (["b", "a"], "m", "commands are in the order a, b, channels of the robot in the order b, a; list"),
        (["u", "v"], "rad", "the recording has commands in m, the robot in rad; correct command_unit"),
    ],
)
def test_channels_that_do_not_fit(build, channels, unit, message):
    with pytest.raises(InputError, match=message):
        check_channels(build(format="csv"), channels, unit)
    check_channels(build(), ["u", "v"], "m")
