"""Environments by their names in Gymnasium."""

from __future__ import annotations

NAMES = ("TrunkReach-v0", "TrunkPush-v0")


def register() -> None:
    """Register the tasks for ``gymnasium.make``."""
    import gymnasium

    for name in NAMES:
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point="rfdropo_bayes.policies.gym_env:TrunkEnv", kwargs={"task": name})
