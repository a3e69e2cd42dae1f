"""Figures and the verdict of a page: panels for narrow test_series, no background, the answer first."""

from __future__ import annotations

import base64
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from rfdropo_bayes.report import build_summary, render_page
from rfdropo_bayes.report import page as page_module
from rfdropo_bayes.report.robot_figure import robot_figure
from rfdropo_bayes.report.style import Panel, embed
from rfdropo_bayes.robots import Robot, known_robots, robot_shape
from tests.undrawn import without_panels


def grid(rows: int, columns: int, *, legend: bool = False) -> Figure:
    figure = Figure(figsize=(10.0, 2.0 * rows), layout="constrained")
    for axes in np.ravel(figure.subplots(rows, columns)):
        axes.plot([0.0, 1.0], [0.0, 1.0], label="a line")
        axes.set_xlabel("time [s]")
    if legend:
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center")
    return figure


def svg(panel: Panel) -> str:
    return base64.b64decode(panel.source.partition(",")[2]).decode()


def width(panel: Panel) -> float:
    found = re.search(r'width="([\d.]+)pt"', svg(panel))
    assert found is not None
    return float(found[1]) / 72.0


@pytest.mark.parametrize(("rows", "columns"), [(1, 2), (2, 4)])
def test_cells_of_a_row_fill_the_width_and_each_holds_its_own_panel(rows, columns):
    picture = embed(grid(rows, columns, legend=True), "Lines")
    legend, *cells = picture.panels
    assert (legend.kind, {cell.kind for cell in cells}) == ("legend", {"cell"})
    assert len(cells) == rows * columns
    for row in np.reshape([cell.share for cell in cells], (rows, columns)):
        assert row.sum() == pytest.approx(100.0)
    for cell in cells:
        assert width(cell) == pytest.approx(0.1 * cell.share, rel=0.02)
        assert svg(cell).count('id="axes_') == 1
        assert 'id="legend_' not in svg(cell)
    assert 'id="legend_' in svg(legend)
    assert legend.share < 50.0


def test_a_figure_of_one_piece_stays_one():
    assert [panel.kind for panel in embed(grid(1, 1), "One").panels] == ["whole"]
    assert [panel.kind for panel in embed(grid(1, 5), "Too fine").panels] == ["whole"]
    assert [panel.kind for panel in embed(grid(2, 2), "Together", whole=True).panels] == ["whole"]


def test_a_cell_that_is_not_shown_leaves_the_others():
    figure = grid(2, 2)
    figure.axes[3].set_visible(False)
    assert len(embed(figure, "Three of four").panels) == 3


def test_drawing_a_picture_hides_nothing_for_good():
    figure = grid(1, 2, legend=True)
    embed(figure, "Lines")
    assert all(artist.get_visible() for artist in (*figure.axes, *figure.legends))


def test_the_page_shows_through_a_picture():
    """A white patch of the figure or of its axes would be a bright block on a dark page."""
    for panel in embed(grid(1, 2), "Lines").panels:
        assert not re.search(r"fill: #ffffff", svg(panel))


@pytest.mark.parametrize("name", sorted(known_robots()))
def test_every_robot_has_a_picture(name):
    robot = Robot.load(name)
    shape = robot_shape(robot)
    assert list(shape["cables"]) == list(robot.cable_names)
    assert list(shape["markers"]) == list(robot.marker_names)
    text = "".join(svg(panel) for panel in embed(robot_figure(shape), name).panels)
    assert text.count("<path") > 20


def test_the_verdict_comes_first_and_has_its_colour(run, monkeypatch):
    summary = build_summary(run.record, run.facts)
    monkeypatch.setattr(page_module, "_recording_views", lambda record, summary: [])
    monkeypatch.setattr(page_module, "embed", without_panels)
    drawn = page_module._run_figures(run.record, summary)  # once, not for each page
    monkeypatch.setattr(page_module, "_run_figures", lambda record, summary: drawn)
    for verdict, tone in (("safe", "safe"), ("with care", "with-care"), ("unsafe", "unsafe")):
        judged = {"verdict": verdict, "sentence": "So it is: for a reason.", "reasons": ["a reason"], "advice": []}
        page = render_page(run.record, {**summary, "randomisation": judged}, "")
        assert page.index(f'class="answer {tone}"') < page.index('class="headline"')
        assert re.search(rf"\.answer\.{tone}\b[^}}]*--tone", page)
