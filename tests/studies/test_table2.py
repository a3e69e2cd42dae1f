"""The comparison with Table II: cells that are kept, intervals, claims, and a small study from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import load_experiment
from rfdropo_bayes.model.experiment_file import describe, read_tables
from rfdropo_bayes.model.run_folder import run_folder
from studies import table2
from studies.table2 import ROWS, WITHOUT_CUBE, Study, Table2Size, claims, list_jobs, run_table2, summarise

VIRTUAL = Path(__file__).resolve().parents[2] / "experiments" / "virtual"
PUSH, REACH, TRUTH, AUDIT = (VIRTUAL / f"{name}.toml" for name in ("push", "reach", "truth", "audit"))
SMALL = Table2Size(seeds=2, steps=1000, episodes=20, budget=100, minutes=1.0)


def keep(out: Path, row: str, seed: int, distances: np.ndarray) -> None:
    """Write what an evaluation leaves."""
    place = out / "push" / "evaluations" / f"{row.replace(' ', '_')}_{seed}"
    place.mkdir(parents=True)
    pd.DataFrame({"distance": distances, "diverged": ~np.isfinite(distances)}).to_csv(place / "episodes.csv")
    made = {"sha256": "", "steps": 1000, "seconds": 1.0, "diverged": 0, "target_sha256": table2.target_digest(TRUTH)}
    (place / "policy.json").write_text(json.dumps({**made, "exact_oracle": False}))


def test_seeds_are_done_one_after_the_other_and_a_task_without_a_cube_has_few_rows(tmp_path) -> None:
    jobs = list_jobs(Study({"push": PUSH, "reach": REACH}, TRUTH, AUDIT, tmp_path, SMALL))
    assert len(jobs) == 2 * (len(ROWS) + len(WITHOUT_CUBE))
    assert [seed for _, _, seed in jobs] == sorted(seed for _, _, seed in jobs)
    assert jobs[0] == ("push", "no randomisation", 0)


def test_what_is_done_makes_a_table(tmp_path) -> None:
    near, far = np.full(20, 0.012), np.full(20, 0.025)
    keep(tmp_path, "ours after the audit", 0, near)
    keep(tmp_path, "ours after the audit", 1, np.where(np.arange(20) < 10, near, np.inf))
    keep(tmp_path, "oracle", 0, near)
    keep(tmp_path, "udr", 0, far)
    keep(tmp_path, "ours", 0, near[:5])  # of a study with fewer episodes
    found = run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL, only_done=True)
    rows = {row["row"]: row for row in found["rows"]}
    assert set(rows) == {"UDR", "ours after the audit", "oracle"}
    own = rows["ours after the audit"]
    assert own["success"]["15.25"]["share"] == 30 / 40
    interval = binomtest(30, 40).proportion_ci(method="wilson")
    assert own["success"]["15.25"]["low"] < interval.low  # seeds differ by half
    one = binomtest(20, 20).proportion_ci(method="wilson")
    assert rows["oracle"]["success"]["15.25"]["low"] == pytest.approx(one.low)
    assert (own["by_seed"], own["episodes"]) == ([1.0, 0.5], 40)
    assert (rows["UDR"]["success"]["21.57"]["share"], rows["UDR"]["success"]["30"]["share"]) == (0.0, 1.0)
    assert [claim["holds"] for claim in found["claims"]] == [False, True]
    assert found["not_done"] == 2 * len(ROWS) - 4
    assert "75 %" in (tmp_path / "table2.md").read_text()
    assert (tmp_path / "table2.png").stat().st_size > 5000


def test_another_comment_is_no_other_target(tmp_path) -> None:
    other = tmp_path / "truth.toml"
    other.write_text("# said anew\n" + TRUTH.read_text())
    assert table2.target_digest(other) == table2.target_digest(TRUTH)
    other.write_text(TRUTH.read_text().replace("command_delay = 0.03", "command_delay = 0.04"))
    assert table2.target_digest(other) != table2.target_digest(TRUTH)


def test_claims_follow_their_definitions() -> None:
    def row(name: str, hits: int) -> dict:
        cell = {"task": "push", "row": name, "seed": 0, "steps": 1, "seconds": 1.0, "episodes": 200}
        distance = [1.0] * hits + [50.0] * (200 - hits)
        return summarise("push", name, [{**cell, "hits": {"15.25": hits}, "distance_mm": distance}])

    found = claims([row("UDR", 100), row("ours", 185), row("ours after the audit", 180), row("oracle", 195)])
    assert [(claim["claim"].split(",")[0], claim["holds"]) for claim in found] == [
        ("succeeds at 15.25 mm at least 0.9 times as often as the oracle", True),
        ("succeeds more often than UDR", True),
        ("succeeds more often than ours", False),
    ]


def test_the_target_keeps_its_truth_and_takes_the_task(tmp_path) -> None:
    study = Study({"reach": REACH}, TRUTH, AUDIT, tmp_path, SMALL)
    tables = table2._on_target(study, table2._tables(study, "reach"))
    assert tables["training"]["task"] == "TrunkReach-v0"
    assert tables["model"]["fixed"]["young_modulus"] == 5.6e6
    assert "data" not in tables


def test_the_model_takes_what_the_audit_adopted_and_keeps_its_own_priors(tmp_path) -> None:
    """Mechanisms, their priors, laws, and a finer body; the audit's own priors stay its own."""
    found = read_tables(AUDIT)
    found["model"] |= {"mechanisms": ["actuator_lag"], "priors": {**found["model"]["priors"], "actuator_lag": {}}}
    term = {"coefficient": "slip", "feature": "travelled", "commands": ["long_0"], "scale": 0.1}
    found["model"]["laws"] = [{"port": "cable long_0", "terms": [term]}]
    found["simulator"] = {"refine": 2}
    (tmp_path / "audit").mkdir()
    (tmp_path / "audit" / "extended.toml").write_text(describe(found))
    common = {"sentence": "The drives lag.", "out_of_time": False}
    (tmp_path / "audit" / "run.json").write_text(json.dumps({"settings": {}, "command": "audit", "status": "done"}))
    (tmp_path / "audit" / "audit.json").write_text(json.dumps({**common, "verdict": "explained"}))
    (tmp_path / "audit" / "asked.toml").write_text(f"# audit.minutes={SMALL.minutes}\n{AUDIT.read_text()}")
    study = Study({"push": PUSH}, TRUTH, AUDIT, tmp_path, SMALL)
    extended = table2._with_causes(study, table2._tables(study, "push"))
    path = tmp_path / "extended.toml"
    path.write_text(describe(extended))
    experiment, _ = load_experiment(path)
    assert experiment.model.mechanisms == ["actuator_lag"]
    assert [(law.port, law.terms[0].coefficient) for law in experiment.model.laws] == [("cable long_0", "slip")]
    assert set(experiment.model.priors) == {*table2._tables(study, "push")["model"]["priors"], "actuator_lag"}
    assert (experiment.simulator.push, experiment.simulator.refine) == (True, 2)
    for other, why in (({"verdict": "no_verdict"}, "remove this folder"), ({"out_of_time": True}, "more minutes")):
        (tmp_path / "audit" / "audit.json").write_text(json.dumps({**common, "verdict": "explained", **other}))
        with pytest.raises(InputError, match=why):
            table2._with_causes(study, table2._tables(study, "push"))


@pytest.mark.parametrize(
    ("there", "asked"),
    [(["audit.json"], (False, True)), (["run.json", "checkpoints/round"], (True, False)), ([], (False, True))],
)
def test_an_audit_is_gone_on_with_or_made_anew(tmp_path, monkeypatch, there, asked) -> None:
    """A verdict alone, as a repository keeps it, is no run: it does not stop the study."""
    for name in there:
        (tmp_path / "audit" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "audit" / name).write_text("{}")

    class Asked(Exception):
        pass

    def audit(model, *, out, resume, overwrite):
        raise Asked(resume, overwrite)

    monkeypatch.setattr(table2, "audit", audit)
    study = Study({"push": PUSH}, TRUTH, AUDIT, tmp_path, SMALL)
    with pytest.raises(Asked) as found:
        table2._with_causes(study, table2._tables(study, "push"))
    assert found.value.args == asked


def test_what_cannot_be_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="unknown row 'RFDROPO'"):
        run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL, rows=["RFDROPO"])
    with pytest.raises(InputError, match="seeds = 0"):
        Table2Size(seeds=0)


@pytest.mark.slow
def test_an_interval_knows_that_the_episodes_of_a_policy_succeed_together() -> None:
    """Of policies with success p ~ Beta(2, 2), three a row, the mean is 0.5. Three seeds are few for a bootstrap, whose
    interval holds it in 80 % of rows, Wilson's in 31 %. Of 200 rows, 65 % is five deviations below."""
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(200):
        hit = rng.random((3, 100)) < rng.beta(2.0, 2.0, (3, 1))
        found = table2.share_of(hit)
        wilson = binomtest(int(hit.sum()), hit.size).proportion_ci(method="wilson")
        inside.append([found["low"] <= 0.5 <= found["high"], wilson.low <= 0.5 <= wilson.high])
    ours, wilsons = np.mean(inside, axis=0)
    assert ours > 0.65
    assert wilsons < 0.5


def test_an_evaluation_on_another_target_is_not_taken(tmp_path) -> None:
    keep(tmp_path, "ours", 0, np.full(20, 0.012))
    study = Study({"push": PUSH}, TRUTH, AUDIT, tmp_path, SMALL)
    assert table2._cell(study, "push", "ours", 0) is not None
    assert table2._cell(replace(study, target=AUDIT), "push", "ours", 0) is None


def test_starting_anew_keeps_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(table2, "_do", lambda *job: None)
    keep(tmp_path, "ours", 0, np.full(20, 0.012))
    found = run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL, only_done=True)
    assert found["rows"]
    with pytest.raises(InputError, match="finished run"):
        run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL)
    assert run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL, resume=True)["rows"] == found["rows"]
    assert not run_table2([PUSH], TRUTH, AUDIT, tmp_path, SMALL, overwrite=True)["rows"]


@pytest.mark.slow
def test_a_small_study_from_recording_to_table_goes_on_where_it_stopped(tmp_path) -> None:
    size = Table2Size(seeds=1, steps=2048, episodes=4, budget=200)
    run = [[REACH], TRUTH, AUDIT, tmp_path / "study", size]
    first = run_table2(*run, rows=["no randomisation"])
    assert [row["row"] for row in first["rows"]] == ["no randomisation"]
    policy = tmp_path / "study" / "reach" / "policies" / "no_randomisation_0" / "policy.onnx"
    assert not (policy.parent / "report.html").exists()  # a page takes longer than so short a training
    ledger = tmp_path / "study" / "reach" / "evaluations" / "no_randomisation_0" / "policy.json"
    home = json.loads((policy.parent / "summary.json").read_text())["evaluation"]
    assert json.loads(ledger.read_text())["home_distance_q95"] == home["distance_q95"]
    before = policy.stat().st_mtime
    second = run_table2(*run, rows=["no randomisation", "oracle"], resume=True)
    assert [row["row"] for row in second["rows"]] == ["no randomisation", "oracle"]
    assert policy.stat().st_mtime == before
    assert second["cells"][0] == first["cells"][0]


def test_programs_of_one_study_share_its_folder(tmp_path):
    with run_folder(tmp_path, "table2"), run_folder(tmp_path, "table2", resume=True):
        pass
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "done"
