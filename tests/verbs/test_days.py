"""Days by the names of files, and the rows that are fitted and tested."""

from __future__ import annotations

import tomllib
from functools import partial
from pathlib import Path

import pytest

from rfdropo_bayes.groups import gather_groups
from rfdropo_bayes.verbs.days import ROWS_AT_REST, Piece, days_of, group_lines, pieces_of


@pytest.mark.parametrize(
    ("names", "days"),
    [
        (("mon_1.csv", "mon_2.csv", "wed_1.csv"), {"mon": [0, 1], "wed": [2]}),
        (("log_2025-08-27_20-02.txt", "log_2025-08-28_20-02.txt"), {"2025-08-27": [0], "2025-08-28": [1]}),
        (("monday/run_1.csv", "friday/run_1.csv"), {"monday": [0], "friday": [1]}),
        (("day1.csv.gz", "day2.csv.gz"), {"day1": [0], "day2": [1]}),
        (("run_1.csv", "run_2.csv"), {}),
        (("mon_1.csv", "run_2.csv"), {}),
        (("mon_1.csv", "mon_2.csv"), {}),
        (("monotone.csv", "sunk.csv"), {}),
    ],
)
def test_days_are_told_by_names(names, days):
    assert days_of([Path(name) for name in names]) == days
    assert len(group_lines(days)) == (len(days) + 2 if days else 0)


@pytest.mark.parametrize("names", [("run_day1", "run_day10_b"), ("Session 2", "Session 21"), ("day1_a", "day10")])
def test_the_group_of_a_day_holds_no_other_day(names):
    days = days_of([Path(f"{name}.csv") for name in names])
    groups = tomllib.loads("\n".join(group_lines(days)))["model"]["groups"]
    assert list(gather_groups(names, groups).values()) == [(name,) for name in names]


SINGLE = [[k] for k in range(7)]  # no command sequence is repeated


def test_a_repeat_of_fitted_commands_is_no_test():
    """Recordings 0, 2 and 4 of six are repeats: 3 and 5 are the test. Of four repeats the last is."""
    found = pieces_of([90] * 6, {}, [[0, 2, 4], [1], [3], [5]])
    assert [piece.file for piece in found if piece.tested] == [3, 5]
    assert [piece.tested for piece in pieces_of([90] * 4, {}, [[0, 1, 2, 3]])] == [False] * 3 + [True]
    assert [piece.tested for piece in pieces_of([90] * 6, {}, [[0, 1], [2, 3], [4, 5]])] == [False] * 4 + [True] * 2


def test_the_last_third_is_kept_for_a_test_unless_there_are_few_rows():
    assert pieces_of([90], {}, SINGLE) == [Piece(0, {"rows": [0, 59]}, False), Piece(0, {"rows": [60, 89]}, True)]
    assert pieces_of([40], {}, SINGLE) == [Piece(0, {}, False)]
    assert pieces_of([90, 40], {}, SINGLE) == [Piece(0, {}, False), Piece(1, {}, True)]
    assert [piece.tested for piece in pieces_of([90] * 7, {}, SINGLE)] == [False] * 5 + [True] * 2


def test_every_day_is_fitted_and_tested():
    days = {"mon": [0, 1], "wed": [2], "fri": [3]}
    assert pieces_of([90, 90, 90, 40], days, SINGLE) == [
        Piece(0, {}, False),
        Piece(1, {}, True),
        Piece(2, {"rows": [0, 59]}, False),
        Piece(2, {"rows": [60, 89]}, True),
        Piece(3, {}, False),
    ]


def test_of_many_rows_at_rest_a_fit_takes_some():
    rows = 12 * ROWS_AT_REST
    pieces, cut = partial(pieces_of, [rows], {}, SINGLE), 8 * ROWS_AT_REST
    fitted, tested = pieces()
    assert (fitted.rows, tested.rows) == ({"rows": [0, cut - 1]}, {"rows": [cut, rows - 1]})
    assert pieces(rests=True)[0].rows == {"rows": [0, cut - 1], "every": 8}
    untimed = pieces(rests=True, timed=False)
    assert [piece.rows for piece in untimed] == [{"rows": [first, rows - 1], "every": 12} for first in (0, 6)]
    several = pieces_of([rows] * 3, {}, SINGLE, rests=True)
    assert [piece.rows for piece in several] == [{"every": 24}, {"every": 24}, {}]
