"""The fault campaign: every fault ends in a safe state within 100 ms, with its cause in the log."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "motor_faults.py"
SPEC = importlib.util.spec_from_file_location("motor_faults", PATH)
assert SPEC is not None
assert SPEC.loader is not None
campaign = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = campaign
SPEC.loader.exec_module(campaign)


@pytest.mark.slow
@pytest.mark.parametrize("name", campaign.CASES)
def test_every_fault_ends_safely(name: str) -> None:
    row = campaign.examine(name)
    assert row.passed, row
