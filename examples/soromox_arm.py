"""An arm of soromox in the robot's place: ``robot = "soromox_arm.py:arm"`` in an experiment file beside this one.

It hangs from its base and starts straight; tensions of three tendons are the commands, and three places along it are
measured. Run by itself, it hides a payload in soromox's own arm and audits that. Needs ``pip install soromox``.
"""

from __future__ import annotations

from collections.abc import Mapping

import rfdropo_bayes as rb  # before soromox, which starts JAX

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from soromox.actuation import ThreadlikeActuator, ThreadlikeRouting
from soromox.systems.components import IsotropicMaterialParams, LinkSpec
from soromox.systems.pcs import PCS, PCSStructure

jax.config.update("jax_enable_x64", True)
LENGTH, PLATE, RADIUS, OFFSET = 0.3, 0.01, 0.01, 0.008  # [m]: of the arm, of the rigid plate at its tip, of tendons
MARKERS = {"first": 0.1, "second": 0.2, "tip": LENGTH + PLATE}  # [m] along the arm
TENDONS = ["a", "b", "c"]
BENDS = [False, True, True, False, False, False]  # of torsion, two bends, stretch and two shears
RUNGE_KUTTA = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])


def arm(pieces: int = 2, time_step: float = 0.01) -> rb.BlackBox:
    """The simulator; ``pieces`` of constant bend and ``time_step`` may stand in [adapter].

    Half of this time step moves the tip by 0.01 mm at most. Three pieces need a quarter of it, as waves in shorter
    pieces die out faster than an explicit step can follow.
    """
    own = {"radius": RADIUS, "density": 1e3, "reference_strain": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]}
    own |= {"young_modulus": 1e6, "poisson_ratio": 0.45, "material_damping_coefficient": 1.0}
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    around = np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    robot = PCS.from_links(
        [LinkSpec.circular(length=length, **own) for length in (*pieces * [LENGTH / pieces], PLATE)],
        structure=PCSStructure(strain_selector=pieces * BENDS + 6 * [False]),
        actuators=ThreadlikeActuator.tendons(ThreadlikeRouting.linear(intercept=around, end_segment_index=pieces - 1)),
        base_pose=jnp.array([0.0, 0.5**0.5, 0.0, 0.5**0.5, 0.0, 0.0, 0.0]),  # the arm's axis points down
    )
    places, count = jnp.array([*MARKERS.values()]), robot.num_coordinates

    def made(given: Mapping[str, jax.Array]) -> PCS:
        plate = given["tip_mass"] / (np.pi * RADIUS**2 * PLATE)
        density = jnp.append(jnp.full(pieces, given["density"]), plate)
        material = IsotropicMaterialParams(given["young_modulus"], None, 0.45, given["damping"])
        body = robot.update_link_params(density=density).with_isotropic_material(material)
        transmission = robot.actuators[0].params.transmission
        offset = jnp.stack([given[f"offset_{tendon}"] for tendon in TENDONS])
        routing = transmission.routing.replace(intercept=offset[:, None] * around)
        return body.update_actuator_params(0, transmission=transmission.replace(routing=routing))

    def simulate(given: Mapping[str, jax.Array], command: jax.Array) -> jax.Array:
        body = made(given)

        def advance(state: jax.Array, pull: jax.Array) -> tuple[jax.Array, jax.Array]:
            def stage(carry: tuple, weight: jax.Array) -> tuple:
                slope = body.forward_dynamics(0.0, state + time_step * weight[0] * carry[0], (pull,))
                return (slope, carry[1] + time_step * weight[1] * slope), None

            state = jax.lax.scan(stage, (jnp.zeros_like(state), state), RUNGE_KUTTA)[0][1]
            return state, state

        rest = jnp.zeros(2 * count)
        states = jax.lax.scan(advance, rest, command[1:])[1]
        poses = jax.vmap(lambda state: body.forward_kinematics_abscissa_batched(state[:count], places))
        return poses(jnp.concatenate([rest[None], states]))[:, :, :3, 3]

    def table(unit: str, low: float, median: float, high: float, sigma: float) -> dict:
        prior = {"distribution": "LogNormal", "median": median, "sigma": sigma}
        return {"unit": unit, "low": low, "high": high, "nominal": median, "prior": prior}

    parameters = {
        "young_modulus": table("Pa", 2e5, 1e6, 5e6, 0.4),
        "density": table("kg/m3", 700.0, 1100.0, 2000.0, 0.1),
        "damping": table("Pa s", 500.0, 5000.0, 1.5e4, 0.5),
        "tip_mass": table("kg", 5e-4, 0.003, 0.1, 0.7),
        **{f"offset_{tendon}": table("m", 0.003, OFFSET, 0.0099, 0.1) for tendon in TENDONS},
    }
    return rb.BlackBox(
        jax.jit(jax.vmap(simulate)),
        parameters=parameters,
        markers=[*MARKERS],
        channels=TENDONS,
        time_step=time_step,
        command_unit="N",
        name="soromox arm",
        batched=True,
        lanes=8,
        one_shape=True,
        families={"tip_mass": "tip_mass", **{f"offset_{tendon}": "offset" for tendon in TENDONS}},
    )


if __name__ == "__main__":
    box, noise = arm(), {"standard_deviation": 5e-4}
    priors: dict[str, dict] = {name: {} for name in ("young_modulus", "density", "damping")}
    model = rb.Model(box, priors=priors, noise=noise)
    walk = {"duration": 1.5, "interval": 0.25, "step": 1.0, "low": 0.0, "high": 2.0, "sample_time": 0.05}
    truth = {"young_modulus": 1.2e6, "damping": 4000.0, "tip_mass": 0.02}
    runs = rb.simulate(model, {**walk, "recordings": ["one", "two", "three"]}, parameters=truth, noise=noise, seed=1)
    found = rb.audit(model, runs[:2], test=runs[2:], seed=0)
    print(found.sentence)
    print(found.findings[["mean", "q05", "q95", "unit"]], "hidden:", truth)
