"""Repeats and the noise they measure."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import group_repeats, noise_floor, pure_error, read_asl_csv, read_optitrack_csv
from rfdropo_bayes.errors import InputError


def test_identical_commands_are_repeats(build):
    command = build().command
    recordings = [
        build(),
        build(command=command * 2),
        build(),
        build(robot="other"),
        build(time=np.linspace(0, 1.1, 11)),
    ]
    assert group_repeats(recordings) == [[0, 2, 4], [1], [3]]


def test_another_payload_is_not_a_repeat(datasets):
    folder = datasets / "asl_trunk"
    commands = folder / "control_inputs_controlled_1.csv.gz"
    bare, loaded = (read_asl_csv(folder / f"observations_controlled_1{end}.csv.gz", commands) for end in ("", "_100g"))
    assert group_repeats([bare, loaded]) == [[0], [1]]
    assert group_repeats([bare, bare]) == [[0, 1]]


def test_pure_error_recovers_the_noise(build):
    """Noise 1 mm per axis, 5 repeats of 400 rows: the floor is sqrt(3) mm within 2.5 % at 3 standard errors (0.3 %)."""
    rng = np.random.default_rng(5)
    clean = build(rows=400)
    noisy = [build(rows=400, position=clean.position + rng.normal(0.0, 1e-3, (400, 2, 3))) for _ in range(5)]
    floor = noise_floor(noisy)
    assert floor is not None
    standard_error = 1.0 / np.sqrt(2 * 3 * 4 * 400)  # relative, for 3 axes, 4 degrees of freedom, 400 rows
    for marker in ("m1", "m2"):
        assert floor[marker] == pytest.approx(np.sqrt(3.0) * 1e-3, rel=3 * standard_error)
        assert pure_error(noisy).rms[marker] == pytest.approx(floor[marker] * np.sqrt(4 / 5))


def test_masked_rows_do_not_count(build):
    first = build()
    position, mask = first.position.copy(), np.ones((11, 2), dtype=bool)
    position[3, 0] += 1.0
    mask[3, 0] = False
    spread = pure_error([first, build(), build(position=position, position_mask=mask)])
    assert max(spread.rms.values()) < 1e-15


def test_repeats_that_do_not_match_are_rejected(build):
    with pytest.raises(InputError, match="no repeats"):
        pure_error([build()])
    with pytest.raises(InputError, match="differ in rows or markers"):
        pure_error([build(), build(rows=9)])
    assert noise_floor([build(), build(command=2 * build().command)]) is None


def test_spread_of_the_physical_trunk(datasets):
    """The last marker about the mean of the repeats: 4.0 mm (January AKLWI), 2.8 mm (X0HBR), 1.1 mm (April)."""
    paths = sorted((datasets / "sim2real_trunk").glob("*.csv"))
    recordings = [read_optitrack_csv(path) for path in paths]
    groups = {recordings[group[0]].name.split("_")[0]: group for group in group_repeats(recordings)}
    assert {name: len(group) for name, group in groups.items()} == {"AKLWI": 5, "AKLWI2": 3, "X0HBR": 3}
    spread = {name: pure_error([recordings[index] for index in group]).rms["m4"] for name, group in groups.items()}
    assert spread["AKLWI"] == pytest.approx(4.02e-3, abs=0.05e-3)
    assert spread["X0HBR"] == pytest.approx(2.81e-3, abs=0.05e-3)
    assert spread["AKLWI2"] == pytest.approx(1.08e-3, abs=0.05e-3)
