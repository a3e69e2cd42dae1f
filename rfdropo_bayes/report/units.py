"""Units and names as people read them."""

from __future__ import annotations

import numpy as np

_PREFIXED = {"Pa", "m", "s", "N", "Hz"}
_PREFIX = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def display_unit(unit: str, magnitude: float) -> tuple[float, str]:
    """Factor to divide by and the unit's text, so that values of this magnitude read easily (4.5e6 Pa: 4.5 MPa)."""
    unit = "" if unit in ("-", "") else unit
    if not np.isfinite(magnitude) or magnitude <= 0 or 0.1 <= magnitude < 1000:
        return 1.0, _tidy(unit)
    exponent = int(np.clip(3 * np.floor((np.log10(magnitude) + 1.0) / 3 + 1e-9), -9, 9))  # 0.1 to 100 of it
    if exponent == 0 or (unit == "kg/m3" and exponent == 3):
        return 1.0, _tidy(unit)
    if unit in _PREFIXED and exponent in _PREFIX:
        return 10.0**exponent, f"{_PREFIX[exponent]}{unit}"
    return 10.0**exponent, f"10{str(exponent).translate(_SUPERSCRIPT)} {_tidy(unit)}".strip()


def _tidy(unit: str) -> str:
    return unit.replace("m2", "m²").replace("m3", "m³").replace("s2", "s²")


def display_name(name: str) -> str:
    """Parameter name with spaces, which breaks better than underscores."""
    return name.replace("_", " ")
