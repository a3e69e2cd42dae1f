"""Facts about a run beside its posterior: the plain input of summary.json and report.html."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from platform import python_version
from typing import Any

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.report.baselines import BaselineErrors
from rfdropo_bayes.report.object_scores import ObjectScore
from rfdropo_bayes.report.residuals import ResidualCheck

PACKAGES = ("rfdropo_bayes", "jax", "numpyro", "blackjax", "arviz", "numpy", "scipy", "numba")
LEARNING = ("torch", "stable_baselines3", "gymnasium", "onnx", "onnxruntime")  # packages that policies are made with


@dataclass(frozen=True)
class RecordingFacts:
    """One recording as the data section lists it.

    ``masked`` counts marker positions that are left out as faults, of ``positions`` in all; ``seconds`` is its length;
    ``first_command`` names the command before the first row and its evidence; ``left_out`` lists faulty or missing
    data.
    """

    name: str
    split: str
    format: str
    sha256: str
    rows: int
    seconds: float
    sample_time: float
    masked: int
    positions: int
    synthetic: bool
    provenance: str = ""
    first_command: str = ""
    left_out: str = ""

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory, split: str) -> RecordingFacts:
        """Facts of a recording in the role ``split``, "fit" or "test"."""
        attributes = trajectory.dataset.attrs
        mask = trajectory.position_mask
        return cls(
            trajectory.name,
            split,
            str(attributes["format"]),
            trajectory.sha256,
            len(trajectory.time),
            float(trajectory.time[-1]),
            float(attributes["sample_time"]),
            int((~mask).sum()),
            int(mask.size),
            trajectory.synthetic,
            str(attributes["provenance"]),
            trajectory.first_command,
            trajectory.left_out,
        )


@dataclass(frozen=True)
class RunFacts:
    """Everything in summary.json that the posterior itself does not hold.

    Attributes:
        title: title of the experiment.
        robot: name of the robot.
        method: inference method.
        engine: simulator, precision and discretisation in words.
        status: "done", or "interrupted" if the budget or the user ended it early.
        seed: seed of the run.
        rollouts: number of rollouts, in full-length equivalents; ``evaluations``: parameter sets tried.
        seconds: wall time.
        log_evidence: value and standard deviation in nats (NaN: not measured); None if the method has none.
        excluded: parameter sets that got no weight, by reason.
        cautions: reasons to doubt the result.
        recordings: fit first, then test.
        model: label -> words, e.g. mechanisms, noise, fixed values, time step.
        residuals: result of `check_residuals`; empty if the method has no likelihood.
        baselines: result of `baseline_errors`; empty if not computed.
        fitted_commands: test recordings whose commands were also fitted.
        noise_floor: noise between repeats of each marker [m]; None without repeats.
        phi: distribution to randomise over, {name: {mean, std, low, high, unit}}; None without.
        optimum: posterior mode; None without.
        objects: scores of the predicted final position of a pushed object, by unseen recording.
        unseen_sessions: error in sessions that no fit has seen, with the key "sentence" for people; empty for a model
            without sessions.
        limits: further sentences on the limits of this analysis.
        versions: versions of the software.
        details: further values of the method.
        outline: outline of the robot from `robots.robot_shape`, for its picture.
    """

    title: str
    robot: str
    method: str
    engine: str
    status: str
    seed: int
    rollouts: float
    seconds: float
    evaluations: int = 0
    log_evidence: tuple[float, float] | None = None
    excluded: Mapping[str, int] = field(default_factory=dict)
    cautions: Sequence[Caution] = ()
    recordings: Sequence[RecordingFacts] = ()
    model: Mapping[str, str] = field(default_factory=dict)
    residuals: Mapping[str, ResidualCheck] = field(default_factory=dict)
    baselines: Mapping[str, BaselineErrors] = field(default_factory=dict)
    fitted_commands: Sequence[str] = ()
    noise_floor: Mapping[str, float] | None = None
    phi: Mapping[str, Mapping[str, Any]] | None = None
    optimum: Mapping[str, float] | None = None
    objects: Mapping[str, ObjectScore] = field(default_factory=dict)
    unseen_sessions: Mapping[str, Any] = field(default_factory=dict)
    limits: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    outline: Mapping[str, Any] | None = None


def software_versions(further: Sequence[str] = ()) -> dict[str, str]:
    """Versions of Python and of the packages that numbers depend on, including ``further``; missing packages are left
    out.
    """
    versions = {"python": python_version()}
    for name in (*PACKAGES, *further):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
