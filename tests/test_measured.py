"""docs/measured.md is what the ledgers say."""

from __future__ import annotations

import pytest

from tests.scripts import REPOSITORY, script

measured = script("tools/measured.py")


def test_the_page_has_the_figures_of_the_ledgers():
    assert measured.PAGE.read_text(encoding="utf-8") == measured.page(), "run python tools/measured.py"


def test_the_readme_has_the_figures_of_the_ledgers():
    text, robots, days = (REPOSITORY / "README.md").read_text(encoding="utf-8"), measured.robots(), measured.days()
    tentacle = robots["soromox_tentacle"]["markers_mm"].values()
    sessions = [days[name][0.0] for name in ("AKLWI_", "X0HBR_", "AKLWI2_")]
    low, high = (of(day[f"error_{end}"] for day in sessions) for of, end in ((min, "low"), (max, "high")))
    for figure in (
        f"{robots['deepc_arm']['test_mm']:.2f} mm at the tip",
        f"{sum(tentacle) / len(tentacle):.1f} mm, mean of markers",
        f"{robots['crl_tdcr']['test_mm']:.1f} mm",
        f"{low:.0f} to {high:.0f} mm at the tip",
    ):
        assert f"| {figure} |" in text


def test_a_share_has_its_exact_interval():
    """Clopper and Pearson (1934): none of n has the upper end 1 - 0.025^(1/n)."""
    share = measured.counted(0, 20)
    assert share["words"] == "0 of 20"
    assert share["interval"] == f"0 to {100 * (1 - 0.025 ** (1 / 20)):.0f} %"


@pytest.mark.parametrize(("value", "shown"), [(0.9071, "0.91"), (3.687, "3.7"), (11.93, "12"), (227.7, "228")])
def test_millimetres_have_two_figures(value, shown):
    assert measured.two_figures(value) == shown
