"""What tests cost in processor seconds, their children included: `--costs FILE` writes a line for every test.

Wall time says little on a shared machine. With several workers each reports what its own process spent.
"""

from __future__ import annotations

import json
import resource
from collections import defaultdict
from pathlib import Path

import pytest


def spent() -> float:
    """Processor seconds of this process and of its ended children."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


class Costs:
    """Plugin: processor seconds of each phase of each test, summed over its phases."""

    def __init__(self, file: str | None) -> None:
        self.file = file
        self.tests: dict[str, float] = defaultdict(float)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo):
        report = yield
        start = getattr(item.config, "spent_so_far", 0.0)
        item.config.spent_so_far = spent()
        report.processor_seconds = item.config.spent_so_far - start
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.tests[report.nodeid] += getattr(report, "processor_seconds", 0.0)

    def pytest_terminal_summary(self, terminalreporter) -> None:
        total = sum(self.tests.values())
        dear = sorted(self.tests.values(), reverse=True)[:100]
        terminalreporter.write_line(
            f"processor seconds: {spent():.0f} in all, {total:.0f} in {len(self.tests)} tests, {sum(dear):.0f} in the "
            "100 dearest (python tools/yardstick.py says what a second is on this machine)"
        )
        if self.file:
            lines = sorted(self.tests.items(), key=lambda entry: -entry[1])
            Path(self.file).write_text("".join(json.dumps([name, round(cost, 3)]) + "\n" for name, cost in lines))
