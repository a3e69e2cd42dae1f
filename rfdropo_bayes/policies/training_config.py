"""The table [training] of an experiment file."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from rfdropo_bayes.signatures import as_options


class TrainingTable(BaseModel):
    """[training]: a task, options of PPO, and a budget."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    task: Literal["TrunkReach-v0", "TrunkPush-v0"] = Field(
        default="TrunkReach-v0", description="environment in which the policy is trained"
    )
    actions: Literal["continuous", "discrete"] = Field(
        default="continuous", description="a rate for every channel, or one channel moved up or down by a step"
    )
    observation: Literal["full", "paper", "markers"] = Field(
        default="full",
        description="full: centre line, goal, object, cable levels and changes; paper: without cable levels and "
        "changes; markers: the markers seen by motion capture, with cable levels and changes",
    )
    period: float = Field(default=0.05, gt=0.0, description="time from one action to the next [s]")
    step: float | None = Field(
        default=None,
        gt=0.0,
        description="largest change of a command by an action, in the command's unit; 5 mm of cable by default, or a "
        "twentieth of the range of other commands",
    )
    noise: float = Field(default=0.0, ge=0.0, description="white noise on the observed markers [m]")
    tension_limit: float | None = Field(
        default=None,
        gt=0.0,
        description="tension [N] beyond which an episode fails and ends, as drives would stop; none by default",
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of PPO by their names in Stable-Baselines3; also net_arch"
    )
    steps: int = Field(default=1_000_000, ge=1, description="environment steps, over all environments")
    anneal: bool = Field(
        default=False,
        description="lower the learning rate in proportion to the remaining steps, from evaluation to evaluation",
    )
    environments: int = Field(default=128, ge=1, le=4096, description="environments that are simulated at once")
    randomisation: Literal["posterior", "phi", "uniform", "none"] = Field(
        default="none",
        description="source of every episode's parameters: draws of a posterior, RF-DROPO's phi, the ranges of "
        "[training.ranges], or none: nominal and fixed values",
    )
    source: str | None = Field(
        default=None, description="run folder or posterior.nc that the posterior or phi is read from"
    )
    width: float = Field(
        default=1.0,
        gt=0.0,
        le=10.0,
        description=("factor on the distances of posterior or phi draws from their middle, up to hard bounds"),
    )
    ranges: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="lowest and highest value of each parameter, for uniform randomisation"
    )
    start: dict[str, tuple[float, float]] = Field(
        default_factory=dict,
        description="lowest and highest value of parameters that differ between episodes under any randomisation, "
        "such as the cube's position",
    )
    goals: tuple[tuple[float, float, float], tuple[float, float, float]] | None = Field(
        default=None, description="corners of the box that goals are drawn from [m]; the task's own by default"
    )
    evaluate_every: int = Field(
        default=100_000,
        ge=1,
        description="environment steps between evaluations; the policy of the best evaluation is kept, and an "
        "interrupted run resumes from the last",
    )
    evaluation_episodes: int = Field(default=64, ge=1, description="episodes of an evaluation during training")


@as_options
class TrainingOptions(TrainingTable):
    """Options of `rb.train`, `rb.evaluate` and `rb.make_vec`: keys of an experiment file's [training]."""
