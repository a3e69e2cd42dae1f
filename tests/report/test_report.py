"""The files of a run: numbers under the promised names, a page that needs nothing else and can be drawn again."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.report import RunFacts, build_summary, read_summary, rebuild_report, render_page, write_run
from rfdropo_bayes.report.page import SECTIONS, duration, interval, number
from rfdropo_bayes.report.style import PlainLogFormatter
from rfdropo_bayes.report.trajectory_figures import shown_markers
from rfdropo_bayes.report.units import display_unit

CONFIG = 'robot = "toy" # <b>&</b>\n'


@pytest.fixture(scope="module")
def record(run: Any) -> PosteriorRecord:
    """One fit recording that ends in a hold and one test recording: every kind of figure, few of each."""
    return dataclasses.replace(run.record, recordings=run.record.recordings[2:4])


@pytest.fixture(scope="module")
def folder(run: Any, record: PosteriorRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "new"
    write_run(folder, record, build_summary(record, run.facts), CONFIG)
    return folder


class Reader(HTMLParser):
    """Collects what a browser would fetch, where links lead, and whether tags are balanced."""

    VOID = frozenset({"meta", "img", "link", "br", "wbr", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.images: list[dict[str, str | None]] = []
        self.open: list[str] = []
        self.figures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "img":
            self.images.append(values)
        self.figures += tag == "figure"
        self.fetched += [v or "" for k, v in attrs if k in ("src", "srcset", "data", "poster")]
        if tag in ("link", "iframe", "object", "embed"):
            self.fetched.append(f"<{tag}>")
        if tag == "a":
            self.links.append(values.get("href") or "")
        if values.get("id"):
            self.anchors.add(str(values["id"]))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    return reader


def test_the_page_fetches_nothing(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    reader = read(page)
    assert reader.fetched
    assert all(source.startswith("data:image/svg+xml;base64,") for source in reader.fetched)
    style = page[page.index("<style>") : page.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    for script in re.findall(r"<script>(.*?)</script>", page, re.DOTALL):
        assert not re.search(r"https?:|fetch\(|XMLHttpRequest|import\b", script)
    for image in reader.images:
        svg = base64.b64decode(str(image["src"]).split(",")[1]).decode()
        assert not re.search(r'(?:href|src)="(?!#|data:)', svg)


def test_the_page_has_every_section_and_figure(folder: Path, record: PosteriorRecord) -> None:
    page = (folder / "report.html").read_text()
    reader = read(page)
    assert {anchor for anchor, _ in SECTIONS} <= reader.anchors
    assert {link.removeprefix("#") for link in reader.links} <= reader.anchors
    assert reader.figures == 8 + 3 * len(record.recordings)  # one of them the replay
    assert all(image["alt"] for image in reader.images)
    for image in reader.images:
        svg = base64.b64decode(str(image["src"]).split(",")[1])
        assert svg.count(b"<path") > (2 if image["class"] == "legend" else 10)
    for text in (
        "Toy trunk",
        "12 of 20000 simulations",
        "rayleigh_stiffness sits on a hard bound or at an end of the prior",
        "cubic FIR",
        "Synthetic",
    ):
        assert text in page
    assert "robot = &#34;toy&#34; # &lt;b&gt;&amp;&lt;/b&gt;" in page
    assert "nan" not in re.sub(r'src="[^"]*"', "", page).lower().replace("explanation", "").split()


def test_the_summary_keeps_its_promises(folder: Path, record: PosteriorRecord) -> None:
    summary = json.loads((folder / "summary.json").read_text(), parse_constant=pytest.fail)
    assert summary == read_summary(folder / "summary.json")
    assert {"schema_version", "parameters", "log_evidence", "rmse", "rollouts", "seconds", "engine", "status"} <= set(
        summary
    )
    row = summary["parameters"]["young_modulus"]
    draws = record.flat("young_modulus")
    assert row["mean"] == pytest.approx(draws.mean())
    assert (row["q05"], row["q95"]) == pytest.approx(tuple(np.quantile(draws, [0.05, 0.95], method="weibull")))
    assert (row["unit"], row["at_bound"]) == ("Pa", False)
    assert summary["parameters"]["rayleigh_stiffness"]["at_bound"] is True
    assert summary["parameters"]["specific_stiffness"]["derived"] is True
    assert set(summary["rmse"]) == {"fit", "test"}
    assert list(summary["rmse"]["test"]) == ["middle", "tip"]
    residual = np.concatenate([r.observed[:, -1] - r.central[:, -1] for r in record.recordings if r.split == "test"])
    expected = 1e3 * np.sqrt(np.mean(np.sum(residual**2, axis=-1)))
    assert summary["rmse"]["test"]["tip"] == pytest.approx(expected)
    assert summary["excluded"] == {"diverged": 12}
    assert 0.8 < summary["coverage"]["0.9"] <= 1.0


def test_what_is_not_finite_is_null_with_a_reason(folder: Path) -> None:
    summary = read_summary(folder / "summary.json")
    assert summary["log_evidence"]["value"] == 2712.4
    assert summary["log_evidence"]["sd"] is None
    assert "replicate" in summary["not_available"]["log_evidence.sd"]


@pytest.mark.slow
def test_the_report_is_drawn_again_from_the_folder(folder: Path) -> None:
    before = (folder / "report.html").read_text()
    (folder / "report.html").unlink()
    after = rebuild_report(folder).read_text()
    strip = re.compile(r'src="[^"]*"')
    assert strip.sub("", after) == strip.sub("", before)  # pictures differ in the last digits of single precision


def bare(status: str = "done") -> tuple[PosteriorRecord, RunFacts]:
    """One draw of one parameter, no prior, no recordings: what a point estimate leaves."""
    record = PosteriorRecord((ParameterInfo("young_modulus", "Pa"),), {"young_modulus": np.array([[4.5e6]])})
    return record, RunFacts("bare", "toy", "rfdropo", "jax", status, 0, 10.0, 1.0)


def test_a_run_with_next_to_nothing_still_has_a_page() -> None:
    record, facts = bare("interrupted")
    phi = {"young_modulus": {"mean": 4.5e6, "std": 1e5, "low": 4e6, "high": 5e6, "unit": "Pa"}}
    summary = build_summary(record, dataclasses.replace(facts, phi=phi))
    assert summary["log_evidence"] == {"value": None, "sd": None}
    assert summary["not_available"]["log_evidence"] == "rfdropo computes no evidence"
    page = render_page(record, summary, "")
    read(page)
    for text in (
        "Distribution to randomise over",
        "interrupted",
        "No predictions were stored",
        "config.toml is not in",
    ):
        assert text in page


def test_folders_that_are_no_run_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        rebuild_report(tmp_path)
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(InputError, match="not readable JSON"):
        rebuild_report(tmp_path)
    (tmp_path / "summary.json").write_text("[]")
    with pytest.raises(InputError, match="not a JSON object"):
        rebuild_report(tmp_path)
    summary = read_summary(folder / "summary.json")
    (tmp_path / "summary.json").write_text(json.dumps({k: v for k, v in summary.items() if k != "rmse"}))
    with pytest.raises(InputError, match="'rmse' is missing"):
        rebuild_report(tmp_path)
    (tmp_path / "summary.json").write_text(json.dumps({**summary, "schema_version": 99}))
    with pytest.raises(InputError, match="schema_version is 99"):
        rebuild_report(tmp_path)
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match=r"posterior.nc: no such file"):
        rebuild_report(tmp_path)
    (tmp_path / "posterior.nc").write_bytes(b"damaged")
    with pytest.raises(InputError, match="not a readable NetCDF"):
        rebuild_report(tmp_path)


def test_an_unwritable_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    record, facts = bare()
    with pytest.raises(InputError, match="cannot make the output folder"):
        write_run(tmp_path / "file" / "run", record, build_summary(record, facts), "")


def test_numbers_for_people() -> None:
    assert [number(v) for v in (None, True, 3, 3.0, 0.12345, 2451.7, math.pi * 1e8)] == [
        "\u2013", "yes", "3", "3", "0.123", "2452", "3.14e+08",
    ]  # fmt: skip
    assert [duration(s) for s in (3.2, 125.0, 9000.0)] == ["3.2 s", "2.08 min", "2.5 h"]
    assert [interval(0.0, math.inf), interval(-math.inf, math.inf), interval(0.1, 0.5)] == [
        "at least 0",
        "none",
        "0.1 to 0.5",
    ]
    assert display_unit("Pa", 4.5e6) == (1e6, "MPa")
    assert display_unit("m", 3e-4) == (pytest.approx(1e-3), "mm")
    assert display_unit("m", 3e-5) == (pytest.approx(1e-6), "\u00b5m")
    assert display_unit("kg/m3", 1080.0) == (1.0, "kg/m\u00b3")
    assert display_unit("-", 0.45) == (1.0, "")


def test_the_last_marker_is_always_shown() -> None:
    assert shown_markers(1) == [0]
    assert shown_markers(4) == [0, 1, 2, 3]
    assert shown_markers(21) == [5, 10, 15, 20]


@pytest.mark.parametrize(
    ("value", "shown"), [(40787.6, "40\u202f788"), (-5213.25, "\u22125\u202f213"), (12.34, "12.3"), (-0.5, "\u22120.5")]
)
def test_a_large_evidence_fits_into_its_tile(value: float, shown: str) -> None:
    record, facts = bare()
    summary = build_summary(record, facts)
    summary["log_evidence"] |= {"value": value, "sd": None}
    assert f"<b>{shown}<small> nat</small></b>" in render_page(record, summary, "")


def test_numbers_of_a_logarithmic_axis_are_written_out() -> None:
    axes = Figure().subplots()
    axes.set(yscale="log", ylim=(0.2, 3.0))
    formatter = PlainLogFormatter(minor_thresholds=(1.5, 0.6))
    formatter.set_axis(axes.yaxis)
    formatter.set_locs([0.3, 0.6, 1.0, 2.0])
    texts = [formatter(value) for value in (0.3, 0.6, 1.0, 2.0)]
    assert set(texts) <= {"", "0.3", "0.6", "1", "2"}
    assert "1" in texts
