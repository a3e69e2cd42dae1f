"""Simulators: the same call for every engine."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()

from rfdropo_bayes.simulators.commands import Commands, commands_on_grid, stack_commands  # noqa: E402
from rfdropo_bayes.simulators.parameters import ParameterSpec  # noqa: E402
from rfdropo_bayes.simulators.protocol import Observation, Result, Simulator  # noqa: E402
