"""The index of the reports: one row per paper with the classes of its claims, and what they say together (``findings.md``, if written)."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = "index.md"
HEADS = {
    "holds": "hold",
    "fails": "fail",
    "depends on": "depend on",
    "source inconsistent": "source inconsistent",
    "open": "open",
}


def write(papers: list, folder: Path, built: Path, commit: str) -> None:
    """``index.md`` in ``folder``, and its HTML twin, which names the commit, in ``built``."""
    from testbed.report import html

    text = page(papers, folder)
    (folder / PAGE).write_text(text)
    built.mkdir(parents=True, exist_ok=True)
    body = text.split("\n", 1)[1].replace("/report.md)", "/report.html)") + f"\nMade from commit `{commit}`.\n"
    (built / "index.html").write_text(html.document("Papers", "Navigation testbed", "", body, folder))


def page(papers: list, folder: Path) -> str:
    """The table and the paragraph."""
    lines = [
        "| Paper | Claims | " + " | ".join(HEADS.values()) + " | Our own |",
        "| :--- | ---: |" + " :--- |" * (len(HEADS) + 1),
    ]
    for paper in papers:
        if (path := folder / paper.name / "claims.csv").is_file():
            lines.append(row(paper, path))
    parts = ["# Papers", *(["\n".join(lines), LEGEND] if len(lines) > 2 else [])]
    together = ROOT / "findings.md"
    if together.is_file():
        parts.append(together.read_text().strip())
    return "\n\n".join(parts) + "\n"


LEGEND = (
    "A claim *holds* where it is reproduced under every reading of what its source leaves open that decides it, *fails* where under none, *depends on* what tells "
    "the readings apart; the page of the paper says which value of it decides. *Source inconsistent*: the source states two figures. "
    "*Open*: the runs do not decide. One statement of a paper may be several claims (figures of text and table, against truth and against GPS), so counts do not compare "
    "papers. Claims on computing time stand in each paper's `timings.md`."
)


def row(paper, path: Path) -> str:
    """A paper: number of its claims, and per class how many; of *depends on*, on what."""
    import pages
    from jobs import read_table

    from testbed.scoring.verdicts import NOT_TESTED

    claims = read_table(path)
    source = claims[claims["origin"] != "own"]
    cells = []
    for kind in HEADS:
        words = Counter(word for word in source["class"] if pages.class_of(word) == kind)
        if kind == "depends on":
            told = [f"{word.removeprefix('depends on ')} ({count})" for word, count in words.items()]
            cells.append(", ".join(told) or "–")
        elif kind == "source inconsistent" and words:
            tested = Counter(source.loc[source["class"] == kind, "as_tested"])
            told = ", ".join(f"{n} {word}" for word, n in tested.items() if word != NOT_TESTED)
            cells.append(f"{words.total()} (as tested: {told})" if told else str(words.total()))
        else:
            cells.append(str(words.total() or "–"))
    own = Counter(pages.class_of(word) for word in claims.loc[claims["origin"] == "own", "class"])
    told = ", ".join(f"{own[kind]} {HEADS[kind]}" for kind in HEADS if own[kind])
    link = f"[{paper.title}]({paper.name}/report.md)"
    return f"| {link} | {len(source)} | " + " | ".join(cells) + f" | {told or '–'} |"
