"""Every example runs, checks its own number, and draws its picture."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
ALONE = {"pyelastica_rod", "soromox_arm"}  # need packages of their own; tests/simulators/test_adapters.py runs them
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))
MOST_LINES = 60


@pytest.mark.notebook
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in ALONE])
def test_an_example_runs(name: str, tmp_path: Path) -> None:
    picture = tmp_path / f"{name}.png"
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), str(picture)]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    with Image.open(picture) as drawn:
        assert len(drawn.convert("RGB").getcolors(1 << 24) or []) > 50


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ALONE])
def test_an_example_is_short(name: str) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= MOST_LINES


def test_the_list_names_every_example() -> None:
    listed = (EXAMPLES / "README.md").read_text()
    assert [name for name in NAMES if f"]({name}.py)" not in listed] == []


def test_the_gallery_shows_every_example() -> None:
    gallery = (EXAMPLES.parent / "docs" / "gallery.md").read_text()
    shown = [name for name in NAMES if f"(../examples/{name}.py)" in gallery]
    assert sorted({*shown, *ALONE}) == NAMES
    for name in shown:
        with Image.open(EXAMPLES.parent / "docs" / "images" / "gallery" / f"{name}.png") as drawn:
            assert drawn.width >= 400
