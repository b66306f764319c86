"""Scenarios that ended in a traceback, a hang or worse: one message with file, key and what would be right, exit code 2."""

import shutil
import sys
from pathlib import Path

import pytest
import tomli_w
from command_line import call
from damage import FLIGHT
from result_folder import make_result

from testbed import cli
from testbed.base.csv_text import csv_text, read_csv
from testbed.base.errors import LONGEST_LINE, MOST_LINES, InputError, TestbedError, shown
from testbed.base.schema import dump_toml, parse_toml
from testbed.report import text
from testbed.report.labels import short_name
from testbed.report.results import load_result
from testbed.scenario import load_scenario

CASES = Path(__file__).parents[3] / "shared" / "cases" / "broken"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="the collected cases are not there")


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / ".cache"))
    return tmp_path


def write(changes: dict, name: str = "made.toml") -> str:
    """The small flight with dotted keys changed."""
    from testbed.scenario import set_key

    data = parse_toml(tomli_w.dumps(FLIGHT), "made")
    for key, value in changes.items():
        set_key(data, key, value, "made")
    Path(name).write_text(dump_toml(data), encoding="utf-8")
    return name


TEXTS = {
    "a = " + "[" * 5000 + "]" * 5000: "nested too deep",
    "a = " + "[" * 40 + "]" * 40: "32 tables and lists deep",
    ".".join("a" * 40) + " = 1": "32 tables and lists deep",
    "a = " + "9" * 5000: "at most 64 bits",
    "a = 0x" + "f" * 5000: "at most 64 bits",
    "a = 9223372036854775808": "at most 64 bits",
    "a = 2020-01-01": "no key takes a date",
    "\0": "not valid TOML",
    "": "'scenario' is missing",
}


@pytest.mark.parametrize("content", TEXTS, ids=[*map(str, range(len(TEXTS)))])
def test_text_that_is_no_scenario(content, workplace):
    Path("made.toml").write_text(content)
    code, said = call("run", "made.toml", "--out", "out")
    assert code == 2 and said.startswith("testbed: made.toml: ") and TEXTS[content] in said
    assert not Path("out").exists()


VALUES = {
    "profiles": (3, "'profiles' holds tables [profiles.NAME], got 3"),
    "variants": (["rough"], "'variants' holds tables [variants.NAME], got ['rough']"),
    "profiles.smoke": (3, "'profiles.smoke' should be a table of settings, got 3"),
    "estimators.1.params": (3, "'estimators.1.params' should be a table, got 3"),
    "estimators.0.params_file": ("absent.toml", "'estimators.0.params_file': absent.toml: no such file"),
    "estimators.0.label": ("x" * 400, "'estimators.0.label': string should have at most 100 characters, got 'xxxx"),
    "estimators.0.label ": ("a\nb", "one line of printable characters"),
    "monte_carlo.disperse": ({"manoeuvres.1.bank_deg": {"normal": [30.0, -1.0]}}, "sigma must not be negative, is -1"),
    "monte_carlo.disperse ": (
        {"manoeuvres.1.bank_deg": {"uniform": [9.0, 5.0]}},
        "low (9) must not lie above high (5)",
    ),
    "monte_carlo.disperse  ": ({"manoeuvres.0.duration_s": {"uniform": [-1e308, 1e308]}}, "got -1e+308"),
    "monte_carlo.disperse   ": ({"manoeuvres.².x": {"normal": [1.0, 1.0]}}, "'²' is not a position from 0 to 2"),
    "monte_carlo.runs": (10**9, "'monte_carlo.runs': input should be less than or equal to 999999"),
    "monte_carlo.timeout_s": (1e300, "'monte_carlo.timeout_s'"),
    "flight.duration_s": (1e-9, "a flight of 1e-09 s at 50 Hz is too short: it needs 4 samples"),
    "flight.duration_s ": (0.03, "a flight of 0.03 s at 50 Hz is too short"),
    "flight.aircraft": ("/", "/: not an aircraft: it has no aircraft.toml"),
    "flight.aircraft ": ("y/" * 3000, "not an aircraft: File name too long"),
    "flight.manoeuvres.2.points.0.north_m": (1e300, "less than or equal to 20000000, got 1e+300"),
    "sensors.gnss.outliers.count": (10**7, "10000000 bursts are more than the "),
    "sensors.gnss.rate_hz": (1e300, "'rate_hz' must be at most 10000, is 1e+300"),
    "sensors.gnss.random_outages": ({"count": 10**7, "duration_s": 1e-6}, "less than or equal to 10000"),
    "scenario.title": (["x" * 100_000], "should be a valid string"),
}


@pytest.mark.parametrize("key", VALUES)
def test_values_that_mean_nothing(key, workplace):
    value, told = VALUES[key]
    if key.startswith("flight.duration_s"):
        changes = {"monte_carlo.disperse": {}, "monte_carlo.vary": ["noise"], "windows": [], "sensors.gnss.outages": []}
    else:
        changes = {"sensors.gnss.outages": []} if "random_outages" in key else {}
    file = write({**changes, key.strip(): value})
    code, said = call("run", file, "--out", "out", "--jobs", "1")
    assert code == 2 and told in said and "made.toml" in said
    assert len(said) < 1000
    assert not Path("out").exists()


@pytest.mark.parametrize("value", ["²", "9" * 5000, "1000000000"])
def test_numbers_of_the_command_line(value, workplace):
    code, said = call("run", "quickstart", "--runs", value, "--out", "out")
    assert code == 2 and "--runs" in said and len(said) < 1200
    assert call("run", "quickstart", "--set", "flight.manoeuvres.².bank_deg=3")[0] == 2
    assert call("run", "quickstart", "--timeout", "inf", "--out", "out")[0] == 2


def test_resolved_text_reads_back_whatever_stands_in_it(workplace):
    odd = {"params": {"": 1, "a b": "\x7f\x00\u2028\"'\\", "deep": [{"x": [1, {"y": []}]}], "f": 1e300, "big": 2**62}}
    file = write({"extra": {"free": odd, "list": [{}, {"a": []}], "mixed": [1, {"b": 2}]}})
    scenario = load_scenario(file)
    assert parse_toml(scenario.to_toml(), "again") == scenario.to_data()


def test_a_message_fits_a_screen():
    assert len(shown("x" * 100_000)) < 100 and len(shown(["x"] * 10_000)) < 100
    message = str(InputError("\n".join(["key " + "y" * 100_000] * 1000)))
    assert len(message.splitlines()) == MOST_LINES + 1 and max(map(len, message.splitlines())) <= LONGEST_LINE
    assert str(InputError(message)) == message  # what is short already stays


@pytest.mark.parametrize(
    "error", [KeyError("x"), RecursionError("deep"), MemoryError(), OSError(28, "No space left on device")]
)
def test_an_error_of_the_bench_is_one_line_with_a_way_to_report_it(error, workplace, monkeypatch, capsys):
    from testbed.cli import commands

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(commands, "fly", fail)
    code, said = call("fly", "quickstart")
    assert code == 1 and len(said.splitlines()) == 1
    assert type(error).__name__ in said and "test_broken_cases.py:" in said
    assert "to report it, send the output of 'testbed fly quickstart --debug'" in said
    monkeypatch.setattr(sys, "argv", ["testbed", "fly", "quickstart", "--debug"])
    with pytest.raises(type(error)):
        cli.main()


def test_nothing_of_a_name_reaches_tex(tmp_path):
    """``\\label`` takes no escapes: what it is made of loses every special character."""
    from dataclasses import replace

    name = r"w}\input{/etc/passwd}\write18{touch victim.txt"
    result = load_result(make_result(tmp_path, runs=3))
    result = replace(result, summary=result.summary.replace("outage_1", name))
    made = text.latex(result)
    assert r"\input{" not in made and r"\write18" not in made
    labels = [line for line in made.splitlines() if "\\label" in line]
    assert len(labels) == len(set(labels))


def test_a_text_cell_never_becomes_a_formula(tmp_path):
    import pandas as pd

    labels = ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "'=quoted", "plain", "-5", ""]
    frame = pd.DataFrame({"estimator": labels, "=head": range(8), "value": [-1.5] * 8})
    written = csv_text(frame)
    cells = [line.split(",") for line in written.splitlines()]
    assert all(cell[0] not in "=+@" for row in cells for cell in row if cell)
    assert cells[3] == ["'-1+1", "2", "-1.5"]  # numbers stay numbers
    (tmp_path / "t.csv").write_text(written)
    again = read_csv(tmp_path / "t.csv")
    assert again["estimator"].fillna("").tolist() == labels and list(again) == list(frame)


def test_a_row_may_be_called_like_a_formula_or_a_sentence(workplace):
    label = "=" + "x" * 99
    file = write({"estimators.0.label": label, "claims": [], "tables": [], "estimators.1.label": "$\\frac{$"})
    assert call("run", file, "--jobs", "1", "--out", "out")[0] == 0
    assert f"\n'{label},all," in Path("out/summary.csv").read_text()
    assert load_result("out").estimators == [label, "$\\frac{$"]
    assert len(short_name(label, 40)) == 40


def test_the_help_names_the_switch(workplace):
    from typer.testing import CliRunner

    assert "--debug" in CliRunner().invoke(cli.app.app, ["--help"]).output


WORK = ("html-injection", "label-100", "s2-12-47", "tex-label", "pf")
"""Legal ones (`pf` is a parameter file)."""


@needs_cases
@pytest.mark.parametrize("case", sorted(p.name for p in CASES.glob("*.toml")) if CASES.is_dir() else [])
def test_collected_cases(case, workplace):
    shutil.copytree(CASES, "broken", ignore=shutil.ignore_patterns("aircraft", "weights"))
    before = sorted(workplace.rglob("*"))
    if Path(case).stem in WORK:
        if case != "pf.toml":
            load_scenario(Path("broken") / case)
        return
    code, said = call("run", f"broken/{case}", "--jobs", "1", "--out", "out")
    assert code == 2, said
    assert case in said and len(said) < 1000
    assert before == [p for p in sorted(workplace.rglob("*")) if ".cache" not in p.parts]


@needs_cases
@pytest.mark.parametrize("case", sorted(p.name for p in (CASES / "aircraft").glob("*")) if CASES.is_dir() else [])
def test_collected_aircraft(case, workplace):
    shutil.copytree(CASES / "aircraft" / case, case)
    before = sorted(workplace.rglob("*"))
    file = write({"flight.aircraft": f"./{case}"})
    code, said = call("fly", file, "--out", "out")
    assert code == 2 and f"{case}/" in said and "made.toml" in said
    after = {path for path in workplace.rglob("*") if ".cache" not in path.parts}
    assert after == {*before, workplace / "made.toml"}


def test_errors_keep_their_kind():
    assert issubclass(InputError, TestbedError) and InputError("x").exit_code == 2
