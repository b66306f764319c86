"""Export to NaveGo-style .mat files, so that MATLAB users can run their own filter on the bench's flights.

Structs and units as in `testbed.formats.navego`, which reads these files back bit for bit: fields that NaveGo does not
know (``q_nb``, ``f_b``, ``w_ib_b``, ``ini_state``, ``ini_std``, ``testbed_spec``) carry what its own cannot hold.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data import specs
from testbed.data.records import Array, GnssFixes, ImuSamples, InitialState, SensorLog, Trajectory
from testbed.data.specs import TriadSpec
from testbed.physics import earth
from testbed.physics.rotations import quat_to_euler, quats_to_eulers, quats_to_matrices

SMALLEST_STD = 1e-3
"""m and m/s: NaveGo cannot work with a GNSS that states no error at all."""


def save_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a ``ref`` struct; ``DCMnb_m`` holds the nav-to-body matrix column by column, as NaveGo has it."""
    euler = quats_to_eulers(trajectory.q_nb)
    angles = {name: _column(euler[:, i]) for i, name in enumerate(("roll", "pitch", "yaw"))}
    ref = {
        **{
            "t": _column(trajectory.t),
            "lat": _column(trajectory.lat),
            "lon": _column(trajectory.lon),
            "h": _column(trajectory.h),
        },
        **{"vel": trajectory.v_n, **angles, "DCMnb_m": quats_to_matrices(trajectory.q_nb).reshape(-1, 9)},
        **{"freq": 1.0 / trajectory.dt, "q_nb": trajectory.q_nb, "f_b": trajectory.f_b, "w_ib_b": trajectory.w_ib_b},
    }
    _save(path, "ref", ref)


def save_log(log: SensorLog, folder: str | Path, reference: Trajectory | None = None) -> None:
    """Write ``imu.mat`` and, where there is such data, ``gnss.mat``, ``mag.mat``, ``baro.mat`` and ``ref.mat``.

    The first row of ``imu`` is at the initial time and repeats the first sample, as in NaveGo, whose mechanization
    starts from the second.
    """
    if lost := sorted(set(log.aiding) - {"gnss", "mag", "baro"}):
        raise InputError(
            f"format 'navego' has no place for {', '.join(lost)}; 'csv' and 'parquet' have, or leave the sensor out"
        )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _save(folder / "imu.mat", "imu", _imu(log.imu, log.initial))
    if log.gnss is not None:
        _save(folder / "gnss.mat", "gnss", _gnss(log.gnss, log.imu.spec.rate_hz))
    if log.mag is not None:
        mag = {"t": _column(log.mag.t), "mb": log.mag.field, "testbed_spec": _spec(log.mag.spec)}
        _save(folder / "mag.mat", "mag", mag)
    if log.baro is not None:
        baro = {"t": _column(log.baro.t), "p": _column(log.baro.pressure), "testbed_spec": _spec(log.baro.spec)}
        _save(folder / "baro.mat", "baro", baro)
    if reference is not None:
        save_trajectory(reference, folder / "ref.mat")


def _imu(imu: ImuSamples, initial: InitialState) -> dict[str, Any]:
    rate = imu.spec.rate_hz
    state = [
        initial.t,
        initial.lat,
        initial.lon,
        initial.h,
        *initial.v_n,
        *initial.q_nb,
        *initial.accel_bias,
        *initial.gyro_bias,
    ]
    return {
        "t": _column(np.concatenate([[initial.t], imu.t])),
        "fb": np.vstack([imu.accel[:1], imu.accel]),
        "wb": np.vstack([imu.gyro[:1], imu.gyro]),
        **_profile(imu.spec.gyro, "g", "arw", "arrw", rate),
        **_profile(imu.spec.accel, "a", "vrw", "vrrw", rate),
        "freq": rate,
        "ini_align": np.array([quat_to_euler(initial.q_nb)]),
        "ini_align_err": initial.std[None, 6:9],
        "ini_state": np.array([state], dtype=np.float64),
        "ini_std": initial.std[None, :],
        "testbed_spec": _spec(imu.spec),
    }


def _profile(spec: TriadSpec, letter: str, white: str, walk: str, rate: float) -> dict[str, Array]:
    """NaveGo's error profile: ``dyn`` is the sigma of the Gauss-Markov bias, ``psd`` its density, ``std`` the sample noise."""
    sigma, time = spec.gauss_markov_sigma(), spec.correlation_time_s
    values = {
        white: spec.white_noise,
        walk: spec.rate_random_walk,
        f"{letter}b_sta": spec.turn_on_bias,
        f"{letter}b_dyn": sigma,
        f"{letter}b_corr": time,
        f"{letter}b_psd": sigma * np.sqrt(time),
        f"{letter}_std": spec.white_noise * np.sqrt(rate),
    }
    return {key: np.full((1, 3), value) for key, value in values.items()}


def _gnss(gnss: GnssFixes, imu_rate: float) -> dict[str, Any]:
    every = np.maximum(gnss.measurement_std(), SMALLEST_STD) if len(gnss.t) else np.full((1, 6), SMALLEST_STD)
    std = np.sqrt(np.mean(every**2, axis=0)) if np.ptp(every, axis=0).any() else every[0]
    per_lat, per_lon = earth.metres_per_radian(gnss.lat[0], gnss.h[0]) if len(gnss.t) else (earth.A, earth.A)
    out: dict[str, Any] = {
        **{
            "t": _column(gnss.t),
            "lat": _column(gnss.lat),
            "lon": _column(gnss.lon),
            "h": _column(gnss.h),
            "vel": gnss.v_n,
        },
        **{
            "std": np.array([[std[0] / per_lat, std[1] / per_lon, std[2]]]),
            "stdm": std[None, :3],
            "stdv": std[None, 3:],
        },
        **{"larm": np.array(gnss.spec.lever_arm_b)[:, None], "freq": gnss.spec.rate_hz, "eps": 1.0 / (3.0 * imu_rate)},
        **{"zupt_th": 0.0, "zupt_win": 4.0, "testbed_spec": _spec(gnss.spec)},
    }
    if gnss.std is not None:
        out["std_fix"] = gnss.std
    if gnss.outages:
        out["outages"] = np.array(gnss.outages, dtype=np.float64)
    return out


def _column(values: Array) -> Array:
    return np.asarray(values, dtype=np.float64).reshape(-1, 1)


def _spec(spec: Any) -> str:
    return json.dumps(specs.to_dict(spec))


def _save(path: str | Path, name: str, struct: dict[str, Any]) -> None:
    from scipy.io import savemat

    savemat(path, {name: struct}, format="5", do_compression=True, oned_as="column")
