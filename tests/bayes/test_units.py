"""What the unit of a parameter says of its share in forces."""

from __future__ import annotations

import pytest

from rfdropo_bayes.discrepancy.audit_record import force_power

POWERS = {
    1: ("kg", "Pa", "N/m", "N m", "Pa s", "kg/m3", "N/m2", "J"),
    -1: ("1/Pa", "m/N"),
    0: ("N/kg", "m/s", "rad", "-"),
}


@pytest.mark.parametrize(("unit", "power"), [(unit, power) for power, units in POWERS.items() for unit in units])
def test_the_power_of_a_force_in_a_unit(unit, power):
    assert force_power(unit) == power
