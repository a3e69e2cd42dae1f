"""Base class of the tables of a robot file: no unknown keys, no infinities, immutable."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Vector = Annotated[tuple[float, float, float], Field(description="x, y, z in the frame of the robot's base")]


Pair = tuple[float, float]


Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


Positive = Annotated[float, Field(gt=0.0)]


class RobotTable(BaseModel):
    """A table of a robot file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
