"""Run parts of `make test-all`, and write what each found into `reports/checks/parts.csv`, with its commit.

python tools/parts.py test-slow matrix
"""

from __future__ import annotations

import argparse
import csv
import datetime
import re
import resource
import subprocess
import sys
from collections import Counter
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
LEDGER = REPOSITORY / "reports" / "checks" / "parts.csv"
PARTS = ("test", "test-slow", "test-studies", "test-typed", "test-portable", "test-compiler", "matrix", "notebooks")
COUNTED = ("passed", "failed", "error", "skipped")
COLUMNS = ("part", "commit", "date", *COUNTED, "processor_seconds", "yardstick")
SUMMARY = re.compile(r"^=*\s*\d+ (?:passed|failed|errors?|skipped|deselected)\b.* in [\d.]+s.*$", re.MULTILINE)


def counts_of(output: str) -> Counter[str]:
    """How many tests passed, failed and so on, over all summaries of pytest in an output."""
    found: Counter[str] = Counter()
    for line in SUMMARY.findall(output):
        for count, word in re.findall(r"(\d+) ([a-z]+)", line):
            found[word.removesuffix("s") if word == "errors" else word] += int(count)
    return found


def spent() -> float:
    """Processor seconds of the programs that have been run here."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def commit() -> str:
    """The commit that is checked out, marked if files other than the ledger differ from it."""

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *words], cwd=REPOSITORY, capture_output=True, text=True)

    changed = git("diff", "--quiet", "HEAD", "--", ".", f":!{LEDGER.relative_to(REPOSITORY)}").returncode
    return git("rev-parse", "--short=12", "HEAD").stdout.strip() + ("+changes" if changed else "")


def run(command: list[str]) -> tuple[str, int]:
    """What a command prints, which is shown as well, and its status."""
    lines = []
    with subprocess.Popen(
        command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as running:
        assert running.stdout is not None
        for line in running.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    return "".join(lines), running.returncode


def append(row: dict[str, object]) -> None:
    """Add a line to the ledger."""
    LEDGER.parent.mkdir(parents=True, exist_ok=True)
    new = not LEDGER.exists()
    with LEDGER.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def main() -> None:
    """Run the parts that are named; exit with status 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="+", choices=PARTS, metavar="PART", help=", ".join(PARTS))
    failed, at = [], commit()
    for part in parser.parse_args().parts:
        before = spent()
        output, status = run(["make", part])
        seconds = spent() - before
        yardstick, _ = run([sys.executable, "tools/yardstick.py"])
        found, unit = counts_of(output), re.search(r"yardstick: ([\d.]+)", yardstick)
        append(
            {
                "part": part,
                "commit": at,
                "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
                **{name: found[name] for name in COUNTED},
                "processor_seconds": round(seconds),
                "yardstick": unit[1] if unit else "",
            }
        )
        failed += [part] if status else []
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
