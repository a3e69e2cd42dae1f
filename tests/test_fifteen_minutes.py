"""What a new user types from the README alone: the commands that are replayed are the README's, and they work."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scripts import script

REPOSITORY = Path(__file__).resolve().parents[1]
SCRIPT = REPOSITORY / "benchmarks" / "fifteen_minutes.py"


def test_the_commands_that_are_replayed_are_those_of_the_readme():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    block = re.search(r"```sh\n(rfdropo init.*?)```", text, re.DOTALL)
    assert block is not None
    told = [shlex.split(line, comments=True)[1] for line in block[1].splitlines()]
    typed = [shlex.split(command)[1] for command in script("benchmarks/fifteen_minutes.py").COMMANDS]
    assert typed == told


@pytest.mark.slow
def test_a_stranger_gets_from_a_csv_to_a_prediction(tmp_path):
    """Six minutes of one processor: the delay is named, and the prediction errs by little more than noise."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, str(SCRIPT), str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "reading and typing" in done.stdout
