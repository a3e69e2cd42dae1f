"""A policy for a MuJoCo arm: what it may command, what it sees, and training from end to end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.rendering import picture
from rfdropo_bayes.simulators.black_box import ACTION

pytest.importorskip("mujoco")

ARM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper"><joint name="drive" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.05"/>
      <body name="lower" pos="0 0 -0.1"><joint name="elbow" axis="1 0 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.008" mass="0.03"/><site name="tip" pos="0 0 -0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="a" joint="drive" kp="4" kv="0.2" ctrlrange="-1 1"/>
    <position name="b" joint="elbow" kp="4" kv="0.2" ctrlrange="-0.5 1.5"/>
  </actuator>
</mujoco>"""
GOALS = [[-0.08, -0.06, -0.19], [0.08, 0.06, -0.15]]
TASK = "TrunkReach-v0"


def model_of(
    folder: Path, text: str = ARM, mechanisms: tuple[str, ...] = (), cables: dict[str, str] | None = None
) -> rb.Model:
    path = folder / "arm.xml"
    path.write_text(text)
    arm = rb.MuJoCo(path, markers={"tip": "tip"}, parameters={"damping": "joint/elbow/damping"}, cables=cables)
    return rb.Model(arm, priors={"damping": {}}, mechanisms=list(mechanisms))


def test_commands_stay_in_the_range_of_the_actuators_and_move_by_a_share_of_it(tmp_path):
    venv = rb.make_vec(TASK, model_of(tmp_path, mechanisms=("actuator_lag",)), rb.TrainingOptions(goals=GOALS), n=2)
    layout = venv.layout
    assert (layout.unit, layout.low, layout.high) == ("rad", (-1.0, -0.5), (1.0, 1.5))
    np.testing.assert_allclose(layout.moves, [[2.0 * ACTION, 2.0 * ACTION]])
    venv.seed(0)
    first = venv.reset()
    assert first.shape == (2, layout.size)
    for _ in range(30):
        seen, _, _, infos = venv.step(np.ones((2, 2), dtype=np.float32))
    np.testing.assert_allclose(venv.episodes.commands, [[1.0, 1.5]] * 2)
    assert np.isfinite(seen).all()
    assert not any(info["diverged"] for info in infos)
    tip = venv.episodes.marker[0, -1]
    assert np.linalg.norm(tip) == pytest.approx(0.2, abs=0.06)
    assert picture(venv.episodes, 0).std() > 1.0


@pytest.mark.parametrize(
    ("text", "changes", "said"),
    [
        (ARM, {"goals": None}, "the task has no goals for this robot"),
        (ARM, {"task": "TrunkPush-v0"}, "has no cube to push"),
        (ARM.replace(' ctrlrange="-1 1"', ""), {}, "nothing limits the command 'a'"),
        (ARM, {"tension_limit": 1.0}, "gives no cable tensions between two actions; name its cables"),
    ],
)
def test_what_a_task_needs_is_said(tmp_path, text, changes, said):
    with pytest.raises(InputError, match=said):
        rb.make_vec(
            changes.get("task", TASK), model_of(tmp_path, text), rb.TrainingOptions(**{"goals": GOALS, **changes}), n=1
        )


@pytest.mark.slow
def test_the_pull_of_an_actuator_is_told_and_limited_where_it_is_named_a_cable(tmp_path):
    """An episode's largest pull is that of a whole rollout, the force that a new command exerts at once included."""
    model = model_of(tmp_path, cables={"b": "b"})
    told, commands = {}, []
    for limit in (None, 0.2):
        venv = rb.make_vec(TASK, model, rb.TrainingOptions(goals=GOALS, tension_limit=limit), n=2)
        venv.seed(0)
        venv.reset()
        begun, told[limit] = venv.reset_infos[0]["parameters"], []
        for up in (1.0, -1.0, 1.0, -1.0):
            _, _, done, infos = venv.step(np.array([[0.0, up], [0.0, 0.0]], dtype=np.float32))
            told[limit].append(infos[0]["tension"])
            assert (done == [infos[0]["stopped"], False]).all()
            if done[0]:
                break
            if limit is None:
                commands.append(venv.episodes.commands[0].copy())
    assert told[0.2] == told[None][:2]
    assert told[None][1] > 0.2 > told[None][0]
    simulator, steps = venv.episodes.simulator, round(0.05 / 0.005)
    whole = []
    for count in range(1, 5):
        every = 0.005 * np.arange(steps * count + 1)
        given = simulator.commands(0.05 * np.arange(count), np.array(commands[:count]), np.zeros(2), every)
        whole.append(np.asarray(simulator.rollout(begun, given).tension)[-steps - 1 :].max())
    np.testing.assert_allclose(told[None], whole, atol=1e-9)


@pytest.mark.slow
def test_a_policy_is_trained_evaluated_and_filmed(tmp_path):
    model = model_of(tmp_path, mechanisms=("actuator_lag",), cables={"b": "b"})
    sizes = {"steps": 2048, "environments": 8, "evaluate_every": 2048, "evaluation_episodes": 8}
    drawn = {"randomisation": "uniform", "ranges": {"damping": [0.005, 0.02], "actuator_lag": [0.0, 0.05]}}
    options = rb.TrainingOptions(task=TASK, goals=GOALS, tension_limit=50.0, **sizes, **drawn)
    summary = rb.train(model, tmp_path / "policy", options, show=False)
    assert summary["integrator"].startswith("mujoco ")
    assert (tmp_path / "policy" / "report.html").stat().st_size > 10_000
    found = rb.evaluate(model, [tmp_path / "policy"], tmp_path / "evaluation", episodes=8)
    assert found["policies"]["policy"]["diverged"] == 0
    assert (found["tension_limit_n"], found["otherwise_trained"]) == (50.0, [])
    assert (tmp_path / "evaluation" / "policy.gif").stat().st_size > 1000
    model = model_of(tmp_path, mechanisms=("actuator_lag",))
    found = rb.evaluate(model, [tmp_path / "policy"], tmp_path / "no_cables", episodes=8, film=False)
    assert found["tension_limit_n"] is None
    assert "tension_limit of 50 N is left out: the model has no cables" in found["otherwise_trained"][0]
    asked = rb.TrainingOptions(tension_limit=50.0)
    with pytest.raises(InputError, match="gives no cable tensions"):
        rb.evaluate(model, [tmp_path / "policy"], tmp_path / "asked", asked, episodes=8, film=False)
