"""The mistakes that users make at every verb: exit code 2, one message that says what would be right, nothing written."""

import re
import shlex
import sys
from pathlib import Path

import pytest
from command_line import SHORT, call

from testbed import cli
from testbed.base.resources import scenario_root
from testbed.scenario import load_scenario


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / ".cache"))
    Path("a-file").write_text("text")
    Path("full").mkdir()
    Path("full/something").write_text("text")
    Path("syntax.py").write_text("def run(:\n")
    Path("ends.py").write_text("import sys\nsys.exit(0)\n")
    Path("gps.py").write_text(
        "class Gps:\n    name = 'gps-only'\n    sensors = ('imu', 'gps')\n    def run(self, log):\n        return None\n"
    )
    Path("nothing.py").write_text("x = 1\n")
    Path("taken.py").write_text("class Mine:\n    name = 'indirect-kf'\n    def run(self, log):\n        return None\n")
    Path("broken.toml").write_text("[flight\n")
    text = (scenario_root() / "quickstart.toml").read_text()
    Path("own.toml").write_text(text)
    Path("misspelt.toml").write_text(text.replace("bank_deg = 35.0", "bnak_deg = 35.0"))
    Path("quoted.toml").write_text(text.replace("duration_s = 10.0", 'duration_s = "10.0"'))
    return tmp_path


MISTAKES = {
    "fly quickstrt": ["'quickstart'"],
    "fly quickstart --out a-file": ["a-file", "--out"],
    "fly quickstart --out a-file/below": ["a-file", "--out"],
    "fly quickstart --out full": ["full", "not an empty folder"],
    "fly quickstart --set flight.rate_hz": ["KEY=VALUE"],
    "fly quickstart --set flight.rate_hz=fast": ["flight.rate_hz", "'fast'"],
    "fly quickstart --set flight.manoeuvres.99.bank_deg=3": ["99", "0 to 6"],
    "fly quickstart --set flight.aircraft=aersonde": ["'aerosonde'"],
    "fly quickstart --variant none": ["uncalibrated"],
    "fly quickstart --seed -1": ["--seed"],
    "fly broken.toml": ["broken.toml", "TOML"],
    "sense quickstart --out full": ["full"],
    "sense quickstart --set sensors.imu.model=ADIS1644": ["'ADIS16448'"],
    "sense quickstart --set sensors.imu.file=absent.toml": ["absent.toml"],
    "allan absent": ["absent"],
    "allan a-file": ["a-file"],
    "allan full --out a-file": ["a-file", "--out"],
    "import navgo full --out out": ["'navego'"],
    "import navego absent --out out": ["absent", "no such"],
    "import table full --out out": ["imu", "something"],
    "import table full --out a-file": ["a-file"],
    "report absent": ["absent", "testbed run"],
    "report full full --out a-file": ["a-file"],
    "report full --out index": ["--out index", "several results", "stands in full"],
    "compare full full": ["full", "no result"],
    "list sensor": ["'sensors'"],
    "new scenari mine": ["'scenario'"],
    "run quickstart --runs 0": ["--runs 0"],
    "run quickstart --runs many": ["'auto'"],
    "run quickstart --jobs 0": ["--jobs"],
    "run quickstart --cap 0": ["--cap"],
    "run quickstart --cap 3": ["--cap", "--runs auto"],
    "run quickstart --width 3 --runs 5": ["--width", "--runs auto"],
    "run quickstart --readings --runs 2 --width 10": ["--width", "--readings without --runs"],
    "fly quickstart --seed 5 --set monte_carlo.seed=3": ["--seed", "'monte_carlo.seed'", "two values"],
    "fly quickstart --seed 5 --set monte_carlo={seed=3}": ["--seed", "'monte_carlo.seed'", "two values"],
    "run quickstart --runs 3 --set monte_carlo.runs=5": ["--runs", "'monte_carlo.runs'", "two values"],
    "run quickstart --runs 3 --sweep monte_carlo.runs=5,6": ["--runs", "'monte_carlo.runs'", "two values"],
    "run quickstart --runs auto --set monte_carlo.runs=5": ["--runs", "'monte_carlo.runs'", "two values"],
    "run quickstart --readings --set monte_carlo.runs=5": ["--readings without --runs", "'monte_carlo.runs'"],
    "run quickstart --timeout 3 --set monte_carlo.timeout_s=5": ["--timeout", "'monte_carlo.timeout_s'"],
    "sense quickstart --runs 3 --set monte_carlo.runs=5": ["--runs", "'monte_carlo.runs'", "two values"],
    "tune quickstart --population 9 --set extra.tune.population=8": ["--population", "'extra.tune.population'"],
    "dataset quickstart --flights 3 --set extra.dataset.flights=4": ["--flights", "'extra.dataset.flights'"],
    "run quickstart --estimators inns": ["'ins'"],
    "run quickstart --estimators ,": ["at least one"],
    "run quickstart --set monte_carlo.rns=3": ["'runs'"],
    "run quickstart --set estimators.0.params.gain=3 --out out": ["'estimators.0'", "'ins'", "gain"],
    "run quickstart --set estimators.indirect-kf.params.gyro_bias_scale=much --out out": ["a number", "'much'"],
    "run quickstart --set estimators.indirect-kff.params.x=1 --out out": ["'indirect-kf'", "--plugin"],
    "run quickstart --set estimators.ins.params.x=1 --estimators indirect-kf": ["--estimators leaves 'ins' out"],
    "run quickstart --set estimators.0.params.x=1 --estimators indirect-kf": ["--estimators leaves 'ins' out"],
    "run quickstart --estimators +pyins,ins": ["'+'"],
    "run quickstart --estimators ins,ins": ["'ins' stands twice"],
    "run quickstart --estimators mine": ["--plugin FILE.py"],
    "run own": ["own.toml"],
    "run misspelt.toml": ["bnak_deg'", "'bank_deg'"],
    "run quoted.toml": ["'10.0'", "without quotes"],
    "run quickstart --set claims.0.metric=rmse_pos_m --out out": ["testbed list metrics"],
    "run quickstart --sweep sensors.imu.rate_hz": ["KEY=V1,V2"],
    "run quickstart --sweep sensors.imu.rate=50,100": ["'rate_hz'"],
    "run quickstart --sweep initial.position_m=1,1": ["--sweep initial.position_m", "1 stands twice"],
    "run quickstart --sweep initial.position_m=1,2,1.0": ["--sweep initial.position_m", "1.0 stands twice"],
    "run quickstart --sweep initial.yaw_deg=1,2 --sweep initial.yaw_deg=3,4": ["initial.yaw_deg is given twice"],
    "run quickstart --sweep initial.yaw_deg=1,2 --set initial.yaw_deg=5": ["--set initial.yaw_deg has no effect"],
    "run quickstart --sweep sensors.gnss={} --set sensors.gnss.rate_hz=5": ["--set sensors.gnss.rate_hz", "--sweep"],
    "run quickstart --sweep monte_carlo.seed=1,2 --seed 3": ["--seed has no effect", "--sweep monte_carlo.seed"],
    "fly quickstart --set flight.rate_hz=50 --set flight.rate_hz=100": ["--set flight.rate_hz has no effect", "later"],
    "run quickstart --plugin syntax.py": ["syntax.py", "line 1"],
    "run quickstart --plugin ends.py": ["ends.py: the plug-in does not import: SystemExit: 0"],
    "run quickstart --plugin gps.py --estimators gps-only": [
        "'sensors' of estimator 'gps-only' names 'gps'",
        "valid: imu,",
    ],
    "run quickstart --plugin nothing.py": ["nothing.py", "run(log)"],
    "run quickstart --plugin absent.py": ["absent.py"],
    "run quickstart --plugin taken.py": ["taken.py", "'indirect-kf'", "ships"],
    "run quickstart --out a-file": ["a-file"],
    "run quickstart --out full": ["full"],
    "run navego --set recording.dir=full --out out": ["full", "imu"],
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_told_in_one_message(line, workplace):
    before = sorted(path for path in workplace.rglob("*") if ".cache" not in path.parts)
    code, said = call(*line.split())
    assert code == 2, said
    assert "Traceback" not in said and "is missing" not in said
    assert len(said.strip().splitlines()) <= 6  # a usage error of the option parser comes in a frame
    for word in MISTAKES[line]:
        assert word in said
    assert before == sorted(path for path in workplace.rglob("*") if ".cache" not in path.parts)


def test_why_an_estimator_failed_is_told(workplace):
    """A row of dashes would leave its author guessing; when no row is left, the work has failed (exit code 1)."""
    Path("fails.py").write_text("class Fails:\n    name = 'fails'\n    def run(self, log):\n        return 1 / 0\n")
    options = (
        "--runs",
        "1",
        "--jobs",
        "1",
        "--no-report",
        "--set",
        "flight.duration_s=10",
        "--set",
        "sensors.gnss.outages=[]",
    )
    options = (*options, "--set", "windows=[]", "--plugin", "fails.py")
    code, said = call("run", "quickstart", *options, "--estimators", "fails,ins", "--out", "two")
    assert code == 0, said
    assert "fails: not ok in 1 of 1 runs" in said and "division by zero" in said
    code, said = call("run", "quickstart", *options, "--estimators", "fails", "--out", "one")
    assert code == 1
    assert "no estimator" in said


def test_the_reason_names_the_line_of_the_estimator_not_of_the_library(workplace):
    text = "import numpy as np\nclass Fails:\n    name = 'fails'\n    def run(self, log):\n        return np.linalg.inv(np.zeros((2, 2)))\n"
    Path("fails.py").write_text(text)
    options = [
        *SHORT,
        "--no-report",
    ]
    said = call(
        "run", "quickstart", *options, "--runs", "1", "--jobs", "1", "--plugin", "fails.py", "--estimators", "fails"
    )[1]
    assert "Singular matrix (fails.py:5)" in said


def test_what_becomes_of_stored_runs_is_told(workplace):
    options = [
        *SHORT,
        "--no-report",
    ]
    options += ["--jobs", "1", "--estimators", "ins", "--out", "out"]
    assert "earlier" not in call("run", "quickstart", *options, "--runs", "2")[1]
    assert "tables and report are of the first 1" in call("run", "quickstart", *options, "--runs", "1", "--resume")[1]
    assert "holds 2 runs of an earlier result" in call("run", "quickstart", *options, "--runs", "1")[1]


def test_a_folder_does_not_hide_a_shipped_scenario(workplace):
    Path("quickstart").mkdir()
    assert load_scenario("quickstart").name == "quickstart"


def test_a_changed_scenario_does_not_resume(workplace):
    short = ("--jobs", "1", "--no-report", "--estimators", "ins", "--set", "flight.duration_s=10", "--out", "out")
    short = (*short, "--set", "sensors.gnss.outages=[]", "--set", "windows=[]")
    assert call("run", "quickstart", "--runs", "1", *short)[0] == 0
    code, said = call("run", "quickstart", "--runs", "2", "--seed", "7", "--resume", *short)
    assert code == 2
    assert "another batch" in said
    assert call("run", "quickstart", "--runs", "2", "--resume", *short)[0] == 0


def test_shells_are_offered_names(monkeypatch):
    """What follows TAB after the words so far."""
    import typer.main
    from typer.testing import CliRunner

    def offered(words: str, number: int) -> list[str]:
        environment = {"_TESTBED_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(number)}
        done = CliRunner().invoke(cli.app.app, prog_name="testbed", env=environment)
        return done.output.split()

    assert typer.main.get_command(cli.app.app).name == "testbed"
    assert offered("testbed run quick", 2) == ["quickstart"]
    assert offered("testbed run quickstart --variant ", 4) == ["uncalibrated"]
    assert offered("testbed run quickstart --profile s", 4) == ["smoke"]
    assert offered("testbed run quickstart --estimators ins,direct-e", 4) == ["ins,direct-ekf"]
    assert offered("testbed list se", 2) == ["sensors"]
    assert offered("testbed new ", 2)[:2] == ["estimator", "c-filter"] and len(offered("testbed new ", 2)) == 6
    assert offered("testbed import na", 2) == ["navego"]


def test_run_without_a_scenario_shows_what_can_be_run(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["testbed", "run"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "quickstart" in capsys.readouterr().out


HALF = """
import numpy as np
from testbed import NavSolution

class Part:
    name = "part"
    def __init__(self, part="first"):
        self.part = part
    def run(self, log):
        t, s = log.imu.t, log.initial
        n = len(t)
        lat, lon, h, v, q = np.full(n, s.lat), np.full(n, s.lon), np.full(n, s.h), np.tile(s.v_n, (n, 1)), np.tile(s.q_nb, (n, 1))
        rows = {"first": slice(0, 100), "hole": np.r_[0:200, n - 200:n], "sparse": slice(None, None, 50)}.get(self.part, slice(None))
        if self.part == "degrees":
            lat, lon = np.degrees(lat), np.degrees(lon)
        if self.part == "zero":
            q = 0.0 * q
        if self.part == "array":
            return q
        return NavSolution(t[rows], lat[rows], lon[rows], h[rows], v[rows], q[rows])
"""
ANSWERS = {
    "first": "covers 0.01 to 1 s of a flight from 0",
    "hole": "says nothing between 2 and ",
    "zero": "unit quaternions, but has norm 0 at sample 0",
    "degrees": "are lat and lon in radians?",
    "array": "returned ndarray, not a NavSolution",
    "sparse": "",
}


@pytest.mark.parametrize("part", ANSWERS)
def test_an_answer_that_cannot_be_compared_is_no_row_of_the_table(part, workplace):
    """A solution of the first second, or with an attitude of length zero, would win what it is not measured on."""
    Path("part.py").write_text(HALF)
    options = [
        *SHORT,
        "--no-report",
    ]
    options += [
        "--runs",
        "1",
        "--jobs",
        "1",
        "--estimators",
        "part,update-ins",
        "--set",
        f"estimators.part.params.part={part}",
    ]
    code, said = call("run", "quickstart", "--plugin", "part.py", *options, "--out", "out")
    assert code == 0
    if ANSWERS[part]:
        assert "part: not ok in 1 of 1 runs" in said and ANSWERS[part] in said
    else:
        assert "not ok" not in said


def test_an_estimator_of_ones_own_beside_the_rows_of_a_scenario(workplace):
    """Without ``--estimators`` a plug-in is in no row, which is told; ``+`` adds it; its parameter is set by name."""
    Path("part.py").write_text(HALF)
    quick = [*SHORT, "--no-report"]
    quick += [
        "--runs",
        "1",
        "--jobs",
        "1",
        "--set",
        "estimators=[{name = 'ins'}]",
        "--set",
        "claims=[]",
        "--plugin",
        "part.py",
    ]
    code, said = call("run", "quickstart", *quick, "--out", "without")
    assert code == 0 and "add --estimators +part" in said
    code, said = call("run", "quickstart", *quick, "--estimators", "+part", "--out", "with")
    assert code == 0 and "add" not in said
    assert re.findall(r'name = "(ins|part)"', Path("with/scenario.toml").read_text()) == ["ins", "part"]


def test_claims_that_lose_a_row_are_told(workplace):
    quick = [*SHORT, "--no-report", "--runs", "1", "--jobs", "1"]
    code, said = call("run", "quickstart", *quick, "--estimators", "indirect-kf", "--out", "one")
    assert code == 0 and "not judged, as --estimators leaves out a row that they name: coasting" in said
    code, said = call("run", "quickstart", *quick, "--estimators", "ins,indirect-kf", "--out", "two")
    assert code == 0 and "not judged" not in said


def test_the_command_in_a_report_makes_the_result_again(workplace):
    """Also where ``--set`` changed the scenario: then from the file that the folder keeps."""
    quick = ["--runs", "1", "--jobs", "1", "--estimators", "ins,update-ins", "--set", "flight.duration_s=10"]
    quick += ["--set", "sensors.gnss.outages=[]", "--set", "windows=[]", "--seed", "7"]
    assert call("run", "quickstart", *quick, "--out", "first")[0] == 0
    line = next(line for line in Path("first/report.md").read_text().splitlines() if line.startswith("testbed run"))
    assert call(*shlex.split(line)[1:-1], "again")[0] == 0
    assert Path("first/summary.csv").read_bytes() == Path("again/summary.csv").read_bytes()
