"""A whole audit that describes an unknown cause: a marker of the toy that moves by the product of both commands."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp

from rfdropo_bayes.audit.audit_record import next_experiment, record
from rfdropo_bayes.audit.law_words import law_tables
from rfdropo_bayes.audit.pipeline import audit
from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.report.audit_page import render_audit, shown
from rfdropo_bayes.report.residual_file import residual_dataset

from .toys import Toy, problem, recordings

SIZE = 3e-3  # [m] per square of the command's unit
TRUTH = {"gain": 1.3, "bend": -0.4}


class Pushed(Toy):
    """Marker m3 moves along x by the product of both commands, which no candidate does."""

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])
        return seen._replace(position=seen.position.at[:, 2, 0].add(SIZE * level[:, 0] * level[:, 1]))


def asked(seed, toy=None):
    """The audit of the plain toy on recordings of another one."""
    plain, trajectories = problem({}, seed), recordings(TRUTH, seed, toy)
    gathered = gather_recordings(Toy(), trajectories)
    model = replace(plain.model, recordings=gathered, channels=(Markers.gather(gathered, "repeats"),))
    return replace(
        plain, model=model, trajectories=trajectories[:4], ports=port_map(plain.lanes.simulator, gathered.markers)
    )


def test_a_law_at_a_marker_is_described_with_its_size_and_its_worth():
    answer = audit(asked(5, Pushed()))
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert json.loads(json.dumps(content, allow_nan=False))["verdict"] == "described"
    law = content["law"]
    assert (law["port"], law["holds"]) == ("marker m3 x", True)
    (term,) = law["terms"]
    assert (term["feature"], term["unit"]) == ("product", "1/m")
    assert abs(term["mean"] - SIZE) < 4.0 * term["sd"]
    assert law["explained_fraction"] > 0.8
    assert law["rmse_after_mm"] < law["rmse_before_mm"]
    assert content["ports"]["left_out"]
    assert content["ports"]["ports"][0]["adjusted_p"] <= 0.02
    for words in ("no mechanism of the library", "marker m3 x", "u_a u_b", "unseen recordings"):
        assert words in content["sentence"]
    (table,) = law_tables(answer)
    assert table["port"] == "marker m3 x"
    assert table["terms"][0]["commands"] == ["a", "b"]
    left = residual_dataset(answer)
    assert float((left.residual_last**2).mean()) < float((left.residual_base**2).mean())
    assert left.signal.sel(port="marker m3 x").shape == (2, left.sizes["signal_time"])
    assert "What acts, and where" in render_audit(shown(answer), content, "toy", "")


def test_nothing_is_described_where_nothing_is_hidden():
    answer = audit(asked(101))
    assert answer.verdict == "no_discrepancy"
    assert answer.causes.described is None
