"""``testbed plot``: one figure of a result, in the size and style of a paper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from testbed.base.errors import InputError, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
HELP_OF_KINDS = "errors, track, cdf, box, nees, biases; allan (of a log at rest); sweep (of a sweep)."


def plot_command(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder of a result, a sweep, or a log at rest.")],
    kind: Annotated[str, typer.Argument(help=HELP_OF_KINDS)],
    out: Annotated[
        Path | None, typer.Option("--out", help="File: .png, .svg or .pdf. Default: KIND.pdf in this folder.")
    ] = None,
    estimators: Annotated[str | None, typer.Option(metavar="A,B", help="Rows of the result that are drawn.")] = None,
    metric: Annotated[
        str | None,
        typer.Option(help="errors: position, velocity, attitude or an axis; cdf: a quantity; box, sweep: a metric."),
    ] = None,
    window: Annotated[str | None, typer.Option(help="Of box and sweep.")] = None,
    log: Annotated[str | None, typer.Option(metavar="x|y|xy|none", help="Of sweep: logarithmic axes.")] = None,
    size: Annotated[
        str, typer.Option(metavar="column|page|WxH", help="Width of a journal's column or page, or inches.")
    ] = "column",
    style: Annotated[str, typer.Option(help="A style of matplotlib (or its file) over the bench's own.")] = "",
) -> None:
    """One figure of a result: errors with three sigma, track, CDF, box plots, NEES, biases, Allan, sweep."""
    from testbed.report import single

    known = [*single.KINDS, *single.OF_OTHER_FOLDERS]
    if kind not in known:
        raise InputError(f"testbed plot: there is no figure '{kind}'; {nearest(kind, known)}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    target = out or Path(f"{kind}.pdf")
    if target.suffix not in FORMATS:
        raise InputError(f"--out {target}: a figure ends in {', '.join(FORMATS)}")
    if target.exists():
        raise InputError(f"{target}: already exists; give another --out")
    if kind == "sweep":
        figure = _of_sweep(folder, metric, window, log, size)
    elif kind == "allan":
        figure = _of_log(folder, size)
    else:
        rows = tuple(part.strip() for part in (estimators or "").split(",") if part.strip())
        wanted = single.Wanted(rows, metric or "", window or "all")
        figure = single.draw(folder, kind, wanted, size, style)
    from testbed.report.sweeps import save

    save(figure, target)
    print(f"figure: {target}")


def _of_sweep(folder: Path, metric: str | None, window: str | None, log: str | None, size: str) -> Figure:
    import matplotlib

    from testbed.base.figure_style import STYLE
    from testbed.montecarlo.sweep import read_sweep
    from testbed.report import single, sweeps

    table, shown = read_sweep(folder)
    width, _ = single.parse_size(size)
    keys, metric, window = shown["keys"], metric or shown["metric"], window or shown["window"]
    with matplotlib.rc_context(STYLE):
        return sweeps.figure(table, keys, metric, window, log or shown["log"], None if size == "column" else width)


def _of_log(folder: Path, size: str) -> Figure:
    import matplotlib

    from testbed.base.figure_style import PAGE_WIDTH, STYLE, logarithmic
    from testbed.cli.commands import own_log
    from testbed.report.single import parse_size
    from testbed.sensors.allan import figure

    log = own_log(folder)
    if log is None:
        raise InputError(f"{folder}: holds no log; testbed allan reads a table of your own")
    width, height = parse_size(size) if size != "column" else (PAGE_WIDTH, None)  # two triads side by side
    with matplotlib.rc_context(STYLE):
        drawn = figure(log, width, height or 0.42 * width)
        for axes in drawn.axes:
            logarithmic(axes, "x")
            logarithmic(axes, "y")
    return drawn
