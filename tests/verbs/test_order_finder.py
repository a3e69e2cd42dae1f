"""Order, sign and azimuths of the commands are found from rows that a robot at rest made itself."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arc_search import ArcSearch
from rfdropo_bayes.verbs.arcs import arcs_of
from rfdropo_bayes.verbs.arrangement import Arrangement, agreement, as_written, motion_of, sections_of
from rfdropo_bayes.verbs.at_rest import RestingRobot, Rows, resting, spread_rows
from rfdropo_bayes.verbs.order_finder import Finding, arranged, find_arrangement, order_lines

PULL = 0.006  # [m]


@cache
def robot(segments: int, **answers) -> Robot:
    """A slender arm with three cables on each of its segments."""
    return Robot.outline(
        name="arm", length=0.2, radius=0.008, segments=segments, cables=3, markers={"mid": 0.1, "tip": 0.2}, **answers
    )


@cache
def at_rest(segments: int) -> RestingRobot:
    return resting(ModelSpec(robot(segments)))


def commands(segments: int, rows: int = 60) -> np.ndarray:
    """Random pulls, and releases of the other cables of a segment."""
    random = np.random.default_rng(segments)
    pulls = random.normal(size=(rows, segments, 2)) * PULL / segments
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    across = pulls @ np.stack([np.cos(angle), np.sin(angle)])
    return across.reshape(rows, -1)


def recorded(segments: int, true: Arrangement) -> Rows:
    """Rows of a robot whose commands reach it by an arrangement, and which is described as without one."""
    command = commands(segments)
    made = arranged(at_rest(segments), true).markers(true.commands(command))[0]
    noise = 3e-4 * np.random.default_rng(1).normal(size=made.shape)
    return Rows(command, made + noise, np.arange(len(command), dtype=float))


def found(segments: int, true: Arrangement) -> Finding:
    return find_arrangement(at_rest(segments), recorded(segments, true))


def explains(segments: int, finding: Finding, true: Arrangement) -> bool:
    """Whether two arrangements send the same cables the same commands, whatever they are called."""
    command = commands(segments)
    both = [
        motion_of(arranged(at_rest(segments), each).markers(each.commands(command))[0])
        for each in (finding.arrangement, true)
    ]
    return agreement(*both).straight > 0.999


def test_commands_as_written_stay_as_they_are():
    true = as_written(3, 1)
    assert found(1, true).arrangement == true


@pytest.mark.parametrize(
    ("columns", "sign", "turns"),
    [
        ((0, 1, 2), 1, (0.9,)),
        ((1, 0, 2), 1, (0.0,)),
        ((2, 0, 1), -1, (0.3,)),
        pytest.param((0, 1, 2, 3, 4, 5), 1, (0.4, -0.5), marks=pytest.mark.slow),
        pytest.param((4, 2, 0, 5, 3, 1), 1, (0.0, 0.0), marks=pytest.mark.slow),
        ((3, 1, 5, 0, 4, 2), -1, (0.2, 0.9)),
    ],
)
def test_order_sign_and_turns_are_found_whatever_they_are(columns, sign, turns):
    true = Arrangement(columns, (sign,) * len(columns), turns)
    finding = found(len(turns), true)
    assert finding.agreement > 0.99
    assert explains(len(turns), finding, true)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_nine_cables_are_found_in_any_order(seed):
    random = np.random.default_rng(seed)
    true = Arrangement(tuple(map(int, random.permutation(9))), (1,) * 9, tuple(random.uniform(-0.5, 0.5, 3).tolist()))
    finding = found(3, true)
    assert finding.agreement > 0.99
    assert explains(3, finding, true)


def test_an_order_within_a_section_is_a_turn_and_is_said_as_one():
    finding = found(1, Arrangement((1, 2, 0), (1, 1, 1), (0.0,)))
    assert finding.arrangement.columns == (0, 1, 2)
    assert abs(abs(np.degrees(finding.common_turn)) - 120.0) < 2.0
    assert not finding.sections_differ


def test_columns_that_move_together_are_rivals_or_stay():
    """Whichever of two columns with the same commands drives a cable, nothing differs: the order as written stays."""
    rows = recorded(1, as_written(3, 1))
    command = rows.command.copy()
    command[:, 1] = command[:, 0]
    made = at_rest(1).markers(command)[0]
    finding = find_arrangement(at_rest(1), rows._replace(command=command, position=made))
    assert finding.arrangement == as_written(3, 1)


def test_the_lines_name_columns_gains_and_azimuths():
    own, three = ["a", "b", "c"], robot(1)
    key = "commands = [{}]"
    assert order_lines(as_written(3, 1), three, own, key) == []
    lines = order_lines(Arrangement((2, 0, 1), (1, 1, -1), (np.radians(20.0),)), three, own, key)
    assert lines[0] == 'commands = ["c", "a", "b"]'
    assert lines[1].startswith("gain = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]")
    assert lines[2].endswith("cable_1 20, cable_2 140, cable_3 260")


def test_arcs_under_cables_are_near_the_rod():
    command = commands(2)
    made = at_rest(2).markers(command)[0]
    search = ArcSearch(robot(2), command, made, at_rest(2).shown)
    assert search.score_of([as_written(6, 2)])[0] > 0.98
    chain, kinds, channels = arcs_of(robot(2), ("tip",))
    assert chain.length.sum() == pytest.approx(0.2)
    assert [kind for kind, _ in channels] == [0, 0, 0, 1, 1, 1]
    assert [kind.end for kind in kinds] == [(0,), (1,)]
    assert sections_of(robot(2)).of_channel == (0, 0, 0, 1, 1, 1)


def test_rows_that_are_looked_at_are_seen_and_far_apart():
    command = np.zeros((500, 2))
    command[7], command[400] = (1.0, 0.0), (0.0, 1.0)
    position = np.zeros((500, 1, 3))
    position[0] = np.nan
    chosen = spread_rows(Rows(command, position, np.arange(500.0)), 20)
    assert len(chosen) == 20
    assert {7, 400} <= set(chosen.tolist())
    assert 0 not in chosen


def test_commands_that_never_move_leave_the_arrangement_as_it_is():
    own = at_rest(1)
    still = Rows(np.full((20, 3), 0.001), own.markers(np.full((20, 3), 0.001))[0], np.arange(20.0))
    found = find_arrangement(own, still)
    assert found.arrangement == as_written(3, 1)
    assert found.alternatives == ()
