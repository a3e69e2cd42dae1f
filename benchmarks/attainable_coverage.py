"""How many off-centre truths of Table I an exact posterior without tensions would hold in its 90 % intervals.

Motion alone leaves the common scale of masses and stiffnesses free. Let all else be known: the posterior is then the
prior along the ridge on which n parameters keep their ratios to each other. With uniform priors its density in the
scale s is proportional to s^(n - 1), between the first bounds that a parameter meets on either side. Whether a truth
lies inside the central 90 % of that is a closed form. Drawn from the prior, 90 % of truths do; drawn off the centre, as
Table I has them, fewer: they are not draws of the prior.

    python benchmarks/attainable_coverage.py
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from studies.virtual_tasks import TASKS, InferenceTask, draw_truth

TRUTHS = 100_000
INSIDE = 0.05, 0.95
RIDGE = ("trunk_mass", "young_modulus", "cube_mass")  # what the common scale of forces is made of

Values = Mapping[str, Float[np.ndarray, " truth"]]


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    print("| task | parameters | truths | inside the exact 90 % interval |\n|---|---|---|---|")
    pooled = []
    for name, task in TASKS.items():
        ridge = tuple(parameter for parameter in RIDGE if parameter in task.ranges)
        _row(name, ridge, "from the prior", held(task, {key: rng.uniform(*task.ranges[key], TRUTHS) for key in ridge}))
        off = _off_centre(task, ridge, rng)
        _row(name, ridge, "off-centre", held(task, off))
        for words, chosen in _corners(task, off):
            _row(name, ridge, f"off-centre, {words}", held(task, off)[chosen])
        known = len(task.ranges) - len(ridge)
        pooled.append((name, (len(ridge) * held(task, off).mean() + 0.9 * known) / len(task.ranges)))
    # Of a parameter that data say nothing of, the ridge is its whole range. A cube that is not pushed leaves two.
    push = TASKS["TrunkPush"]
    rest = {single: held(push, _off_centre(push, (single,), rng)) for single in push.cube}
    for single, inside in rest.items():
        _row("TrunkPush, not pushed", (single,), "off-centre", inside)
    trunk = held(push, _off_centre(push, RIDGE[:2], rng)).mean()
    pooled.append(("TrunkPush, not pushed", (2.0 * trunk + 0.9 + sum(map(np.mean, rest.values()))) / len(push.ranges)))
    for name, share in pooled:
        print(f"| {name} | all, with 90 % of what data determine | off-centre | {share:.1%} |")


def _row(task: str, ridge: tuple[str, ...], truths: str, inside: Bool[np.ndarray, " truth"]) -> None:
    print(f"| {task} | {', '.join(ridge)} | {truths} | {inside.mean():.1%} |")


def _off_centre(task: InferenceTask, ridge: tuple[str, ...], rng: np.random.Generator) -> Values:
    drawn = [draw_truth(task, "off-centre", ridge, rng) for _ in range(TRUTHS)]
    return {key: np.array([truth[key] for truth in drawn]) for key in ridge}


def held(task: InferenceTask, truths: Values) -> Bool[np.ndarray, " truth"]:
    """Whether the scale of each truth lies inside the central interval of the prior along its ridge."""
    down = np.max([task.ranges[name][0] / values for name, values in truths.items()], axis=0)
    up = np.min([task.ranges[name][1] / values for name, values in truths.items()], axis=0)
    power = len(truths)
    share = (1.0 - down**power) / (up**power - down**power)
    return (share > INSIDE[0]) & (share < INSIDE[1])


def _corners(task: InferenceTask, truths: Values) -> list[tuple[str, Bool[np.ndarray, " truth"]]]:
    """Mass and stiffness low or high."""
    upper = {name: truths[name] > np.mean(task.ranges[name]) for name in ("trunk_mass", "young_modulus")}
    words = ("low", "high")
    return [
        (
            f"mass {words[heavy]}, stiffness {words[stiff]}",
            (upper["trunk_mass"] == heavy) & (upper["young_modulus"] == stiff),
        )
        for heavy in (0, 1)
        for stiff in (0, 1)
    ]


if __name__ == "__main__":
    main()
