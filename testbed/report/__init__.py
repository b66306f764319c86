"""Reports: a result folder in, ``report.html``, ``report.md``, ``tables.tex`` and ``figures/`` out.

Everything is read from the files of the folder (layout: `testbed.report.results`), so a report can be made again at any time.
Units are those of the column names: metres, m/s, degrees, seconds; improvements in percent.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def preload() -> None:
    """Import what a report is made with, which takes a second."""
    import matplotlib.backends.backend_agg
    import matplotlib.figure  # noqa: F401

    import testbed.report.figures
    import testbed.report.html  # noqa: F401


def render(result_dir: str | Path, svg: bool = True) -> None:
    """Write ``report.html``, ``report.md``, ``report.json``, ``tables.tex`` and ``figures/*.png`` (and ``*.svg``) into a result folder.

    Raises InputError when the folder holds no result.
    """
    import os
    from functools import partial

    from testbed.forking import share
    from testbed.report import figures, html, index, text
    from testbed.report.results import load_result
    from testbed.store import write_json

    preload()  # once, before the work is shared
    result = load_result(result_dir)
    pictures = result.folder / "figures"
    pictures.mkdir(parents=True, exist_ok=True)
    drawn = {f"{name}.png": drawing for name, drawing in figures.drawings(result).items()}

    def write_texts() -> None:
        captions = {name: drawing.caption for name, drawing in drawn.items()}
        (result.folder / "report.md").write_text(text.markdown(result, captions), encoding="utf-8")
        (result.folder / "tables.tex").write_text(text.latex(result), encoding="utf-8")
        write_json(result.folder / index.ENTRY, index.entry_of(result))
        (result.folder / "report.html").write_text(html.page(result), encoding="utf-8")

    figure_tasks = [partial(figures.save, drawing, pictures / name, svg) for name, drawing in drawn.items()]
    share([write_texts, *figure_tasks], os.cpu_count() or 1)


def render_index(dirs: Iterable[str | Path], out: str | Path) -> Path:
    """Write a page with one row per result folder (verdict counts, links) and return its path.

    ``out`` is the page itself or the folder in which ``index.html`` goes; ``index.md`` is written beside it.
    Raises InputError when a folder holds no result.
    """
    from testbed.report import index

    return index.write_index([Path(d) for d in dirs], Path(out))
