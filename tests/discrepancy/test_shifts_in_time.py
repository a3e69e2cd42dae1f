"""Shifts in time, of which the likelihood has many summits: commands that jump, and arrive late, in low noise."""

from __future__ import annotations

import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.mechanisms import REGISTRY

DELAY = 0.07
LEFT = ("command_delay", "clock_offset", "actuator_lag")


@pytest.mark.slow
def test_a_delay_is_told_from_a_shift_of_the_clock():
    """From no delay, an optimisation ends at a maximum between two steps of the simulation, 7,000 nats below the right
    one.
    """
    arm = rb.Robot.outline(name="arm", length=0.25, radius=0.012, markers={"mid": 0.125, "tip": 0.25}, mass=0.09)
    late = rb.Model(arm, priors={"young_modulus": {}}, mechanisms=["command_delay"])
    walk = {"duration": 6.0, "interval": 0.3, "step": 0.004, "low": 0.0, "high": 0.014, "sample_time": 1.0 / 60.0}
    runs = rb.simulate(
        late,
        {**walk, "recordings": ["1", "2", "3"]},
        parameters={"young_modulus": 4.2e5, "command_delay": DELAY},
        noise={"standard_deviation": 3e-4},
        seed=3,
    )
    model = rb.Model(arm, priors={"young_modulus": {}, "trunk_mass": {}, "rayleigh_stiffness": {}})
    others = [name for name in REGISTRY if name not in LEFT]
    options = rb.AuditOptions(exclude=others, ports=False, minutes=300.0)
    found = rb.audit(model, runs[:2], options, test=runs[2:], seed=0)
    (finding,) = found.content["findings"]
    assert finding["mechanism"] == "command_delay"
    assert finding["parameters"]["command_delay"]["mean"] == pytest.approx(DELAY, abs=1e-4)
    assert finding["equivalence_class"] == ["command_delay"]
