"""What the pulses and ramps of the ASL trunk say of friction, creep and delay without any model (README.md)."""

import os
from pathlib import Path

import numpy as np

from rfdropo_bayes.data.asl_csv import read_asl_csv


def recording(observations: str, commands: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tip disk [mm], motor angles and commands [degrees]; rows of 10 ms."""
    folder = Path(os.environ["RFDROPO_DATA"]) / "asl_trunk"
    read = read_asl_csv(folder / f"observations_{observations}.csv.gz", folder / f"control_inputs_{commands}.csv.gz")
    return 1e3 * read.position[:, 2], np.rad2deg(read.motor_angle), np.rad2deg(read.command)


def apart(poses: np.ndarray) -> float:
    """Root mean square distance from the mean."""
    return float(np.sqrt(np.sum((poses - poses.mean(axis=0)) ** 2, axis=1).mean()))


def pulses() -> None:
    """Delay and creep: ten identical pulses, 5 s on, 5 s off."""
    tip, angle, _ = recording("motor2_test_allmotors", "controlled_20")
    on = 499 + 1000 * np.arange(10)
    changes = [*on, *on[:-1] + 500]
    moved = [np.flatnonzero(np.linalg.norm(tip[k : k + 100] - tip[k], axis=1) > 0.5)[0] for k in changes]
    turned = [np.flatnonzero(np.abs(angle[k : k + 100, 1] - angle[k, 1]) > 1.0)[0] for k in changes]
    for name, rows in (("tip moves by 0.5 mm", moved), ("motor 2 turns by 1 degree", turned)):
        print(f"{name} {10 * np.mean(rows):.0f} +- {10 * np.std(rows):.0f} ms after a command")
    pose, turn = (np.array([x[k + 478 : k + 498].mean(axis=0) for k in on]) for x in (tip, angle))
    rest = np.array([tip[k + 970 : k + 990].mean(axis=0) for k in on[:-1]])
    early = np.array([tip[k + 300 : k + 320].mean(axis=0) for k in on])
    print("held pose against the first [mm]:", np.linalg.norm(pose - pose[0], axis=1).round(1))
    print("rest pose against the first [mm]:", np.linalg.norm(rest - rest[0], axis=1).round(1))
    print(
        "motor angles against those of the second pulse, at most [degrees]:", np.abs(turn - turn[1])[1:].max().round(2)
    )
    print("drift from 3.1 to 4.9 s of each hold [mm]:", np.linalg.norm(pose - early, axis=1).round(1))


def ramps() -> None:
    """Friction: where the tip rests after each ramp."""
    tip, angle, command = recording("controlled_11", "controlled_11")
    still = np.all(np.abs(command) < 1e-6, axis=1).astype(int)
    edges = np.flatnonzero(np.diff(still, prepend=0, append=0)).reshape(-1, 2)
    ends = [end for start, end in edges if end - start > 100]
    gain = np.linalg.lstsq(np.c_[angle, np.ones(len(angle))], tip, rcond=None)[0][:6]  # mm per degree
    rest, turn = (np.array([x[end - 60 : end].mean(axis=0) for end in ends]) for x in (tip, angle))
    left = rest - turn @ gain
    print(f"rest poses about their mean {apart(rest):.1f} mm, less what the motors' angles move {apart(left):.1f} mm")
    within = [np.linalg.norm(tip[end - 60 : end].std(axis=0)) for end in ends]
    drift = [np.linalg.norm(tip[e - 20 : e].mean(axis=0) - tip[e - 120 : e - 100].mean(axis=0)) for e in ends]
    print(f"within the last 0.6 s {np.mean(within):.2f} mm")
    print(f"moved in the last second {min(drift):.2f} to {max(drift):.2f} mm")
    sides = []
    for end, pose in zip(ends[1:], rest[1:], strict=True):
        before = command[max(end - 700, 0) : end - 200]
        way = before[np.argmax(np.abs(before).sum(axis=1))] @ gain
        sides.append((pose - rest.mean(axis=0)) @ way / np.linalg.norm(way))
    print(f"on the side it came from {np.mean(sides):.1f} +- {np.std(sides, ddof=1) / np.sqrt(len(sides)):.1f} mm")


if __name__ == "__main__":
    pulses()
    ramps()
