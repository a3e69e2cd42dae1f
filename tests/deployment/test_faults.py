"""The fault campaign: every fault ends in a safe state within 100 ms, with its cause in the log."""

from __future__ import annotations

import pytest

from tests.scripts import script

campaign = script("benchmarks/motor_faults.py")


@pytest.mark.slow
@pytest.mark.parametrize("name", campaign.CASES)
def test_every_fault_ends_safely(name: str) -> None:
    row = campaign.examine(name)
    assert row.passed, row
