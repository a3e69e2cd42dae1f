"""Integrators of a time step: the number of linear solves, and the equations of each.

A stage finds the velocity v1 and the position x1 at its end from their values at its start, v and x:

    x1 = x* + p (v1 - v*),    M (v1 - v - carried (v - v')) = p F(x1, v1, T1),    v* = v

F is linearised at x* = x + elapsed v, the position predicted by the velocity; v' is the velocity at the start of the
stage before. Implicit Euler has one stage with p = h. Its forces are taken at the start of the step, x* = x, and x1 = x
+ h v1. SDIRK2 is the L-stable scheme of second order with g = 1 - 1 / sqrt(2) (Alexander 1977, SIAM J. Numer. Anal.
14:1006):

    stage 1: M (V  - v0) = g h F(X, V, T)                                   X  = x0 + g h V,            at t0 + g h
    stage 2: M (v1 - v0) = (1 - g) h F(X, V, T) + g h F(x1, v1, T1)         x1 = x0 + (1 - g) h V + g h v1, at t0 + h

F of stage 1 is M (V - v0) / (g h): carried is (1 - g) / g - 1. Variables with a rate, such as the dashpot of a Prony
branch and mobilised friction, are carried on in the same way.

Quasi-static motion has no time: every row is an equilibrium that is found from the row before (``equilibrium``).

An impact is not a smooth force: extrapolating an impact would make a stopped body rebound. Impulses of contacts that
stop surfaces in stage 1 are therefore not carried on. If surfaces close in stage 2, the velocity of stage 1 has let
them penetrate for most of the step, which stage 2 must not correct within its time g h. Stage 2 is then implicit over
the time since they met, at most the (1 - g) h since stage 1, and carries on less: p = (1 - g) h with nothing carried on
is implicit Euler from the end of stage 1. p is a continuous function of the motion, and all intermediate schemes are of
first order at least.
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

Integrator = Literal["euler", "sdirk2", "quasi-static"]
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""The root that makes SDIRK2 L-stable."""


REBOUND = 0.02
"""[m/s] Change of the speed at which surfaces close that counts half as an impact. They rebound with less than that, by
20 um under gravity."""


class Stage(NamedTuple):
    """One linear solve of a time step; times in time steps."""

    elapsed: float  # that passes in it
    length: float  # p
    carried: float  # share of the change in the stage before with which all goes on
    predicted: bool  # whether forces are taken at the predicted position, else at the start of the stage
    # of a stage with impacts: its p for the motion, in ``length``; variables with memory keep their own
    wide: Any = 1.0

    @property
    def span(self) -> Any:
        """p of the motion."""
        return self.length * self.wide

    @property
    def going(self) -> Any:
        """Share of the earlier stage's velocity change with which the motion continues."""
        return self.carried + 1.0 - self.wide


STAGES: dict[str, tuple[Stage, ...]] = {
    "euler": (Stage(1.0, 1.0, 0.0, False),),
    "sdirk2": (Stage(GAMMA, GAMMA, 0.0, True), Stage(1.0 - GAMMA, GAMMA, (1.0 - 2.0 * GAMMA) / GAMMA, True)),
    "quasi-static": (),  # every row is an equilibrium: no step in time
}
EULER = STAGES["euler"][0]


def timed_stages(integrator: Integrator, time_step: float) -> tuple[int, tuple[Stage, Stage]]:
    """Number of stages of a step, and the stages in seconds; always two entries, so that the same kernel serves all
    integrators.
    """
    stages = STAGES[integrator]
    timed = [s._replace(elapsed=s.elapsed * time_step, length=s.length * time_step) for s in stages]
    return len(stages), (timed[0], timed[-1])
