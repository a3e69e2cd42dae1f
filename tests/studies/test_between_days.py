"""Two days of one arm, with one thing changed between them: it is named, with its size. Fixed seed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.noise import Noise, draw_noise
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.data import Measured, Origin, SentCommands
from rfdropo_bayes.model.experiment import CommandsTable
from rfdropo_bayes.verbs.simulate import random_walk

SIMULATOR = {"refine": 1, "time_step": 0.01}
PRIORS = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
    "trunk_mass": {"distribution": "LogNormal", "median": 0.09, "sigma": 0.3},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.7},
}
TRUTH = {"young_modulus": 1.8e6, "trunk_mass": 0.1, "rayleigh_stiffness": 0.06}
ROWS, STEP, NOISE, MEMORY = 81, 0.05, 5e-4, 0.1
SHOP: dict = {}


def days(mechanisms: list[str], change: dict[str, float], seed: int) -> list[rb.Trajectory]:
    """Three recordings of each day, two of which repeat one command sequence."""
    model = rb.Model("smooth_arm", priors=PRIORS, mechanisms=mechanisms, simulator=SIMULATOR)
    table = CommandsTable(
        duration=4.0, interval=0.2, step=0.0025, low=0.0, high=0.01, sample_time=STEP, recordings=["any"]
    )
    rng, time = np.random.default_rng(seed), STEP * np.arange(ROWS)
    sequences = [random_walk(table, 4, rng) for _ in range(2)]
    blank = [
        rb.Trajectory.build(
            Origin(name=f"{day}_{name}", robot="smooth_arm", format="netcdf", synthetic=True),
            SentCommands(
                command_time=sequences[k][0],
                command=sequences[k][1],
                command_unit="m",
                cable_names=model.robot.channel_names,
            ),
            Measured(
                time=time,
                position=np.tile(model.robot.marker_points(), (ROWS, 1, 1)),
                marker_names=model.robot.marker_names,
            ),
        )
        for day in ("january", "april")
        for name, k in (("a1", 0), ("a2", 0), ("b", 1))
    ]
    commands = gather_recordings(model.simulator, blank).commands
    found = []
    for index, recording in enumerate(blank):
        values = TRUTH | (change if recording.name.startswith("april") else {})
        own = jax.tree.map(lambda part, i=index: part[i], commands)
        shown = model.simulator.rollout({name: jnp.asarray(value) for name, value in values.items()}, own)
        key = jax.random.key(100 * seed + index)
        noise = draw_noise(key, jnp.asarray(time), 4, Noise(jnp.asarray(NOISE), jnp.asarray(MEMORY)))
        dataset = recording.dataset.copy()
        dataset["position"] = dataset["position"].copy(data=np.asarray(shown.position) + np.asarray(noise))
        found.append(rb.Trajectory(dataset))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mechanisms", "change", "size"),
    [
        (["payload"], {"payload_mass": 0.01}, "payload_mass@april_over_young_modulus"),
        ([], {"initial_displacement_left": 0.0015}, "initial_displacement_left_deviation@april"),
        (["command_delay"], {"command_delay": 0.06}, "command_delay@april"),
        ([], {}, ""),
    ],
)
def test_what_changed_between_two_days_is_named_with_its_size(mechanisms, change, size):
    """Sizes within four deviations: one seed in 10^4. Nothing changed: called a discrepancy in one of 100."""
    model = rb.Model(
        "smooth_arm", priors=PRIORS, simulator=SIMULATOR, groups={"january": "january_*", "april": "april_*"}
    )
    found = rb.audit(model, days(mechanisms, change, 0), between=["january", "april"], workshop=SHOP)
    if not change:
        assert found.verdict == "no_discrepancy"
        return
    ((name, truth),) = change.items()
    (difference,) = found.content["between"]["differences"]
    assert difference["group"] == "april"
    assert difference["mechanism"] == (mechanisms[0] if mechanisms else name)
    known = {**difference["parameters"], **difference["relative"]}[size]
    truth /= TRUTH["young_modulus"] if size.endswith("young_modulus") else 1.0
    assert abs(known["mean"] - truth) < 4.0 * known["sd"]
    assert found.content["gain"]["explained_fraction_interval"][0] > 0.8
