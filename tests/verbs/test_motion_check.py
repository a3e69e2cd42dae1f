"""Frame, order and unit of commands are doubted by the motion that a nominal model makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.verbs.motion_check import Motion, Proposal, motion_cautions
from rfdropo_bayes.verbs.motion_direction import Direction, Paths
from rfdropo_bayes.verbs.motion_size import Size, Unit, likely_units, other_units, size_of

NAMES = ("c1", "c2", "c3", "c4")
WELL = Direction(0.02, 0.95, 0.3)
FITS = Size(0.010, 0.012)


def columns(unit: str) -> CsvColumns:
    counted = {"counts_per_turn": 4096.0} if unit == "counts" else {}
    positions = [["x", "y", "z"]]
    table = {"sample_time": 0.1, "commands": list(NAMES), "positions": positions, "position_unit": "mm", **counted}
    return CsvColumns(command_unit=unit, **table)


def test_another_arrangement_is_named_with_the_lines_that_mend_it():
    turned, lines = (
        Direction(1.2, 0.4, 0.3),
        ('commands = ["c1", "c3", "c2", "c4"] in [data.columns]', "gain = [[-1.0]]"),
    )
    (caution,) = motion_cautions(Motion(turned, FITS, Proposal(0.97, lines)), columns("mm"), "m")
    assert caution.code is Code.ORDER_DOUBTFUL
    assert "; ".join(lines) in caution.sentence
    assert "agreement 0.97" in caution.sentence
    assert motion_cautions(Motion(WELL, FITS), columns("mm"), "m") == []


def test_arrangements_that_explain_a_motion_as_well_are_named_beside_each_other():
    lines = ('commands = ["c1", "c4", "c3", "c2"] in [data.columns]',)
    (caution,) = motion_cautions(Motion(WELL, FITS, Proposal(0.97, lines, ("azimuth_deg",))), columns("mm"), "m")
    assert "do not distinguish them" in caution.sentence
    assert "; or azimuth_deg" in caution.sentence
    mirrored = Direction(0.0, 0.3, 0.96, 0.0)
    (caution,) = motion_cautions(Motion(mirrored, FITS, Proposal(0.96, lines, (), True)), columns("mm"), "m")
    assert caution.code is Code.FRAME_DOUBTFUL
    assert 'axes = ["x", "-y", "z"]' in caution.sentence
    assert lines[0] in caution.sentence


@pytest.mark.parametrize(("ratio", "unit", "doubtful"), [(0.5, "m", 0), (2.0, "m", 0), (9.0, "m", 1), (0.1, "rad", 1)])
def test_a_motion_of_another_size_than_the_nominal_is_doubtful_if_commands_impose_it(ratio, unit, doubtful):
    found = motion_cautions(Motion(WELL, Size(0.010 * ratio, 0.010)), None, unit)
    assert [caution.code for caution in found] == [Code.UNIT_DOUBTFUL] * doubtful
    assert motion_cautions(Motion(WELL, Size(0.010 * ratio, 0.010)), None, "N") == []
    lost = Direction(0.0, 0.5, 0.5)  # what moves otherwise says nothing of sizes
    assert motion_cautions(Motion(lost, Size(0.010 * ratio, 0.010)), None, unit) == []


@pytest.mark.parametrize(
    ("unit", "ratio", "likely"),
    [("mm", 9.4, "cm"), ("mm", 700.0, "m"), ("m", 1.3e-3, "mm"), ("cm", 0.12, "mm"), ("rad", 0.015, "deg")],
)
def test_the_unit_that_is_tried_first_is_the_nearest(unit, ratio, likely):
    kind = "m" if unit in ("m", "cm", "mm") else "rad"
    units = likely_units(other_units(columns(unit), kind), Size(0.01 * ratio, 0.01))
    assert units[0].name == likely
    then = Motion(WELL, Size(0.01 * ratio, 0.01), unit=(units[0], Size(0.01 * ratio, 0.011 * ratio)))
    (caution,) = motion_cautions(then, columns(unit), kind)
    assert f'command_unit = "{likely}"' in caution.sentence


def test_commands_too_large_to_simulate_are_tried_smaller_and_forces_not_at_all():
    assert [u.factor for u in likely_units(other_units(columns("m"), "m"), None)] == pytest.approx(
        [0.1, 0.0254, 0.01, 1e-3]
    )
    assert [u.name for u in likely_units(other_units(columns("cm"), "m"), None)] == ["mm", "", ""]
    assert other_units(None, "N") == []
    assert Unit("", 10.0) in other_units(None, "m")


def test_markers_that_do_not_follow_are_doubtful_unless_the_model_hardly_moves():
    apart = Direction(2.0, 0.1, 0.2)
    (caution,) = motion_cautions(Motion(apart, FITS), None, "m")
    assert caution.code is Code.RECORDING_DOUBTFUL
    assert motion_cautions(Motion(apart, Size(0.01, 1e-4)), None, "m") == []


def test_sizes_are_of_the_rows_that_were_seen_about_their_mean():
    random = np.random.default_rng(1)
    nominal = random.normal(size=(50, 2, 3))
    measured, mask = 3.0 * nominal + 7.0, np.ones((50, 2), dtype=bool)
    mask[10:20, 0] = False
    measured[10:20, 0] = 1e3
    assert size_of([Paths(nominal, measured, mask)]).ratio == pytest.approx(3.0)
