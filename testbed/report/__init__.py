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

    Raises InputError when the folder holds no finished result, or a file of these names that the bench did not write.
    """
    import os
    from functools import partial

    from testbed.base.child_processes import share
    from testbed.base.files import as_json
    from testbed.montecarlo.folders import Folder
    from testbed.montecarlo.store import KIND
    from testbed.report import figures, html, index, text
    from testbed.report.results import load_result

    preload()  # once, before the work is shared
    load_result(result_dir)  # what cannot be read is refused before the folder is touched
    with Folder.open(result_dir, KIND) as folder:
        result = load_result(result_dir)
        drawn = {f"{name}.png": drawing for name, drawing in figures.drawings(result).items()}
        pictures = [f"figures/{name}" for name in drawn]
        if svg:
            pictures += [str(Path(name).with_suffix(".svg").as_posix()) for name in pictures]
        names = [*("report.md", "tables.tex", index.ENTRY, "report.html"), *pictures]
        folder.forget([name for name in folder.files if name.startswith("figures/") and name not in names])
        folder.claim(names)

        def write_texts() -> None:
            captions = {name: drawing.caption for name, drawing in drawn.items()}
            folder.write("report.md", text.markdown(result, captions).encode())
            folder.write("tables.tex", text.latex(result).encode())
            folder.write(index.ENTRY, as_json(index.entry_of(result)))
            folder.write("report.html", html.page(result).encode())

        figure_tasks = {
            name: partial(figures.save, drawing, folder.out / "figures" / name, svg) for name, drawing in drawn.items()
        }
        for name in [name for name in drawn if f"(figures/{name})" in result.findings]:
            figure_tasks.pop(name)()  # the page embeds what stands between its findings
        share([write_texts, *figure_tasks.values()], os.cpu_count() or 1)
        for name in names:
            folder.finish(name)
        folder.save()


def render_index(dirs: Iterable[str | Path], out: str | Path, replace_others: bool = False) -> Path:
    """Write a page with one row per result folder (verdict counts, links) and return its path.

    ``out`` is the page itself or the folder in which ``index.html`` goes; ``index.md`` is written beside it.
    Raises InputError when a folder holds no result, or where these files are there and not the bench's own (unless
    ``replace_others``).
    """
    from testbed.report import index

    return index.write_index([Path(d) for d in dirs], Path(out), replace_others)
