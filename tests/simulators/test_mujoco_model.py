"""MuJoCo models in the robot's place: closed forms, MuJoCo's own steps, addresses, divergence, files written back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.simulators.adapters.mujoco_model import MuJoCo, first_tables
from rfdropo_bayes.simulators.black_box import BlackBoxSimulator
from rfdropo_bayes.simulators.protocol import Result, Simulator

mujoco = pytest.importorskip("mujoco")

STIFFNESS, MASS, STEP = 40.0, 0.4, 1e-3
SPRING = f"""
<mujoco model="spring">
  <option timestep="{STEP}" gravity="0 0 -9.81" integrator="implicitfast"/>
  <worldbody><body name="bob" pos="0 0 1">
    <joint name="slide" type="slide" axis="0 0 1" stiffness="{STIFFNESS}"/>
    <geom name="ball" size="0.05" mass="{MASS}"/><site name="tip" pos="0 0 0.1"/>
  </body></worldbody>
  <actuator><motor name="push" joint="slide" ctrlrange="-5 5"/></actuator>
</mujoco>"""
ARM = """
<mujoco model="arm">
  <compiler angle="radian" inertiafromgeom="true"/>
  <option timestep="0.005"/>
  <default><joint damping="0.05" armature="0.001"/></default>
  <worldbody><body name="upper" pos="0 0 1">
    <joint name="shoulder" axis="0 1 0" stiffness="2"/>
    <geom name="u" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/>
    <body name="lower" pos="0 0 -0.2"><inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>
      <joint name="elbow" axis="0 1 0" stiffness="1" springref="0.2"/>
      <geom name="l" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/><site name="tip" pos="0 0 -0.2"/>
    </body></body></worldbody>
  <tendon><fixed name="cord" stiffness="3" damping="0.1"><joint joint="shoulder" coef="0.02"/></fixed></tendon>
  <actuator>
    <position name="s" joint="shoulder" kp="5" kv="0.1"/><motor name="e" joint="elbow" gear="2"/>
    <general name="g" joint="elbow" gainprm="0.5" biastype="affine" biasprm="0.1 -0.5 0"/>
  </actuator>
</mujoco>"""
PARAMETERS = {
    "mass": "body/*/mass",
    "lower inertia": "body/lower/inertia",
    "shoulder stiffness": "joint/shoulder/stiffness",
    "damping": "joint/*/damping",
    "friction": "joint/elbow/frictionloss",
    "rest": "joint/elbow/springref",
    "cord": "tendon/cord/stiffness",
    "kp": "actuator/s/kp",
    "motor": "actuator/e/gain",
    "general": "actuator/g/offset",
    "down": "option/gravity_z",
}
TRUTH = {"mass": 1.3, "lower_inertia": 0.8, "shoulder_stiffness": 3.1, "damping": 0.6, "friction": 0.02, "rest": 0.35}
TRUTH |= {"cord": 4.0, "kp": 6.1, "motor": 1.2, "general": 0.15, "down": -9.5}


def written(tmp_path, text, name="model.xml"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.fixture
def spring(tmp_path):
    given = {"k": "joint/slide/stiffness", "m": "body/bob/mass", "c": "joint/slide/damping"}
    return MuJoCo(written(tmp_path, SPRING), parameters=given)


@pytest.fixture
def arm(tmp_path):
    return MuJoCo(written(tmp_path, ARM), markers=["tip"], parameters=PARAMETERS)


def sent(simulator, seconds=1.0, size=0.3, seed=0):
    steps = round(seconds / simulator.time_step)
    time = simulator.time_step * np.arange(steps + 1)
    channels = len(simulator.channel_names)
    value = np.repeat(np.random.default_rng(seed).uniform(-size, size, (10, channels)), steps // 10, axis=0)
    return simulator.commands(time[: len(value)], value, np.zeros(channels), time)


def test_a_spring_swings_with_the_period_of_the_formula(spring):
    simulator = BlackBoxSimulator(spring)
    assert isinstance(simulator, Simulator)
    assert simulator.command_unit == "N"
    commands = sent(simulator, seconds=3.0, size=0.0)
    for stiffness, mass in ((40.0, 0.4), (90.0, 0.4), (40.0, 0.9)):
        seen = simulator.rollout({"k": jnp.asarray(stiffness), "m": jnp.asarray(mass)}, commands)
        height = np.asarray(seen.position)[:, 0, 2] - 1.1
        middle = -mass * 9.81 / stiffness
        time = STEP * np.arange(len(height))
        wanted = middle * (1.0 - np.cos(np.sqrt(stiffness / mass) * time))
        assert np.abs(height - wanted).max() < 0.02 * abs(middle)
        assert int(seen.status) == Result.OK


def test_a_settled_spring_hangs_where_its_forces_balance(tmp_path):
    box = MuJoCo(written(tmp_path, SPRING), parameters={"k": "joint/slide/stiffness"}, start="settled")
    simulator = BlackBoxSimulator(box)
    value = np.full((11, 1), 1.5)
    commands = simulator.commands(STEP * np.arange(11), value, value[0], STEP * np.arange(11))
    for stiffness in (20.0, 60.0):
        seen = simulator.rollout({"k": jnp.asarray(stiffness)}, commands)
        wanted = 1.1 + (1.5 - MASS * 9.81) / stiffness
        np.testing.assert_allclose(seen.position[:, 0, 2], wanted, atol=1e-6)


def test_rollouts_are_mujocos_own_steps_and_a_batch_is_the_single_ones(tmp_path, arm):
    simulator = BlackBoxSimulator(arm)
    commands = sent(simulator)
    model = mujoco.MjModel.from_xml_string(ARM)
    data, wanted = mujoco.MjData(model), []
    for level in np.concatenate([np.asarray(commands.step), np.zeros((1, 3))]):
        mujoco.mj_forward(model, data)
        wanted.append(data.site("tip").xpos.copy())
        data.ctrl[:] = level
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(simulator.rollout({}, commands).position[:, 0], wanted, atol=1e-13)
    factors = jnp.array([0.5, 1.0, 1.7])
    batch = jax.vmap(lambda f: simulator.rollout({"damping": f}, commands).position)(factors)
    for factor, moved in zip(factors, batch, strict=True):
        np.testing.assert_array_equal(simulator.rollout({"damping": factor}, commands).position, moved)
    np.testing.assert_allclose(batch[1][:, 0], wanted, atol=1e-13)


def test_each_address_changes_what_it_names(arm):
    (model,) = arm.function.models({name: np.array([value]) for name, value in TRUTH.items()}, 1)
    plain = mujoco.MjModel.from_xml_string(ARM)
    np.testing.assert_allclose(model.body_mass, 1.3 * plain.body_mass)
    np.testing.assert_allclose(model.body_inertia[2], 0.8 * 1.3 * plain.body_inertia[2])
    np.testing.assert_allclose(model.body_subtreemass[0], 1.3 * plain.body_subtreemass[0])  # follows from the others
    np.testing.assert_allclose(model.dof_damping, 0.6 * plain.dof_damping)
    assert model.jnt_stiffness[0] == pytest.approx(3.1)
    assert model.dof_frictionloss[1] == 0.02
    assert model.qpos_spring[1] == pytest.approx(0.35)
    assert model.tendon_stiffness[0] == pytest.approx(4.0)
    np.testing.assert_allclose((model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1]), (6.1, -6.1))
    assert model.actuator_gainprm[1, 0] == pytest.approx(1.2)
    assert model.opt.gravity[2] == pytest.approx(-9.5)
    (again,) = arm.function.models({}, 1)  # nothing of the lane before is left
    np.testing.assert_array_equal(again.body_inertia, plain.body_inertia)
    np.testing.assert_array_equal(again.opt.gravity, plain.opt.gravity)


def test_parameters_have_the_unit_and_prior_of_their_kind_and_the_rest_are_families(arm):
    specs = {spec.name: spec for spec in arm.specs}
    assert (specs["shoulder_stiffness"].unit, specs["shoulder_stiffness"].nominal) == ("N m/rad", 2.0)
    assert specs["shoulder_stiffness"].prior == {"distribution": "LogNormal", "median": 2.0, "sigma": 0.5}
    assert specs["friction"].prior["distribution"] == "HalfNormal"
    assert (specs["mass"].unit, specs["mass"].nominal) == ("-", 1.0)
    assert not {"joint_damping_scale", "body_mass_scale"} & set(arm.families.values())  # these are inferred
    assert specs["joint_armature_scale_elbow"].family == "joint_armature_scale"
    assert {"gravity_x", "gravity_y"} <= set(arm.families)
    assert "gravity_z" not in arm.families


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"parameters": {"a": "joint/elbo/damping"}}, "did you mean 'elbow'"),
        ({"parameters": {"a": "joint/elbow/dampin"}}, "did you mean 'damping'"),
        ({"parameters": {"a": "joints/elbow/damping"}}, "did you mean 'joint'"),
        ({"parameters": {"a": "tendon/*/frictionloss"}}, "no tendon matches"),
        ({"parameters": {"a": {"low": 0.0}}}, "no address"),
        ({"markers": {"m": "tipp"}}, "did you mean 'tip'"),
        ({"channels": {"c": "ss"}}, "did you mean 's'"),
        ({"start": "settle"}, "did you mean 'settled'"),
    ],
)
def test_wrong_names_are_answered_with_the_nearest(tmp_path, given, said):
    with pytest.raises(InputError, match=said):
        MuJoCo(written(tmp_path, ARM), **given)


def test_files_that_are_none(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        MuJoCo(tmp_path / "none.xml")
    with pytest.raises(InputError, match="cannot read"):
        MuJoCo(written(tmp_path, "<mujoco><worldbody><bod/></worldbody></mujoco>"))


def test_a_urdf_is_sent_to_the_format_that_has_actuators(tmp_path):
    """MuJoCo reads none of a URDF, its transmissions included."""
    text = (
        '<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>'
        '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="j" type="continuous"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/></joint>'
        '<transmission name="t"><joint name="j"/><actuator name="m"/></transmission></robot>'
    )
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    said = r"arm.urdf: the model has no actuator.*write arm.xml with the text of mujoco.MjSpec.from_file\('arm.urdf'\)"
    with pytest.raises(InputError, match=said):
        MuJoCo(path, markers={"tip": "body/tip"}, channels={"c": "m"})
    with pytest.raises(InputError, match=said):
        first_tables(path, {}, ["c"])


def test_a_rollout_that_diverges_has_a_status_and_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {
        "k": {
            "address": "joint/slide/stiffness",
            "low": -1e9,
            "prior": {"distribution": "Uniform", "low": 0, "high": 1},
        }
    }
    simulator = BlackBoxSimulator(MuJoCo(written(tmp_path, SPRING), parameters=given))
    commands = sent(simulator, seconds=0.2, size=0.0)
    seen = jax.vmap(lambda k: simulator.rollout({"k": k}, commands))(jnp.array([40.0, -1e8, 50.0]))
    assert seen.status.tolist() == [Result.OK, Result.DIVERGED, Result.OK]
    assert np.isfinite(seen.position[jnp.array([0, 2])]).all()
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_mechanisms_take_the_unit_of_the_commands_and_change_nothing_at_null(spring):
    plain = BlackBoxSimulator(spring)
    names = ["backlash", "command_delay", "spool_growth", "camera_offset"]
    extended = BlackBoxSimulator(spring, mechanisms_named(names, spring))
    units = {spec.name: spec.unit for spec in extended.parameters}
    assert units["backlash"] == "N"
    commands = sent(plain, size=2.0)
    moved = extended.rollout({}, commands).position
    np.testing.assert_allclose(moved, plain.rollout({}, commands).position, atol=1e-12)


def test_a_model_whose_parameter_is_another_joint_s_is_another_model(tmp_path):
    """Its name, bounds and nominal value are the same; what an audit has kept of the one is nothing of the other."""
    path, tables = written(tmp_path, ARM), {"low": 0.01, "high": 0.2, "nominal": 0.05}
    joints = ("shoulder", "shoulder", "elbow")
    given = [{"damping": {"address": f"joint/{joint}/damping", **tables}} for joint in joints]
    one, same, other = (MuJoCo(path, markers=["tip"], parameters=each).function.digest for each in given)
    assert one == same != other


@pytest.mark.parametrize("canonical", [False, True])
def test_a_model_that_is_written_and_read_again_moves_alike(tmp_path, canonical):
    text = ARM
    if canonical:  # what is replicated is no element of the text: MuJoCo's own text of the model is edited
        ball = '<replicate count="2" offset="0.1 0 0"><site name="r"/></replicate>'
        text = ARM.replace("<worldbody>", f"<worldbody>{ball}")
    addresses = {**PARAMETERS, "place": "site/tip/pos_z"}
    box = MuJoCo(written(tmp_path, text), markers=["tip"], parameters=addresses)
    suffix, told = box.function.written({**TRUTH, "place": -0.23}, ["Calibrated.", "k = 1 [0.9, 1.1]"])
    assert suffix == ".xml"
    assert "k = 1 [0.9, 1.1]" in told
    assert canonical or told.count("armature") == 1  # what was not calibrated stays where it was
    (tmp_path / "far").mkdir()
    again = BlackBoxSimulator(MuJoCo(written(tmp_path / "far", told), markers=["tip"]))
    simulator = BlackBoxSimulator(box)
    commands = sent(simulator)
    values = {name: jnp.asarray(value) for name, value in {**TRUTH, "place": -0.23}.items()}
    moved, plain = simulator.rollout(values, commands).position, simulator.rollout({}, commands).position
    np.testing.assert_allclose(again.rollout({}, commands).position, moved, atol=1e-5 if canonical else 1e-10)
    assert np.abs(plain - moved).max() > 0.01


def test_tensions_are_what_actuators_pull_with(tmp_path):
    tendon = SPRING.replace(
        "</worldbody>",
        '<site name="top" pos="0 0 2"/></worldbody><tendon><spatial name="wire"><site site="top"/><site site="tip"/>'
        "</spatial></tendon>",
    ).replace('<motor name="push" joint="slide"', '<motor name="push" tendon="wire" gear="-1"')
    box = MuJoCo(written(tmp_path, tendon), cables={"wire": "push"}, parameters={"k": "joint/slide/stiffness"})
    simulator = BlackBoxSimulator(box)
    seen = simulator.rollout({}, sent(simulator, size=3.0))
    assert simulator.cable_names == ("wire",)
    np.testing.assert_allclose(seen.tension[1:-1, 0], -np.asarray(sent(simulator, size=3.0).step)[1:, 0], atol=1e-12)


def test_a_session_goes_on_as_the_rollout_does(spring):
    simulator = BlackBoxSimulator(spring)
    commands = sent(simulator, seconds=1.0, size=2.0)
    values = {"k": np.array([30.0, 60.0])}
    whole = jax.vmap(lambda k: simulator.rollout({"k": k}, commands).position)(values["k"])
    session = simulator.session(2, 0.1)
    start = session.reset(np.arange(2), values)
    np.testing.assert_allclose(start.position, whole[:, 0], atol=1e-13)
    for period in range(10):
        if period == 5:
            kept = session.save()
            session.act(np.full((2, 1), -2.0))
            session.restore(kept)
        level = np.asarray(commands.step)[100 * period]
        seen = session.act(np.tile(level, (2, 1)))
        np.testing.assert_allclose(seen.position, whole[:, 100 * (period + 1)], atol=1e-12)
        assert seen.status.tolist() == [Result.OK, Result.OK]
    session.reset(np.array([1]), {"k": 45.0})
    np.testing.assert_allclose(session.time, [1.0, 0.0])
    with pytest.raises(InputError, match="not a whole number"):
        simulator.session(2, 0.0105)


def test_mechanisms_act_in_a_session_as_in_the_rollout(spring):
    named = ["command_delay", "actuator_lag", "camera_offset"]
    simulator = BlackBoxSimulator(spring, mechanisms_named(named, spring))
    commands = sent(simulator, seconds=1.0, size=2.0)
    values = {"k": 40.0, "command_delay": 0.034, "actuator_lag": 0.05, "camera_offset_x": 0.002}
    whole = simulator.rollout({name: jnp.asarray(value) for name, value in values.items()}, commands).position
    session = simulator.session(1, 0.1)
    start = session.reset(np.arange(1), values)
    np.testing.assert_allclose(start.position[0], whole[0], atol=1e-13)
    for period in range(10):
        seen = session.act(np.asarray(commands.step)[None, 100 * period])
        np.testing.assert_allclose(seen.position[0], whole[100 * (period + 1)], atol=1e-9)
