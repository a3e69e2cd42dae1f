"""phi as a table for other simulators."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import FIXED, ParameterInfo, PosteriorRecord
from rfdropo_bayes.report.facts import RunFacts
from rfdropo_bayes.report.run_files import POSTERIOR, SUMMARY
from rfdropo_bayes.report.summary import build_summary, write_summary
from rfdropo_bayes.verbs.export import export_model, export_phi, millimetre_factor


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("Pa", 1e-3),
        ("m", 1e3),
        ("kg", 1.0),
        ("kg/m3", 1e-9),
        ("N/m", 1.0),
        ("Pa/kg", 1e-3),
        ("1/s", 1.0),
        ("-", 1.0),
        ("rad", 1.0),
        ("m2/s2", 1e6),
        ("N s/m", 1.0),
    ],
)
def test_units_of_a_scene_in_millimetres(unit, factor):
    assert millimetre_factor(unit) == pytest.approx(factor)


def run_folder(folder, phi=None):
    rng = np.random.default_rng(0)
    scale = 0.2 * rng.normal(size=1000)
    draws = {"young_modulus": 4.5e6 * np.exp(scale), "trunk_mass": 0.42 * np.exp(scale + 0.01 * rng.normal(size=1000))}
    infos = (ParameterInfo("young_modulus", "Pa", 1e5, 1e8), ParameterInfo("trunk_mass", "kg", 1e-3, 10.0))
    record = PosteriorRecord(infos, {name: column[None] for name, column in draws.items()})
    facts = RunFacts("t", "r", "rfdropo" if phi else "smc", "e", "done", 3, 10.0, 1.0, phi=phi)
    record.save(folder / POSTERIOR)
    write_summary(build_summary(record, facts), folder / SUMMARY)
    return draws


def test_a_posterior_is_written_with_units_correlations_and_draws(tmp_path):
    draws = run_folder(tmp_path)
    paths = export_phi(tmp_path, tmp_path / "out")
    assert all(path.is_file() for path in paths)
    table = pd.read_csv(paths[0]).set_index("parameter")
    assert table.loc["young_modulus", "unit"] == "Pa"
    assert table.loc["young_modulus", "mean"] == pytest.approx(draws["young_modulus"].mean())
    assert table.loc["young_modulus", "mean_mm_kg_s"] == pytest.approx(1e-3 * draws["young_modulus"].mean())
    content = json.loads(paths[1].read_text())
    assert content["correlation"]["young_modulus"]["trunk_mass"] > 0.99
    joint = pd.read_csv(paths[2])
    np.testing.assert_allclose(joint["trunk_mass"], draws["trunk_mass"])


def test_phi_is_written_as_found(tmp_path):
    phi = {
        "young_modulus": {"mean": 4.4e6, "std": 1e5, "low": 4.2e6, "high": 4.6e6, "unit": "Pa"},
        "trunk_mass": {"mean": 0.4, "std": 0.01, "low": 0.38, "high": 0.42, "unit": "kg"},
    }
    run_folder(tmp_path, phi)
    table = pd.read_csv(export_phi(tmp_path)[0]).set_index("parameter")
    assert table.loc["trunk_mass", "low"] == 0.38
    assert table.loc["young_modulus", "std_mm_kg_s"] == pytest.approx(100.0)


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        export_phi(tmp_path)


ARM = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/><geom size="0.01" mass="0.05"/>
<body name="lower" pos="0 0 -0.1"><joint name="b" axis="0 1 0"/><geom size="0.01" mass="0.03"/><site name="tip"/>
</body></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>"""
EXPERIMENT = """robot = "arm.xml"
[adapter.parameters]
damping_a = "joint/a/damping"
damping_b = "joint/b/damping"
mass = "body/lower/mass"
stiffness = "joint/b/stiffness"
[model]
priors = { mass = {} }
fixed = { damping = 0.02 }
"""


def test_a_model_is_written_with_what_was_fixed_for_several_elements_and_what_the_method_held(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "config.toml").write_text(EXPERIMENT)
    info = ParameterInfo("mass", "kg", 0.01, 10.0)
    draws = {"mass": np.full((1, 4), 0.06)}
    PosteriorRecord(
        (info,), draws, attrs={FIXED: [{"parameter": ParameterInfo("stiffness", "-").as_dict(), "value": 0.3}]}
    ).save(tmp_path / POSTERIOR)
    written = mujoco.MjModel.from_xml_path(str(export_model(tmp_path)))
    np.testing.assert_allclose(written.dof_damping, 0.02)
    assert written.jnt_stiffness[1] == pytest.approx(0.3)
    assert written.body_mass[2] == pytest.approx(0.06)
