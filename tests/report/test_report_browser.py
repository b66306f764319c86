"""The report in a real browser: no errors, no network, plots that draw, a table that sorts, keys that work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, visit
from result_folder import make_result

from testbed.report import render, render_index

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")

WORK = """
const one = (s) => document.querySelector(s);
const names = () => [...document.querySelectorAll("#table-comparison-all tbody th")].map((h) => h.textContent);
const press = (target, key) => target.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
await until(() => document.documentElement.dataset.plots === "drawn");
const plots = [...document.querySelectorAll(".plot")];
seen.plots = plots.length;
seen.drawn = plots.filter((p) => p.querySelector(".main-svg, canvas")).length;
seen.lines = document.querySelectorAll("#chart-errors .scatterlayer .trace path.js-line").length;
seen.space = document.querySelectorAll("#chart-path canvas").length;
seen.before = names();
const head = one("#table-comparison-all thead tr:last-child th:nth-child(2) button");
head.focus();
seen.focusable = document.activeElement === head;
head.click();
seen.ascending = names();
seen.sorted = head.parentElement.getAttribute("aria-sort");
head.click();
seen.descending = names();
const cell = one("#table-comparison-all tbody td");
cell.focus();
seen.tip = one("#tip").hidden ? "" : one("#tip").textContent;
press(cell, "ArrowRight");
seen.moved = document.activeElement.cellIndex;
const box = one('[name="estimator"]');
box.click();
await new Promise((go) => setTimeout(go, 300));
seen.fewer = document.querySelectorAll("#chart-errors .scatterlayer .trace path.js-line").length;
one('[name="view-errors"][value="Attitude"]').click();
await new Promise((go) => setTimeout(go, 300));
seen.attitude = one("#chart-errors .plot").textContent.includes("Roll");
const plot = one("#chart-errors .plot");
const width = () => plot._fullLayout.xaxis.range[1] - plot._fullLayout.xaxis.range[0];
seen.wide = width();
press(plot, "+");
await new Promise((go) => setTimeout(go, 200));
seen.close = width();
one("#theme").click();
seen.theme = document.documentElement.dataset.theme;
seen.overflow = document.documentElement.scrollWidth - innerWidth;
dispatchEvent(new Event("beforeprint"));
seen.paper = plot._fullLayout.paper_bgcolor;
seen.printed = plot._fullLayout.width;
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_result(tmp_path_factory.mktemp("browser") / "result")
    render(folder, svg=False)
    return folder


@pytest.fixture(scope="module")
def seen(folder: Path) -> dict[str, Any]:
    return visit(folder / "report.html", WORK)


def test_page_is_silent_and_asks_for_nothing(seen: dict[str, Any]) -> None:
    assert seen["errors"] == []
    assert seen["requests"] == []


def test_every_plot_draws(seen: dict[str, Any]) -> None:
    assert seen["plots"] >= 9
    assert seen["drawn"] == seen["plots"]
    assert seen["lines"] >= 12  # four estimators in three panels
    assert seen["space"] >= 1


def test_table_sorts_both_ways_with_a_focusable_head(seen: dict[str, Any]) -> None:
    best_first = ["imm-rstekf", "kf", "direct-ukf", "imm-ekf"]  # the factors 0.8, 1.0, 1.12, 1.25 of the sample
    assert seen["before"] != best_first
    assert seen["ascending"] == best_first
    assert seen["descending"] == best_first[::-1]
    assert seen["focusable"] and seen["sorted"] == "ascending"


def test_intervals_follow_focus_and_arrow_keys(seen: dict[str, Any]) -> None:
    assert seen["tip"].startswith("95 % interval ") and " to " in seen["tip"]
    assert seen["moved"] == 2


def test_switches_hide_an_estimator_and_change_the_view(seen: dict[str, Any]) -> None:
    assert seen["fewer"] == seen["lines"] - 3  # one estimator in three panels
    assert seen["attitude"]
    assert seen["close"] == pytest.approx(0.5 * seen["wide"])


def test_dark_on_demand_and_white_on_paper(seen: dict[str, Any]) -> None:
    assert seen["theme"] == "dark"
    assert seen["paper"] == "#ffffff" and seen["printed"] < 700  # A4 less its margins is 180 mm, 680 px


def test_page_does_not_overflow_a_narrow_screen(folder: Path) -> None:
    script = """
    await until(() => document.documentElement.dataset.plots === "drawn");
    seen.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
    """
    seen = visit(folder / "report.html", script, 500)
    assert seen["overflow"] <= 0
    assert seen["errors"] == []


def test_index_is_silent(folder: Path, tmp_path: Path) -> None:
    page = render_index([folder], tmp_path)
    seen = visit(page, "seen.links = document.querySelectorAll('a').length;")
    assert seen["errors"] == [] and seen["requests"] == []
    assert seen["links"] == 1


def test_index_fits_a_phone(folder: Path, tmp_path: Path) -> None:
    """Nothing of it lies outside of 400 px; chromium's window is not made narrower than 500, a frame is."""
    page = render_index([folder], tmp_path)
    frame = tmp_path / "frame.html"
    frame.write_text(
        f'<html><head></head><body><iframe src="{page.as_uri()}" width="400" height="900"></iframe></body></html>'
    )
    script = """
    const inside = document.querySelector("iframe").contentDocument.documentElement;
    seen.overflow = Math.max(inside.scrollWidth, ...[...inside.querySelectorAll(".scroll")].map((e) => e.scrollWidth)) - 400;
    """
    assert visit(frame, script, 600, "--allow-file-access-from-files")["overflow"] <= 0
