"""README and documentation keep their word: every command and code block of a page runs, in order, in a folder of its own, and
prints what is pasted.

A block is left out only behind a comment ``<!-- not run: reason -->``, or ``<!-- needs TOOL -->`` where that program is not
installed; ``<!-- file: NAME -->`` writes it to a file. What
the pages do at length is done here in short: few runs in one process, no figures (`test_report` draws them).
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from testbed import cli
from testbed.data import registry

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted(DOCS.glob("**/*.md")))
    if "auto_gallery" not in path.parts
}
RUN = [
    name for name, text in PAGES.items() if re.search(r"^```(?:sh|python)$", text, re.M) and "contributing" not in name
]
SHORTER = {
    "duration_s=21600.0": "duration_s=1800.0",
    "--cap 200": "--cap 2",
    "--runs 5": "--runs 2",
    "--samples 64": "--samples 2 --trajectories 2 --runs 1",
    "--runs 30": "--runs 3",
    "--runs 100": "--runs 2",
    "--runs 40": "--runs 2",
    "dataset ahrs-lstm-2022": "dataset ahrs-lstm-2022 --profile smoke",
    "train ahrs-lstm-2022": "train ahrs-lstm-2022 --profile smoke",
    "tune ipo-2022 --profile smoke": "tune ipo-2022 --profile smoke --algorithms pso",
}
NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    """A fenced block with its language, the comment right above it, and its line in the page."""

    language: str
    body: str
    comment: str
    line: int


def blocks(text: str) -> list[Block]:
    fence = re.compile(r"(?:<!-- (?P<comment>[^>]*) -->\n)?```(?P<language>[\w{}]*)[^\n]*\n(?P<body>.*?)```\n", re.S)
    return [
        Block(m["language"], m["body"], m["comment"] or "", text[: m.start("body")].count("\n"))
        for m in fence.finditer(text)
    ]


def command_line(line: str) -> tuple[int, str]:
    """Run ``testbed ...`` in this process: exit code and both outputs."""
    arguments = shlex.split(line, comments=True)[1:]
    if arguments[0] == "run":
        recorded = arguments[1].startswith(("recorded", "results/imported"))
        if "--runs" not in arguments and "--profile" not in arguments and not recorded:
            arguments += ["--runs", "2"]
        arguments += ["--jobs", "1"]
    out = io.StringIO()
    registry._plugins.clear()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["testbed", *arguments])
        try:
            cli.main()
        except SystemExit as end:
            return int(end.code or 0), out.getvalue()
    return 0, out.getvalue()


def shape(line: str) -> str:
    """A line of output without its numbers, rules and spacing."""
    return " ".join(NUMBER.sub("#", re.sub("[─-╿]", " ", line)).split())


def check_output(page: str, block: Block, output: str) -> None:
    printed = [shape(line) for line in output.splitlines()]
    for line in block.body.splitlines():
        parts = [shape(part) for part in line.split("…")]
        found = any(all(part in candidate for part in parts) for candidate in printed)
        assert found, f"{page}, line {block.line}: not printed: {line}\n{output}"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Flights of one page serve the next."""
    return tmp_path_factory.mktemp("cache")


QUICK = ("README.md", "docs/start.md", "docs/howto/estimator.md", "docs/howto/policy.md", "docs/howto/sensitivity.md")
"""Pages of every run of the tests; with TESTBED_SLOW=1 all of them, which takes some minutes."""


@pytest.mark.parametrize("page", [page for page in RUN if page in QUICK or "TESTBED_SLOW" in os.environ])
def test_every_block_runs_and_prints_what_is_pasted(page, tmp_path, monkeypatch, cache):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(cache))
    monkeypatch.setattr("testbed.report.figures.drawings", lambda _result: {})
    namespace: dict[str, object] = {}
    output = ""
    for block in blocks(PAGES[page]):
        body = block.body
        for long, short in SHORTER.items():
            body = body.replace(long, short)
        tool = block.comment.removeprefix("needs ")
        if block.comment.startswith("not run: ") or (tool != block.comment and shutil.which(tool) is None):
            continue
        if block.comment.startswith("file: "):
            Path(block.comment.removeprefix("file: ")).write_text(body, encoding="utf-8")
        elif block.language == "python":
            exec(compile(body, f"{page}, line {block.line}", "exec"), namespace)
        elif block.language == "sh":
            output = ""
            for line in body.splitlines():
                if not line.startswith("testbed "):
                    subprocess.run(line, shell=True, check=True)
                    continue
                code, said = command_line(line)
                expected = re.search(r"# exit code (\d)", line)
                if not line.startswith("testbed compare"):
                    assert code == (int(expected[1]) if expected else 0), f"{page}: {line}\n{said}"
                output += said
        elif block.language == "text":
            if not block.comment.startswith("not compared: "):
                check_output(page, block, output)
        else:
            assert block.language in ("", "bibtex") or block.language.startswith("{"), (
                f"{page}, line {block.line}: nothing runs a block of {block.language}"
            )


@pytest.mark.parametrize("page", PAGES)
def test_targets_of_make_exist(page):
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for target in re.findall(r"(?:^|`)make (\w+)", PAGES[page], re.M):
        assert target in targets


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    """Files beside the page, and pages of the documentation; those that a build writes are checked by the build."""
    folder = (ROOT / page).parent
    for target in re.findall(r"\]\(([^)#:]+)[^):]*\)", PAGES[page]):
        assert (folder / target).exists(), target
    for target in re.findall(r"\{doc\}`(?:[^`<]*<)?([^`>]+)>?`", PAGES[page]):
        file = (DOCS / target.lstrip("/") if target.startswith("/") else folder / target).with_suffix("")
        made = any(part in target for part in ("generated/", "auto_gallery/"))
        assert made or any(file.with_name(file.name + end).exists() for end in (".md", ".rst")), target


def test_the_readme_stays_short():
    assert len(PAGES["README.md"].splitlines()) <= 200


def test_every_shipped_scenario_has_a_row():
    for path in (ROOT / "scenarios").glob("*.toml"):
        assert f"| `{path.stem}` |" in PAGES["docs/shipped.md"]


@pytest.mark.parametrize("page", PAGES)
def test_every_option_on_a_page_exists(page):
    """Also of the commands that are not run here."""
    import typer.main

    group = typer.main.get_command(cli.app.app)
    lines = [line for block in blocks(PAGES[page]) if block.language == "sh" for line in block.body.splitlines()]
    for line in lines:
        words = shlex.split(line, comments=True)
        if words[:1] != ["testbed"]:
            continue
        known = {
            name
            for parameter in group.commands[words[1]].params
            for name in (*parameter.opts, *parameter.secondary_opts)
        }
        assert {word for word in words[2:] if word.startswith("--")} <= known, line


def test_the_pages_leave_nothing_in_the_repository():
    """Their files belong in folders of their own."""
    names = "mine.py my_filter.py my-flight.toml sensors.toml recorded.toml mine paper.toml outliers.toml tuned.toml names.toml still.csv"
    for name in names.split():
        assert not (ROOT / name).exists()
