"""Write docs/measured.md from tools/measured.md.j2 and the ledgers of the studies and benchmarks.

python tools/measured.py            # write the page
python tools/measured.py --check    # end with status 1 if the page is not what the ledgers say
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from scipy.stats import binomtest

from rfdropo_bayes.files import read_lines

REPOSITORY = Path(__file__).resolve().parents[1]
REPORTS = REPOSITORY / "reports"
PAGE = REPOSITORY / "docs" / "measured.md"


def counted(found: int, of: int) -> dict[str, Any]:
    """A share in words, with its exact 95 % interval in percent."""
    interval = binomtest(found, of).proportion_ci(0.95, method="exact")
    return {"words": f"{found} of {of}", "interval": f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %"}


def counted_by_data_set(held: Sequence[Sequence[bool]]) -> dict[str, Any]:
    """A share of the sizes of all data sets, in words; its 95 % interval by 10,000 bootstraps of the data sets, because
    sizes of one data set share its noise.
    """
    groups = [group for group in held if group]
    found, of = np.array([sum(group) for group in groups]), np.array([len(group) for group in groups])
    again = np.random.default_rng(0).integers(0, len(groups), (10_000, len(groups)))
    low, high = np.percentile(100 * found[again].sum(axis=1) / of[again].sum(axis=1), [2.5, 97.5])
    return {"words": f"{sum(found)} of {sum(of)}", "interval": f"{low:.0f} to {high:.0f} %"}


def two_figures(value: float) -> str:
    """A positive number with two figures, or whole."""
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def robots() -> dict[str, Mapping[str, Any]]:
    """Lines of `benchmarks/robots.py` by run."""
    return {line["run"]: line for line in read_lines(REPORTS / "robots" / "ledger.jsonl")}


def days() -> dict[str, dict[float, Mapping[str, Any]]]:
    """Lines of `benchmarks/leave_out.py` by its pattern, without an asterisk, and the seconds that were shown: smallest
    and largest error [mm] of the recordings that were not shown.
    """
    found: dict[str, dict[float, Mapping[str, Any]]] = {}
    for line in read_lines(REPORTS / "leave_out" / "ledger.jsonl"):
        rows = list(line["recordings"].values())
        rows = rows[1:] if line["seconds"] and len(rows) > 1 else rows
        ends = {
            f"{key}_{end}": of(row[f"{key}_mm"] for row in rows)
            for key in ("error", "held")
            for end, of in (("low", min), ("high", max))
        }
        found.setdefault(line["left_out"].replace("*", ""), {})[line["seconds"]] = {"recordings": len(rows), **ends}
    return found


def audits(*ledgers: str) -> dict[str, Mapping[str, Any]]:
    """Share of audits with the right answer by condition, and of 90 % intervals that hold the size (``sizes``)."""
    lines = [line for ledger in ledgers for line in read_lines(REPORTS / ledger)]
    right: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
        "null": lambda result: result["verdict"] == "no_discrepancy",
        "removed": lambda result: result["verdict"] not in ("explained", "equivalent"),
        "two": lambda result: result["all_named"],
        "rho": lambda result: result["named_first"],
        "rest": lambda result: result["named_first"],
    }
    shares, held = {}, []
    for condition in {line["job"]["condition"] for line in lines}:
        results = [line["result"] for line in lines if line["job"]["condition"] == condition]
        answers = [right[condition.split("_")[0]](result) for result in results]
        shares[condition] = counted(sum(answers), len(answers))
        held += [[h for name, h in r["covered"].items() if name not in r["undetermined"]] for r in results]
    return {**shares, "sizes": counted_by_data_set(held)}


def asl_days() -> list[tuple[float, float]]:
    """Errors [mm] of each day of the ASL trunk: by a fit to the other days, and of its first pose held."""
    found = json.loads((REPORTS / "asl_trunk" / "rod" / "summary.json").read_text(encoding="utf-8"))
    sessions, held = found["unseen_sessions"]["sessions"], found["baselines"]["initial_pose"]["fit"]["recordings"]
    return [(1e3 * error, row["over_time"]) for error, row in zip(sessions.values(), held.values(), strict=True)]


def laws() -> dict[str, Mapping[str, Any]]:
    """Share of audits of effects outside the library with the right port, and with the right kind of law."""
    lines = read_lines(REPORTS / "unknown_effects" / "rod" / "ledger.jsonl")
    lines = [line for line in lines if line["effect"] != "zooming_camera"]  # a mechanism of the library by now
    return {key: counted(sum(line[f"{key}_right"] for line in lines), len(lines)) for key in ("port", "law")}


def strangers(kind: str) -> dict[str, Mapping[str, Any]]:
    """Share of drawn arms whose hidden cause is named first, and of those that hide nothing new whose audit is
    silent.
    """
    lines = [line for line in read_lines(REPORTS / "strangers" / kind / "ledger.jsonl") if "right" in line]
    clean = [line["hidden"] in ("nothing", *line.get("base", [])) for line in lines]
    counts = {
        name: [line["right"] for line, silent in zip(lines, clean, strict=True) if silent == wanted]
        for name, wanted in (("named", False), ("silent", True))
    }
    return {name: counted(sum(rights), len(rights)) for name, rights in counts.items()}


def sizes() -> Mapping[str, Any]:
    """Share of 90 % intervals that hold the size, given the right cause."""
    lines = read_lines(REPORTS / "size_coverage" / "rod.jsonl")
    usual = [line for line in lines if (line["made"], line["noise"]) == ("finer", "repeats")]
    return counted_by_data_set([[abs(size["deviations"]) <= 1.645 for size in line.get("sizes", [])] for line in usual])


def table1(folder: str) -> dict[str, Mapping[str, Any]]:
    """Cells of Table I whose truths are off the centre, by task and row."""
    content = json.loads((REPORTS / "table1" / folder / "table1.json").read_text(encoding="utf-8"))
    return {f"{cell['task']} {cell['row']}": cell for cell in content["cells"] if cell["truths"] == "off-centre"}


def policies(target: str, within: str = "15.25 mm", table: str = "table.md") -> dict[str, str]:
    """Share of episodes that end within a distance by row, with its 95 % interval, from the table of a target of
    `benchmarks/fresh_targets.py`.
    """
    text = (REPORTS / "fresh_targets" / target / table).read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    column = rows[0].index(within)
    return {row[0]: row[column] for row in rows[1:]}


def sbc() -> dict[str, float]:
    """Shares of 90 % intervals that hold parameters of the body, and of the noise [%], and the number of data sets."""
    content = json.loads((REPORTS / "sbc" / "seed_3.json").read_text(encoding="utf-8"))
    shares = {name: 100.0 * row["coverage_90"] for name, row in content["quantities"].items() if row["coverage_90"]}
    noise = [share for name, share in shares.items() if "noise" in name]
    body = [share for name, share in shares.items() if "noise" not in name]
    return {"body": float(np.mean(body)), "noise": float(np.mean(noise)), "datasets": content["datasets"]}


def sofa() -> float:
    """Largest distance from SOFA's recordings [mm]."""
    content = json.loads((REPORTS / "validation" / "validation.json").read_text(encoding="utf-8"))
    found = [row["found"] for row in content["references"] if row["quantity"].endswith("max error [mm]")]
    return max(found)


def page() -> str:
    """The text of docs/measured.md."""
    rates = json.loads((REPORTS / "rollouts" / "device_h200.json").read_text(encoding="utf-8"))["rows"]
    words = Environment(
        loader=FileSystemLoader(REPOSITORY / "tools"),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    words.filters["mm"] = two_figures
    return words.get_template("measured.md.j2").render(
        robots=robots(),
        days=days(),
        asl=asl_days(),
        rest=audits("audit_rest/seeds_1000_1012.jsonl"),
        motion=audits(*(f"audit_power/{folder}/datasets.jsonl" for folder in ("level", "pose", "corrected"))),
        removed=audits("audit_power/pose/datasets.jsonl")["removed_rho_0.5"],  # by the test of the pose
        laws=laws(),
        strangers={kind: strangers(kind) for kind in ("motion", "at_rest")},
        sizes=sizes(),
        inferred=table1("rod"),
        trunk=json.loads((REPORTS / "sim2real_trunk" / "summary.json").read_text(encoding="utf-8")),
        policies=policies,
        sbc=sbc(),
        sofa=sofa(),
        rates=rates,
    )


def main() -> None:
    """Write the page, or compare it."""
    text = page()
    if "--check" in sys.argv[1:]:
        sys.exit(PAGE.read_text(encoding="utf-8") != text)
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
