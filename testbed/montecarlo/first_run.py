"""One run in full for the plots: truth, errors with the filter's own sigma, innovations and extras of run 0.

Files of the folder ``details`` of a result, as Parquet bytes, thinned to at most `MAX_ROWS` rows. Units are in the column
names: metres, m/s, degrees, time in seconds from the start of the flight.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.data import specs
from testbed.data.observations import GnssObservations
from testbed.data.records import (
    ACCEL_BIAS_STATES,
    ATTITUDE_STATES,
    GYRO_BIAS_STATES,
    NAVIGATION_STATES,
    Array,
    Innovations,
    NavSolution,
    SensorErrors,
    SensorLog,
    Trajectory,
)
from testbed.physics import rotations
from testbed.scenario import EstimatorConfig, Scenario
from testbed.scoring.metrics import ErrorSeries, consistency
from testbed.scoring.quantities import AXES, NEES

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS = 3000
NIS_RANGE = (0.3, 3.0)
"""Mean NIS of a channel outside of it is told: noise that is off by 1.8 times in sigma, which a data sheet is not."""
POLE_PITCH_DEG = 80.0
"""Beyond it an error of roll or yaw may be the attitude error times 1 / cos(80°) = 5.8."""
CONVERGED_DEG = 10.0
"""1 sigma of a heading that is known: what an alignment takes for the angle between course and heading."""

Solved = tuple[EstimatorConfig, NavSolution, ErrorSeries]


def make(
    scenario: Scenario,
    trajectory: Trajectory,
    log: SensorLog,
    solved: Sequence[Solved],
    errors: SensorErrors | None = None,
) -> dict[str, bytes]:
    """File name -> content: ``truth.parquet``, ``errors-<slug>.parquet``, ``innovations-``, ``extras-``, ``nees-``, ``biases-``,
    ``gnss.parquet``, ``satellites.parquet``, ``info.json``."""
    files = {"truth.parquet": _parquet(_thin(trajectory.to_frame()))}
    slugs = _slugs([entry.row for entry in scenario.estimators])
    channels: dict[str, dict[str, list[str]]] = {}
    components: dict[str, dict[str, list[str]]] = {}
    for entry, solution, series in solved:
        slug = slugs[entry.row]
        files[f"errors-{slug}.parquet"] = _parquet(_thin(errors_frame(solution, series)))
        if len(nees := nees_frame(solution, series, errors)):
            files[f"nees-{slug}.parquet"] = _parquet(nees)
        if len(biases := biases_frame(solution, errors)):
            files[f"biases-{slug}.parquet"] = _parquet(_thin(biases))
        if told := {aiding: nu for aiding, nu in solution.innovations.items() if len(nu.t)}:
            files[f"innovations-{slug}.parquet"] = _parquet(_innovations_frame(told))
            channels[entry.row] = {aiding: list(nu.channels) for aiding, nu in told.items()}
        if solution.extras:
            files[f"extras-{slug}.parquet"] = _parquet(_extras_frame(solution))
            components[entry.row] = {name: list(columns) for name, columns in solution.extra_names.items()}
    if log.gnss is not None:
        files["gnss.parquet"] = _parquet(_thin(log.frames()["gnss"]))
    if isinstance(raw := log.aiding.get("gnss_raw"), GnssObservations) and len(raw.t):
        from testbed.gnss.overview import satellites_frame

        files["satellites.parquet"] = _parquet(satellites_frame(raw))
    sensors = {
        key: specs.to_dict(part.spec) for key, part in [("imu", log.imu), *log.aiding.items()] if hasattr(part, "spec")
    }
    nis = {entry.row: _nis_per_channel(solution) for entry, solution, _ in solved}
    info: dict[str, Any] = {
        "nis_per_channel": nis,
        "final_heading_sigma_deg": _final_heading_sigmas(log, solved),
        "name": scenario.name,
        "title": scenario.scenario.title,
        "source": scenario.scenario.source,
        "phases": [[p.name, p.start, p.end] for p in trajectory.phases],
        "outages": [list(o) for o in log.gnss.outages] if log.gnss is not None else [],
        "estimators": slugs,
        "innovations": channels,
        "components": components,
        "sensors": sensors,
        "units": "specifications in SI units: rad/s, m/s², m, µT, Pa; noise densities per √Hz",
    }
    files["info.json"] = json.dumps(info, indent=1, ensure_ascii=False).encode()
    return files


def innovation_notes(info: Mapping[str, Any]) -> list[str]:
    """A sentence for each aiding of a filter whose innovations are not as large as it takes them for, channel by channel."""
    notes = []
    for row, aidings in info.get("nis_per_channel", {}).items():
        for aiding, channels in aidings.items():
            off = {name: value for name, value in channels.items() if not NIS_RANGE[0] <= value <= NIS_RANGE[1]}
            if off:
                told = ", ".join(f"{name.partition(',')[0]} {value:.2g}" for name, value in off.items())
                notes.append(
                    f"{row}: NIS per channel of the aiding {aiding} in run 0 leaves {NIS_RANGE[0]:g} to {NIS_RANGE[1]:g}, where 1"
                    f" is expected: {told}"
                )
    return notes


def pole_notes(trajectory: Trajectory) -> list[str]:
    """A sentence where the truth comes near the singularity of its Euler angles, and none elsewhere."""
    if "attitude" not in trajectory.known:
        return []
    pitch = np.degrees(np.abs(rotations.quats_to_eulers(trajectory.q_nb)[:, 1]))
    share = float(np.mean(pitch > POLE_PITCH_DEG))
    if not share:
        return []
    return [
        f"Euler angles are singular at a pitch of 90°, and this motion reaches {pitch.max():.4g}° ({100.0 * share:.2g} % of its"
        f" time above {POLE_PITCH_DEG:g}°): there errors of roll and yaw say little; the attitude error, one rotation, is what to read"
    ]


def heading_notes(info: Mapping[str, Any]) -> list[str]:
    """A sentence for each filter that started without a heading and had none at the end."""
    return [
        f"{row}: the heading was unknown at the start and never converged: its 1 sigma at the end is {sigma:.2g}°"
        for row, sigma in info.get("final_heading_sigma_deg", {}).items()
        if sigma > CONVERGED_DEG
    ]


def _final_heading_sigmas(log: SensorLog, solved: Sequence[Any]) -> dict[str, float]:
    """Row -> sigma of the rotation about the vertical at the end (degrees), where the log starts without a heading."""
    if not log.initial.heading_unknown:
        return {}
    found = {}
    for entry, solution, _ in solved:
        if solution.std is not None and ATTITUDE_STATES[2] in solution.states:
            sigma = float(np.degrees(solution.std[-1, solution.states.index(ATTITUDE_STATES[2])]))
            found[entry.row] = round(sigma, 3) if np.isfinite(sigma) else 180.0
    return found


def _nis_per_channel(solution: NavSolution) -> dict[str, dict[str, float]]:
    """Aiding -> channel -> mean of innovation squared over its variance, of the updates that were taken."""
    out: dict[str, dict[str, float]] = {}
    for aiding, every in solution.innovations.items():
        nu = every.taken()
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = nu.value**2 / np.einsum("kii->ki", nu.covariance)
        used = ((name, x[np.isfinite(x)]) for name, x in zip(every.channels, ratio.T, strict=False))
        out[aiding] = {name: round(float(values.mean()), 4) for name, values in used if len(values)}
    return out


def axis_sigmas(solution: NavSolution, rows: Any = slice(None)) -> dict[str, Array]:
    """The filter's own 1-sigma of each of `AXES` that it has states for, at all times or some rows (N,).

    Euler-angle sigmas come from the rotation-vector sigmas through the inverse of `rotations.euler_error_matrix`, without
    the correlations, which ``std`` does not carry.
    """
    if solution.std is None:
        return {}
    std = {name: solution.std[rows, k] for k, name in enumerate(solution.states) if name in NAVIGATION_STATES}
    found = {axis: std[state] for axis, state in zip(AXES[:6], NAVIGATION_STATES[:6], strict=True) if state in std}
    if not set(ATTITUDE_STATES) <= set(std):
        return found
    _, pitch, yaw = rotations.quats_to_eulers(solution.q_nb[rows]).T
    cos_p, tan_p, sin_y, cos_y = np.cos(pitch), np.tan(pitch), np.sin(yaw), np.cos(yaw)
    north, east, down = (std[name] ** 2 for name in ATTITUDE_STATES)
    roll = (cos_y**2 * north + sin_y**2 * east) / cos_p**2
    level = sin_y**2 * north + cos_y**2 * east
    heading = down + tan_p**2 * (cos_y**2 * north + sin_y**2 * east)
    return found | {axis: np.degrees(np.sqrt(v)) for axis, v in zip(AXES[6:], (roll, level, heading), strict=True)}


def _slugs(rows: Sequence[str]) -> dict[str, str]:
    """A file-name part for each estimator row, all different."""
    out: dict[str, str] = {}
    for row in rows:
        slug = base = re.sub(r"[^a-z0-9]+", "-", row.lower()).strip("-") or "estimator"
        k = 2
        while slug in out.values():
            slug, k = f"{base}-{k}", k + 1
        out[row] = slug
    return out


def errors_frame(solution: NavSolution, series: ErrorSeries) -> pd.DataFrame:
    """Errors over time, ``time_s`` and `AXES`; the filter's own ``sigma_`` of each; ``lat_deg, lon_deg, alt_m``. NaN: unknown."""
    import pandas as pd

    columns: dict[str, Array] = {"time_s": series.t}
    scored, nothing = series.axes(), np.full(len(series.t), np.nan)
    columns |= {name: series.values[:, i] if i in scored else nothing for i, name in enumerate(AXES)}
    rows = np.searchsorted(solution.t, series.t - 1e-9)
    columns |= {f"sigma_{name}": sigma[rows] for name, sigma in axis_sigmas(solution).items()}
    placed = bool({0, 1, 2} & set(scored))  # who does not navigate has no track
    place = {"lat_deg": np.degrees(solution.lat), "lon_deg": np.degrees(solution.lon), "alt_m": solution.h}
    columns |= {name: values[rows] if placed else nothing for name, values in place.items()}
    return pd.DataFrame(columns)


def nees_frame(solution: NavSolution, series: ErrorSeries, errors: SensorErrors | None) -> pd.DataFrame:
    """``quantity``, ``time_s``, ``value``, ``dof``: NEES of each group of states at the snapshots of the covariance."""
    import pandas as pd

    tests = {name: test for name, test in consistency(series, solution, errors).items() if name in NEES and len(test.t)}
    parts = [
        pd.DataFrame({"quantity": name, "time_s": test.t, "value": test.value, "dof": test.dof})
        for name, test in tests.items()
    ]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def biases_frame(solution: NavSolution, errors: SensorErrors | None) -> pd.DataFrame:
    """Estimated biases over time, SI: a column for each state, ``true_`` and ``sigma_`` of it where they are known."""
    import pandas as pd

    columns: dict[str, Array] = {}
    for names, kind in ((ACCEL_BIAS_STATES, "accel_bias"), (GYRO_BIAS_STATES, "gyro_bias")):
        if (estimate := getattr(solution, kind)) is None or not set(names) <= set(solution.states):
            continue
        for k, name in enumerate(names):
            columns[name] = estimate[:, k]
            if solution.std is not None:
                columns[f"sigma_{name}"] = solution.std[:, solution.states.index(name)]
            if errors is not None:
                columns[f"true_{name}"] = np.interp(solution.t, errors.t, getattr(errors, kind)[:, k])
    return pd.DataFrame({"time_s": solution.t} | columns) if columns else pd.DataFrame()


def _innovations_frame(told: Mapping[str, Innovations]) -> pd.DataFrame:
    """One aiding after the other, each thinned; the channels of the largest one make the columns."""
    import pandas as pd

    parts = []
    for aiding, nu in told.items():
        spread = np.sqrt(np.einsum("kii->ki", nu.covariance))
        rejected = np.zeros(len(nu.t), dtype=bool) if nu.rejected is None else nu.rejected
        columns: dict[str, Any] = {"aiding": aiding, "time_s": nu.t, "rejected": rejected}
        columns |= {f"nu_{i}": nu.value[:, i] for i in range(nu.value.shape[1])}
        columns |= {f"s_{i}": spread[:, i] for i in range(spread.shape[1])}
        parts.append(_thin(pd.DataFrame(columns)))
    return pd.concat(parts, ignore_index=True)


def _extras_frame(solution: NavSolution) -> pd.DataFrame:
    import pandas as pd

    parts = []
    for name, (t, values) in solution.extras.items():
        values = np.asarray(values, dtype=float).reshape(len(t), -1)
        step = max(1, -(-len(t) // MAX_ROWS))
        for component in range(values.shape[1]):
            data = {"name": name, "component": component, "time_s": t[::step], "value": values[::step, component]}
            parts.append(pd.DataFrame(data))
    return pd.concat(parts, ignore_index=True)


def _thin(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.iloc[:: max(1, -(-len(frame) // MAX_ROWS))].reset_index(drop=True)


def _parquet(frame: pd.DataFrame) -> bytes:
    buffer = io.BytesIO()
    frame.to_parquet(buffer, index=False)
    return buffer.getvalue()
