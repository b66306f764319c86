"""The atmospheric check cases of the NASA Engineering and Safety Center that need no aircraft, flown by JSBSim as the bench
sets it up: cases 1, 2, 3, 6, 9, 10 of NASA/TM-2015-218675 (WGS-84 with J2, US 1976 atmosphere, no wind, 30 s).

``python tests/nesc_cases.py FOLDER`` writes the table of `reports/nesc.md` from the published histories in FOLDER
(``Atmos_02_sim_04.csv`` ...). Feet, slugs and degrees as in the report; differences in SI.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from testbed.flight.driver import STEP_HZ
from testbed.flight.simulator import FOOT, IN_THE_AIR, INTEGRATORS, _load
from testbed.physics.earth import principal_radii
from testbed.physics.rotations import attitude_errors, eulers_to_quats

KEYS = (
    ["altitudeMsl_ft", "latitude_deg", "longitude_deg", *(f"feVelocity_ft_s_{axis}" for axis in "XYZ")]
    + [f"eulerAngle_deg_{axis}" for axis in ("Roll", "Pitch", "Yaw")]
    + [f"bodyAngularRateWrtEi_deg_s_{axis}" for axis in ("Roll", "Pitch", "Yaw")]
)
PROPERTIES = (
    ["position/h-sl-ft", "position/lat-geod-deg", "position/long-gc-deg"]
    + [f"velocities/v-{axis}-fps" for axis in ("north", "east", "down")]
    + [f"attitude/{axis}-rad" for axis in ("phi", "theta", "psi")]
    + [f"velocities/{axis}i-rad_sec" for axis in "pqr"]
)
EARTH_DPS = 0.004178073
"""Rotation of the Earth, °/s: JSBSim's initial rates are relative to it, the report's are inertial."""


class Case(NamedTuple):
    """A body and its start: drag coefficient, damping coefficients, height, velocity north, east, down, heading, rates."""

    body: str
    drag: float
    damping: float
    height_ft: float
    v_fps: tuple[float, float, float]
    heading_deg: float
    rates_dps: tuple[float, float, float]


CASES = {
    "01": Case("sphere", 0.0, 0.0, 30000.0, (0.0, 0.0, 0.0), 0.0, (-EARTH_DPS, 0.0, 0.0)),
    "02": Case("brick", 0.0, 0.0, 30000.0, (0.0, 0.0, 0.0), 0.0, (10.0 - EARTH_DPS, 20.0, 30.0)),
    "03": Case("brick", 0.0, -1.0, 30000.0, (0.0, 0.0, 0.0), 0.0, (10.0 - EARTH_DPS, 20.0, 30.0)),
    "06": Case("sphere", 0.1, 0.0, 30000.0, (0.0, 0.0, 0.0), 0.0, (-EARTH_DPS, 0.0, 0.0)),
    "09": Case("sphere", 0.1, 0.0, 0.0, (0.0, 1000.0, -1000.0), 90.0, (0.0, 0.0, 0.0)),
    "10": Case("sphere", 0.1, 0.0, 0.0, (1000.0, 0.0, -1000.0), 0.0, (0.0, 0.0, 0.0)),
}
BODIES = {  # inertia slug ft2, mass slug, reference area ft2, span and chord ft
    "sphere": ((3.6, 3.6, 3.6), 1.0, 0.1963495, 0.5, 0.5),
    "brick": ((0.001894220, 0.006211019, 0.007194665), 0.155404754, 0.22222, 0.33333, 0.66667),
}


def model_xml(body: str, drag: float, damping: float) -> str:
    """The body as a JSBSim model: drag along the flow, and moments -q S l (l / 2V) rate."""
    inertia, mass, area, span, chord = BODIES[body]
    pressure = "<property>aero/qbar-psf</property><property>metrics/Sw-sqft</property>"
    moments = "".join(
        f'<axis name="{axis}"><function name="aero/moment/{axis}"><product>{pressure}<property>metrics/{length}</property>'
        f"<property>aero/{half}</property><property>velocities/{rate}-aero-rad_sec</property><value>{damping}</value>"
        "</product></function></axis>"
        for axis, length, half, rate in (
            ("ROLL", "bw-ft", "bi2vel", "p"),
            ("PITCH", "cbarw-ft", "ci2vel", "q"),
            ("YAW", "bw-ft", "bi2vel", "r"),
        )
    )
    moments_of_inertia = "".join(
        f'<i{axis}{axis} unit="SLUG*FT2">{value}</i{axis}{axis}>' for axis, value in zip("xyz", inertia, strict=True)
    )
    origin = "<x> 0 </x><y> 0 </y><z> 0 </z></location>"
    return f"""<?xml version="1.0"?><fdm_config name="{body}" version="2.0"><fileheader/>
<metrics><wingarea unit="FT2">{area}</wingarea><wingspan unit="FT">{span}</wingspan><chord unit="FT">{chord}</chord>
<location name="AERORP" unit="FT">{origin}</metrics>
<mass_balance>{moments_of_inertia}<emptywt unit="SLUG">{mass}</emptywt><location name="CG" unit="FT">{origin}</mass_balance>
<ground_reactions/><aerodynamics><axis name="DRAG"><function name="aero/force/drag"><product>{pressure}
<value>{drag}</value></product></function></axis>{moments}</aerodynamics></fdm_config>"""


def fly(number: str, rules: tuple[int, int, int, int] = IN_THE_AIR, step_hz: float = STEP_HZ) -> np.ndarray:
    """Rows every 0.1 s for 30 s in the order of `KEYS`, angles in rad, by the bench's own loading, step and integrators."""
    case = CASES[number]
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / f"{case.body}.xml").write_text(model_xml(case.body, case.drag, case.damping))
        aircraft: Any = SimpleNamespace(model=SimpleNamespace(shipped=False, jsbsim=case.body, stand_in={}))
        fdm = _load(aircraft, Path(place), 1.0 / step_hz)
    for name, rule in zip(INTEGRATORS, rules, strict=True):
        fdm[name] = rule
    fdm["ic/lat-geod-deg"], fdm["ic/long-gc-deg"], fdm["ic/h-sl-ft"] = 0.0, 0.0, case.height_ft
    fdm["ic/psi-true-deg"], fdm["ic/theta-deg"], fdm["ic/phi-deg"] = case.heading_deg, 0.0, 0.0
    for axis, v in zip("ned", case.v_fps, strict=True):
        fdm[f"ic/v{axis}-fps"] = v
    for axis, rate in zip("pqr", case.rates_dps, strict=True):
        fdm[f"ic/{axis}-rad_sec"] = np.radians(rate)
    fdm.run_ic()
    rows = [[fdm[name] for name in PROPERTIES]]
    for _ in range(300):
        for _ in range(round(0.1 * step_hz)):
            fdm.run()
        rows.append([fdm[name] for name in PROPERTIES])
    return np.array(rows)


def read(file: Path, **only: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and rows in the order of `KEYS`, angles in rad, of a published history, or of the rows with these entries."""
    with file.open() as text:
        table = [r for r in csv.DictReader(text) if all(r[key] == value for key, value in only.items())]
    rows = np.array([[float(r[key]) for key in KEYS] for r in table])
    rows[:, 6:] = np.radians(rows[:, 6:])
    return np.array([float(r["time"]) for r in table]), rows


def differences(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Largest differences: horizontal and height (m), velocity (m/s), attitude (deg), inertial rate (deg/s)."""
    radii = principal_radii(0.0)
    along = np.radians(a[:, 1:3] - b[:, 1:3]) * (np.array(radii) + b[:, :1] * FOOT)
    turn = attitude_errors(eulers_to_quats(a[:, 6:9].copy()), eulers_to_quats(b[:, 6:9].copy()))
    return {
        "horizontal_m": np.hypot(*along.T).max(),
        "height_m": FOOT * np.abs(a[:, 0] - b[:, 0]).max(),
        "velocity_mps": FOOT * np.linalg.norm(a[:, 3:6] - b[:, 3:6], axis=1).max(),
        "attitude_deg": np.degrees(np.linalg.norm(turn, axis=1)).max(),
        "rate_dps": np.degrees(np.abs(a[:, 9:] - b[:, 9:]).max()),
    }


def table(folder: Path) -> str:
    """The bench and the agency's other simulators against simulator 04, case by case, as Markdown."""
    lines = [
        "| case | simulator | horizontal, m | height, m | velocity, m/s | attitude, ° | rate, °/s |",
        "| --- " * 7 + "|",
    ]
    for number in CASES:
        _, reference = read(folder / f"Atmos_{number}_sim_04.csv")
        others = {f"sim {sim}": read(folder / f"Atmos_{number}_sim_{sim}.csv")[1] for sim in ("01", "02", "06")}
        flown = {"this bench": fly(number), "JSBSim as it comes, 120 Hz": fly(number, (1, 3, 1, 4), 120.0)}
        for name, rows in (flown | others).items():
            n = min(len(rows), len(reference))
            found = differences(rows[:n], reference[:n])
            if name == "sim 02":
                found["horizontal_m"] = np.nan
            cells = ["–" if np.isnan(x) else f"{x:.2g}" for x in found.values()]
            lines.append(f"| {int(number)} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
