"""Scripts of the repository as modules, for tests of what they compute."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

REPOSITORY = Path(__file__).resolve().parents[1]


def script(path: str) -> ModuleType:
    """A script, by its path in the repository."""
    found = importlib.util.spec_from_file_location(Path(path).stem, REPOSITORY / path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[found.name] = module  # dataclasses look their module up
    found.loader.exec_module(module)
    return module
