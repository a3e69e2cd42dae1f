"""A weight of known mass in one recording: its ratios, and the names under which it and others are written."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Weighed, WeighedParts
from rfdropo_bayes.data import load_recordings
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.verbs.calibrate import with_determined

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = ROOT / "experiments" / "asl_trunk_payload.toml"
KNOWN, UNKNOWN = (f"payload_mass@observations_controlled_1_100g[{rows}]" for rows in ("0:3999", "5000:6999"))

LOADS = {"payload_mass@a": "a", "payload_mass@b": "b"}


def record(**draws: np.ndarray) -> PosteriorRecord:
    infos = [ParameterInfo(name, "kg", 0.0, np.inf) for name in draws if name not in LOADS]
    infos += [
        ParameterInfo("payload_mass", "kg", 0.0, np.inf, scope=Scope(LOADS[name])) for name in draws if name in LOADS
    ]
    return PosteriorRecord(tuple(infos), {name: values[None] for name, values in draws.items()}, prior=draws)


def test_a_payload_is_also_given_over_stiffness_and_over_mass():
    modulus, mass, load = np.array([2e6, 4e6]), np.array([0.5, 0.25]), np.array([0.1, 0.2])
    own = {"young_modulus": modulus, "trunk_mass": mass, "payload_mass@a": load, "payload_mass@b": np.array([0.0, 0.1])}
    found = with_determined(record(**own), list(own))
    ratios = {product.name: product.unit for product in found.derived}
    assert ratios == {
        "young_modulus_over_trunk_mass": "Pa/kg",
        "payload_mass_over_young_modulus@a": "kg/Pa",
        "payload_mass_over_trunk_mass@a": "-",
    }
    np.testing.assert_allclose(found.flat("payload_mass_over_young_modulus@a"), load / modulus)
    np.testing.assert_allclose(found.flat("payload_mass_over_trunk_mass@a"), load / mass)
    assert with_determined(record(trunk_mass=mass), ["trunk_mass"]).derived == ()


@pytest.mark.parametrize("common", [0.07, 0.001])
def test_gains_beside_a_gain_of_all_drives_are_also_given_beside_each_other(common):
    """The first of four is 12 % off the others, known to .3 %; by itself to the deviation of their sum with a fifth."""
    rng = np.random.default_rng(0)
    gains = np.array([-0.12, 0.0, 0.0, 0.0]) + 0.003 * rng.normal(size=(2000, 4)) + common * rng.normal(size=(2000, 1))
    names = [f"gain_{k}" for k in range(4)]
    plain = record(**dict(zip(names, gains.T, strict=True)))
    found = with_determined(plain, names, [names, ["absent"]])
    if common < 0.003:
        assert found.derived == ()
        return
    assert [quantity.name for quantity in found.derived] == [f"{name}_less_median" for name in names]
    assert found.flat("gain_0_less_median").mean() == pytest.approx(-0.12, abs=3e-3)
    assert found.flat("gain_0_less_median").std() < 0.005
    assert with_determined(plain, names, [names[:2]]).derived == (), "two members have no median beside them"


def documented() -> list[str]:
    """The overrides of the command in the experiment's head that finds an unknown payload."""
    head = EXPERIMENT.read_text(encoding="utf-8").partition("\ntitle =")[0]
    command = re.sub(r"\\\n#\s*", " ", head)
    (line,) = re.findall(r"rfdropo calibrate .* --from runs/payload .*", command)
    words = shlex.split(line)
    return [words[place + 1] for place, word in enumerate(words) if word == "--set"]


def test_an_unknown_payload_is_free_beside_the_one_that_was_weighed(datasets, monkeypatch):
    monkeypatch.setenv("RFDROPO_DATA", str(datasets))
    for overrides, payloads in (([], {KNOWN}), (documented(), {KNOWN, UNKNOWN})):
        model = Model.read(EXPERIMENT, overrides)
        built = model.numpyro(load_recordings(model.settings.data, model.folder))
        (weighed,) = [channel for channel in built.channels if isinstance(channel, WeighedParts)]
        assert weighed.entries == (Weighed((KNOWN,), 0.1, 0.001),)
        assert {name for name in built.scopes.names if name.startswith("payload_mass")} == payloads
