"""How often an audit says where an effect enters that the library lacks, and by what law; resumable.

    python benchmarks/unknown_effects.py [--out reports/unknown_effects] [--effects crosstalk,bouc_wen] [--seeds 0,1]
                                         [--rho 1.0] [--null 0]

Effects are those of `rfdropo_bayes/studies/unknown_effects.py`, hidden in recordings of the layered arm; ``--null`` is
the number of data sets with nothing hidden. A line of the ledger for each data set: verdict, port, law, unseen errors,
and seconds. A data set in the ledger is not run again. One takes one to four minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import rfdropo_bayes as rb
from rfdropo_bayes.files import append_line
from rfdropo_bayes.studies.unknown_effects import EFFECTS, conceal


def one(name: str, rho: float, seed: int, folder: Path) -> dict[str, Any]:
    """A data set, audited."""
    line: dict[str, Any] = {"effect": name, "rho": rho, "seed": seed}
    hidden = conceal(name, rho, seed, folder / f"{name or 'nothing'}_{rho:g}_{seed}")
    if hidden is None:
        return {**line, "verdict": "no size reaches this rho"}
    model = rb.Model.read(hidden.experiment)
    unseen = rb.read(str(hidden.experiment.parent / "test_*.nc"), format="netcdf")
    began = time.monotonic()
    found = rb.audit(model, test=unseen, seed=seed)
    law, effect = found.content.get("law"), EFFECTS.get(name)
    line |= {"size": hidden.size, "verdict": found.verdict, "sentence": found.sentence}
    line |= {"law": law, "findings": [row["mechanism"] for row in found.content["findings"]]}
    line |= {"seconds": round(time.monotonic() - began, 1)}
    if law and effect:
        line["port_right"] = law["terms"][0]["port"] in effect.ports
        line["law_right"] = law["terms"][0]["feature"] in effect.leading
    return line


def main() -> None:
    """Run what the ledger lacks, and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("reports/unknown_effects"))
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--rho", type=float, default=1.0)
    parser.add_argument("--null", type=int, default=0)
    given = parser.parse_args()
    cases = [
        (name, given.rho, int(seed)) for seed in given.seeds.split(",") for name in given.effects.split(",") if name
    ]
    cases += [("", 0.0, seed) for seed in range(given.null)]
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / "ledger.jsonl"
    lines = [json.loads(line) for line in ledger.read_text().splitlines()] if ledger.exists() else []
    known = {(line["effect"], line["rho"], line["seed"]) for line in lines}
    for case in cases:
        if case not in known:
            lines.append(one(*case, given.out / "data"))
            append_line(ledger, json.dumps(lines[-1]))
            print(f"{case[0] or 'nothing'} {case[2]}: {lines[-1]['verdict']}", flush=True)
    print("| hidden | seed | verdict | port right | law right | seconds |\n|---|---|---|---|---|---|")
    for line in lines:
        marks = [{True: "yes", False: "no", None: "-"}[line.get(key)] for key in ("port_right", "law_right")]
        words = [line["effect"] or "nothing", line["seed"], line["verdict"], *marks, line.get("seconds", "-")]
        print("| " + " | ".join(map(str, words)) + " |")


if __name__ == "__main__":
    main()
