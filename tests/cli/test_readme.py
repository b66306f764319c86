"""The README keeps its word: every command and code block runs, in order, in one empty folder, and prints what is pasted.

A block is left out only behind a comment ``<!-- not run: reason -->``, or ``<!-- needs TOOL -->`` where that program is not
installed; ``<!-- file: NAME -->`` writes it to a file. What
the README does at length is done here in short: few runs in one process, no figures (`test_report` draws them).
"""

import contextlib
import io
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
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
SHORTER = {
    "duration_s=21600.0": "duration_s=1800.0",
    "--cap 200": "--cap 2",
    "--runs 5": "--runs 2",
    "--samples 64": "--samples 2 --trajectories 2 --runs 1",
    "--runs 30": "--runs 3",
    "--runs 40": "--runs 2",
    "dataset ahrs-lstm-2022": "dataset ahrs-lstm-2022 --profile smoke",
    "train ahrs-lstm-2022": "train ahrs-lstm-2022 --profile smoke",
    "tune ipo-2022 --profile smoke": "tune ipo-2022 --profile smoke --algorithms pso",
}
NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    """A fenced block with its language, the comment right above it, and its line in the README."""

    language: str
    body: str
    comment: str
    line: int


def blocks() -> list[Block]:
    fence = re.compile(r"(?:<!-- (?P<comment>[^>]*) -->\n)?```(?P<language>\w*)\n(?P<body>.*?)```\n", re.S)
    return [
        Block(m["language"], m["body"], m["comment"] or "", TEXT[: m.start("body")].count("\n"))
        for m in fence.finditer(TEXT)
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


def check_output(block: Block, output: str) -> None:
    printed = [shape(line) for line in output.splitlines()]
    for line in block.body.splitlines():
        parts = [shape(part) for part in line.split("…")]
        found = any(all(part in candidate for part in parts) for candidate in printed)
        assert found, f"README line {block.line}: not printed: {line}\n{output}"


def test_every_block_runs_and_prints_what_is_pasted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("testbed.report.figures.drawings", lambda _result: {})
    namespace: dict[str, object] = {}
    output = ""
    for block in blocks():
        body = block.body
        for long, short in SHORTER.items():
            body = body.replace(long, short)
        tool = block.comment.removeprefix("needs ")
        if block.comment.startswith("not run: ") or (tool != block.comment and shutil.which(tool) is None):
            continue
        if block.comment.startswith("file: "):
            Path(block.comment.removeprefix("file: ")).write_text(body, encoding="utf-8")
        elif block.language == "python":
            exec(compile(body, f"README.md, line {block.line}", "exec"), namespace)
        elif block.language == "sh":
            output = ""
            for line in body.splitlines():
                if not line.startswith("testbed "):
                    subprocess.run(line, shell=True, check=True)
                    continue
                code, said = command_line(line)
                expected = re.search(r"# exit code (\d)", line)
                if not line.startswith("testbed compare"):
                    assert code == (int(expected[1]) if expected else 0), f"README: {line}\n{said}"
                output += said
        elif block.language == "text":
            if not block.comment.startswith("not compared: "):
                check_output(block, output)
        else:
            assert block.language in ("", "bibtex"), (
                f"README line {block.line}: nothing runs a block of {block.language}"
            )


def test_the_two_commands_that_need_no_set_up_exist():
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for target in re.findall(r"(?:^|`)make (\w+)", TEXT, re.M):
        assert target in targets


def test_links_lead_somewhere():
    """Links into ``reports/`` are made by ``make reports``."""
    for target in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert target.startswith("reports/") or (ROOT / target).exists(), target


def test_every_shipped_scenario_has_a_row():
    for path in (ROOT / "scenarios").glob("*.toml"):
        assert f"| `{path.stem}` |" in TEXT


def test_every_option_in_the_readme_exists():
    """Also of the commands that are not run here."""
    import typer.main

    group = typer.main.get_command(cli.app.app)
    lines = [line for block in blocks() if block.language == "sh" for line in block.body.splitlines()]
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


def test_this_file_leaves_nothing_in_the_repository():
    """The tour's files belong in its own folder."""
    for name in ("mine.py", "my_filter.py", "my-flight.toml", "sensors.toml", "recorded.toml", "mine"):
        assert not (ROOT / name).exists()
