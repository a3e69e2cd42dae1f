"""Commands that arrive late: by a shift in time, of which the likelihood has many summits, or through a slow drive."""

from __future__ import annotations

import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.mechanisms import REGISTRY

DELAY, LAG = 0.07, 0.12  # s
LEFT = ("command_delay", "clock_offset", "actuator_lag")


def only_finding(mechanism: str, sizes: dict[str, float], library: tuple[str, ...]) -> dict:
    """What an audit with a library names in recordings of an arm with a mechanism, which it must name alone."""
    arm = rb.Robot.outline(name="arm", length=0.25, radius=0.012, markers={"mid": 0.125, "tip": 0.25}, mass=0.09)
    late = rb.Model(arm, priors={"young_modulus": {}}, mechanisms=[mechanism])
    walk = {"duration": 6.0, "interval": 0.3, "step": 0.004, "low": 0.0, "high": 0.014, "sample_time": 1.0 / 60.0}
    runs = rb.simulate(
        late,
        {**walk, "recordings": ["1", "2", "3"]},
        parameters={"young_modulus": 4.2e5, **sizes},
        noise={"standard_deviation": 3e-4},
        seed=3,
    )
    model = rb.Model(arm, priors={"young_modulus": {}, "trunk_mass": {}, "rayleigh_stiffness": {}})
    others = [name for name in REGISTRY if name not in library]
    options = rb.AuditOptions(exclude=others, ports=False, minutes=300.0)
    found = rb.audit(model, runs[:2], options, test=runs[2:], seed=0)
    (finding,) = found.content["findings"]
    assert finding["mechanism"] == mechanism
    return finding


@pytest.mark.slow
def test_a_delay_is_told_from_a_shift_of_the_clock():
    """From no delay, an optimisation ends at a maximum between two steps of the simulation, 7,000 nats below the right
    one.
    """
    finding = only_finding("command_delay", {"command_delay": DELAY}, LEFT)
    assert finding["parameters"]["command_delay"]["mean"] == pytest.approx(DELAY, abs=1e-4)
    assert finding["equivalence_class"] == ["command_delay"]


@pytest.mark.slow
def test_a_slow_drive_is_told_from_a_late_drive_and_its_lag_is_measured():
    """Recordings have one fixed draw of the noise."""
    library = ("command_delay", "cable_delay", "actuator_lag", "cable_lag", "rate_limit", "backlash", "clock_offset")
    finding = only_finding("cable_lag", {"cable_lag_pull_2": LAG}, library)
    assert finding["equivalence_class"] == ["cable_lag"]
    for name, size in finding["parameters"].items():
        assert size["mean"] == pytest.approx(LAG if name.endswith("pull_2") else 0.0, abs=1e-3), name
