"""Rollouts of the JAX rod on this device, by lanes: 20 elements, 8 cables, 100 steps of 10 ms, in double precision.

    python benchmarks/device_rollouts.py [--lanes 1,64,4096] [--json FILE]

Prints a table with the device's name: seconds to compile and run once, rollouts a second (the better of two runs), and
for 64 lanes the largest difference of the tip from the same rollouts on the host's processor.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rfdropo_bayes import fem

LENGTH, HALF_WIDTH, ELEMENTS, CABLES, STEPS, TIME_STEP = 0.2, 0.01, 20, 8, 100, 0.01
LANES = (1, 8, 64, 512, 4096, 16_384, 65_536)
COMPARED = 64


def tip(young_modulus: jax.Array, density: jax.Array) -> jax.Array:
    """Place of the tip [m] after a second of growing pulls, and whether all went well."""
    body = fem.uniform_rod(LENGTH, HALF_WIDTH, HALF_WIDTH, ELEMENTS)
    angle = 2 * np.pi * np.arange(CABLES) / CABLES
    circle = 0.008 * np.stack([np.cos(angle), np.sin(angle), np.zeros(CABLES)], axis=1)
    height = np.array([0.0, 0.0, 1.0])
    guides = [place + height * body.station[2::2, None] for place in circle]
    system = fem.System(body, fem.cable_layout(body, circle - 0.01 * height, guides))
    material = fem.material(
        system, young_modulus=young_modulus, poisson_ratio=0.45, density=density, rayleigh_mass=0.1,
        rayleigh_stiffness=0.02, gravity=(9.81, 0.0, 0.0),
    )  # fmt: skip
    share = np.arange(1, STEPS + 1)[:, None] / STEPS
    pulls = 0.01 * share * np.sin(2 * np.pi * share + np.pi / 2 * np.arange(CABLES))
    points = fem.attach(body, LENGTH * height[None])
    start = fem.state_at_rest(system)
    found = fem.simulate(system, fem.prepare(system, material), start, jnp.asarray(pulls)[:, None], TIME_STEP, points)
    return jnp.append(found.position[-1, 0], (found.converged & ~found.diverged).astype(float))


def drawn(lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Moduli [Pa] and densities [kg/m3] of so many rollouts."""
    share = (np.arange(lanes) + 0.5) / lanes
    return 4e5 + 4e5 * share, 900.0 + 300.0 * (7.0 * share % 1.0)


def measured(lanes: int, device: Any) -> tuple[dict[str, float], np.ndarray]:
    """Seconds and rates of so many lanes, and where their tips were."""
    given = [jax.device_put(part, device) for part in drawn(lanes)]
    run = jax.jit(jax.vmap(tip))
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        found = run(*given).block_until_ready()
        seconds.append(time.perf_counter() - start)
    places = np.asarray(found)
    if not places[:, 3].all():
        raise SystemExit(f"{int((1 - places[:, 3]).sum())} of {lanes} rollouts did not end well")
    row = {"lanes": lanes, "first_s": seconds[0], "run_s": min(seconds[1:]), "per_s": lanes / min(seconds[1:])}
    return row, places[:, :3]


def main() -> None:
    """Print the table; see the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", default=",".join(map(str, LANES)))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    device, host = jax.devices()[0], jax.devices("cpu")[0]
    print(f"{device.device_kind}, JAX {jax.__version__}, double precision", flush=True)
    heads = ("lanes", 8), ("first run [s]", 15), ("run [s]", 10), ("rollouts/s", 13), ("tip from host [mm]", 21)
    print("".join(f"{head:>{width}s}" for head, width in heads), flush=True)
    rows = []
    for lanes in map(int, asked.lanes.split(",")):
        row, places = measured(lanes, device)
        if device != host and lanes == COMPARED:
            row["from_host_mm"] = 1e3 * float(np.abs(places - measured(lanes, host)[1]).max())
        difference = f"{row['from_host_mm']:.1e}" if "from_host_mm" in row else "-"
        print(f"{lanes:8d}{row['first_s']:15.1f}{row['run_s']:10.3f}{row['per_s']:13.0f}{difference:>21s}", flush=True)
        rows.append(row)
        if asked.json:
            found = {"device": device.device_kind, "jax": jax.__version__, "rows": rows}
            asked.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
