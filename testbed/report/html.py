"""``report.html``: one file that holds text, tables, data and the plotting script; it asks nothing of a network.

plotly.js (its gl3d bundle, MIT licence) and the traces are stored gzipped in base64 and unpacked by the browser when the
first plot comes near; the tables stand without script. Units stand in heads and axes.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Collection
from functools import cache
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Any

from testbed.base.figure_style import COLOURS
from testbed.report import conditions, innovations, normalised, provenance, satellites, tables
from testbed.report.charts import charts
from testbed.report.headline import headline
from testbed.report.labels import window_label
from testbed.report.results import Result
from testbed.report.sensors import sensor_tables
from testbed.report.text import comparison_windows
from testbed.report.traces import dash_of

ASSETS = resources.files("testbed.report") / "assets"


def page(result: Result) -> str:
    """The whole page as text."""
    lead = headline(result)
    drawn = charts(result, lead)
    windows = comparison_windows(result)
    return template("report.html.j2").render(
        result=result,
        lead=lead,
        comparisons=[(window_label(w), tables.comparison(result, w)) for w in windows],
        claims=tables.claims(result),
        paper_tables=tables.paper_tables(result),
        failures=tables.failures(result),
        conditions=conditions.table(result),
        consistency=tables.consistency(result),
        innovations=innovations.table(result),
        passed=normalised.told(result),
        borders=[BORDERS.get(dash_of(k), "dashed") for k in range(len(result.estimators))],
        satellites=satellites.table(result),
        timings=tables.timings(result),
        sensors=sensor_tables(result),
        provenance=provenance.rows(result),
        command=provenance.command(result),
        findings=markdown(result.findings, pictures=result.folder, only=_pictures(result)),
        charts=drawn,
        sections=_sections(result, drawn),
        data=_pack(json.dumps({"charts": drawn, "colours": COLOURS}, separators=(",", ":"), allow_nan=False).encode()),
        plotly=_library() if drawn else "",
        **_embedded("report.js"),
    )


def template(name: str) -> Any:
    """A template of the assets folder; text is escaped."""
    import jinja2

    loader = jinja2.FunctionLoader(asset)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["groupby_run"] = _spans
    environment.filters["with_links"] = _with_links
    return environment.get_template(name)


def asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def document(title: str, kind: str, headline: str, text: str, folder: Path) -> str:
    """A page of Markdown ``text`` with the pictures that it names from ``folder``, embedded."""
    body = markdown(text, deeper=0, pictures=folder)
    values = {"title": title, "kind": kind, "headline": headline, "body": body}
    return str(template("document.html.j2").render(**values, style=asset("report.css"), script=asset("index.js")))


def markdown(text: str, deeper: int = 2, pictures: Path | None = None, only: Collection[str] | None = None) -> str:
    """Markdown as HTML, headings some levels down; markup in the text is shown, not obeyed.

    Pictures are left out, or those that lie in the folder ``pictures`` are embedded (of them ``only`` these); in place of
    another stands its description.
    """
    from markdown_it import MarkdownIt

    if not text:
        return ""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    if pictures is None:
        parser.disable("image")
    tokens = parser.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(6, int(token.tag[1]) + deeper)}"
        for child in token.children or []:
            if child.type == "image" and pictures is not None:
                source = str(child.attrGet("src"))
                if only is not None and source not in only:
                    child.type, child.tag = "text", ""  # its description
                else:
                    child.attrSet("src", _embedded_picture(pictures / source))
    return str(parser.renderer.render(tokens, parser.options, {}))


def _pictures(result: Result) -> list[str]:
    """Names of the result's own figures, which `testbed.report.render` has drawn before the page where findings show them."""
    return sorted(f"figures/{path.name}" for path in (result.folder / "figures").glob("*.png"))


def _embedded_picture(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


BORDERS = {"solid": "solid", "dot": "dotted"}
"""Styles of a border like lines of these dashes; of any other, dashed."""
_DOI = re.compile(r"\b(?:doi[: ]\s*)(10\.\d{4,9}/[^\s,;)]*[^\s,;).])", re.IGNORECASE)


def _with_links(text: str) -> Any:
    """The text of a source, escaped, with its DOI as a link."""
    from markupsafe import Markup, escape

    return Markup(_DOI.sub(r'<a href="https://doi.org/\1">doi:\1</a>', str(escape(text))))


def _spans(columns: list[tables.Column]) -> list[tuple[str, int]]:
    """Neighbouring columns of one group: (group, how many)."""
    return [(group, len(list(members))) for group, members in groupby(columns, key=lambda c: c.group)]


def _embedded(script: str) -> dict[str, str]:
    return {"style": asset("report.css"), "script": asset(script)}


@cache
def _library() -> str:
    return base64.b64encode((ASSETS / "plotly-gl3d.min.js.gz").read_bytes()).decode("ascii")


def _pack(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")


def _sections(result: Result, drawn: dict[str, Any]) -> list[tuple[str, str]]:
    """(anchor, name) of what the page contains, in order."""
    found = [("findings", "Findings")] if result.findings else []
    found += [("comparison", "Comparison")]
    found += [("claims", "Claims")] if len(result.claims) else []
    found += [("paper", "Paper’s tables")] if result.scenario.get("tables") else []
    found += [("conditions", "Conditions")] if result.scenario else []
    found += [("flight", "Flight")] if "track" in drawn else []
    found += [("errors", "Errors")] if "errors" in drawn else []
    found += [("spread", "Monte Carlo")] if {"spread", "envelopes", "runs"} & set(drawn) else []
    found += [("consistency", "Consistency")] if {"consistency", "innovations"} & set(drawn) else []
    found += [("satellites", "Satellites")] if "satellites" in drawn else []
    found += [("extras", "Inside the filters")] if "extras" in drawn else []
    found += [("time", "Time")] if len(result.timings) else []
    found += [("sensors", "Sensors")] if result.info.get("sensors") else []
    return [*found, ("provenance", "Provenance")]
