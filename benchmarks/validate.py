"""References and ours beside them, as a table: `make validate`.

    python benchmarks/validate.py [--out FOLDER] [--without-peers]

Writes validation.md and validation.json. Peers (MuJoCo flex, PyElastica, CalculiX) are run where they are installed.
Ends with status 1 if a reference is missed.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import peers
import references
from references import Reference

from rfdropo_bayes import __version__

GROUPS = (references.large_deflections, references.bar, references.modes, references.sliding, references.recordings)


def gather() -> list[Reference]:
    """All references, in the order of the table."""
    rows: list[Reference] = []
    for group in GROUPS:
        start = time.perf_counter()
        found = list(group())
        rows += found
        failed = sum(not row.passed for row in found)
        print(f"{group.__name__}: {len(found)} references, {failed} missed, {time.perf_counter() - start:.1f} s")
    return rows


def as_markdown(rows: Sequence[Reference], others: Sequence[peers.Peer]) -> str:
    """Both tables."""
    lines = [
        "# Validation of the finite elements",
        "",
        "Written by `make validate`. Tolerances are relative; a reference that is missed is marked.",
        "",
        "| problem | quantity | reference | ours | error | tolerance | source |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        limit = f"{100 * row.tolerance:g} %" if row.sense == "equal" else row.sense
        mark = "" if row.passed else " **missed**"
        error = f"{100 * row.error:+.3g} %" if row.sense == "equal" else ""
        lines.append(
            f"| {row.group} | {row.quantity} | {row.expected:.6g} | {row.found:.6g} | {error}{mark} "
            f"| {limit} | {row.source} |"
        )
    lines += [
        "",
        "## The same bar in other simulators",
        "",
        "Cantilever of 195 x 20 x 20 mm, 0.45 MPa, Poisson ratio 0.45, 1000 kg/m3, let go under its own weight. The",
        "settled tip of the finest solid mesh sags by 94.4 mm, that of the elastica by 94.8 mm.",
        "",
        "| simulator | unknowns | settled sag [mm] | error | s per simulated s |",
        "|---|---|---|---|---|",
    ]
    for peer in others:
        if peer.sag is None:
            lines.append(f"| {peer.name} | | not run: {peer.remark} | | |")
        else:
            error = 100 * (peer.sag / peers.SAG - 1.0)
            cost = "static" if peer.cost is None else f"{peer.cost:.3g}"
            lines.append(f"| {peer.name} | {peer.unknowns} | {1e3 * peer.sag:.2f} | {error:+.2g} % | {cost} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the tables; 1 if a reference is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("reports/validation"))
    parser.add_argument("--without-peers", action="store_true")
    options = parser.parse_args()
    rows = gather()
    others = [] if options.without_peers else peers.settle_all()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "validation.md").write_text(as_markdown(rows, others), encoding="utf-8")
    table = {
        "version": __version__,
        "python": platform.python_version(),
        "references": [row._asdict() | {"error": row.error, "passed": bool(row.passed)} for row in rows],
        "peers": [peer._asdict() for peer in others],
    }
    text = json.dumps(table, indent=1, default=float)
    (options.out / "validation.json").write_text(text + "\n", encoding="utf-8")
    missed = [row for row in rows if not row.passed]
    for row in missed:
        print(f"missed: {row.group}, {row.quantity}: {row.found:.6g} for {row.expected:.6g}", file=sys.stderr)
    print(f"{len(rows) - len(missed)} of {len(rows)} references met; written to {options.out}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
