"""docs/measured.md is what the ledgers say."""

from __future__ import annotations

import pytest

from tests.scripts import script

measured = script("tools/measured.py")


def test_the_page_has_the_figures_of_the_ledgers():
    assert measured.PAGE.read_text(encoding="utf-8") == measured.page(), "run python tools/measured.py"


def test_a_share_has_its_exact_interval():
    """Clopper and Pearson (1934): none of n has the upper end 1 - 0.025^(1/n)."""
    share = measured.counted(0, 20)
    assert share["words"] == "0 of 20"
    assert share["interval"] == f"0 to {100 * (1 - 0.025 ** (1 / 20)):.0f} %"


@pytest.mark.parametrize(("value", "shown"), [(0.9071, "0.91"), (3.687, "3.7"), (11.93, "12"), (227.7, "228")])
def test_millimetres_have_two_figures(value, shown):
    assert measured.two_figures(value) == shown
