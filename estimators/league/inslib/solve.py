"""INSLIB's 15-state loosely coupled filter on logs, in a process of its own: ``python solve.py LOGS OUT``.

LOGS holds a folder for each run, OUT gets a table of each answer (see ``docs/howto/external.md``). Nothing but this file runs with
INSLIB, whose licence is the AGPL: it reads tables, calls the library's Python binding, and writes tables. INSLIB works in
north-east-down and forward-right-down, radians and metres, as the tables do.

What it is told follows from ``log.json`` and ``initial.csv`` alone: white noise as spectral densities (the larger of the data
sheet's random walk and what rounding to one bit makes), biases as random walks with the driving density of the
Gauss-Markov process whose Allan deviation peaks at the data sheet's bias instability, and the accuracy that the receiver
states, without the library's own limits on it and additions to it. Its standstill detector sees the IMU alone where there is no recent
fix, and takes smooth cruise for a standstill: it is off in a log that begins in motion. Its outlier test and all else stay as shipped.
"""

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
from INSLIB import Config, Ins

NEGLIGIBLE = 1e-9
"""Of process noise beside the IMU's and of what is added to a stated accuracy, SI: the library reads 0 as its own default."""
LEAST_STD = np.repeat([1e-3, 1e-4, 1e-6, 1e-6, 1e-9], 3)
LEAST_FIX_STD = np.repeat([1e-3, 1e-4], 3)
"""1 sigma of a start and of a fix that are exact: a filter needs a little."""
IN_MOTION = 3.0
"""Speed of a start over its sigma from which on the log begins in motion: by noise alone one parked start in 34 looks so, and then
goes without the detector."""
ANY_ACCURACY = 1e4
"""1 sigma of a fix, m or m/s, up to which it is used: further than any that a receiver gives."""
COLUMNS = (
    "time_s lat_deg lon_deg alt_m v_north_mps v_east_mps v_down_mps q_nb_0 q_nb_1 q_nb_2 q_nb_3 std_position_north_m "
    "std_position_east_m std_position_down_m std_velocity_north_mps std_velocity_east_mps std_velocity_down_mps "
    "std_attitude_north_rad std_attitude_east_rad std_attitude_down_rad"
).split()
SIGMAS_EVERY = 10
"""IMU samples between two readings of the covariance: the library's own covariance steps are 0.05 s apart."""


def table(path):
    """Columns of a CSV file by name."""
    with path.open(newline="") as file:
        names = next(csv.reader(file))
    rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    return dict(zip(names, rows.T, strict=True))


def columns(found, pattern, axes):
    """(N,k) of the columns whose names differ in an axis."""
    return np.column_stack([found[pattern.format(axis)] for axis in axes])


def densities(triad, dt):
    """White noise and driving noise of the bias of a triad, spectral densities."""
    white = max(triad["white_noise"] ** 2, triad["resolution"] ** 2 / 12.0 * dt)
    sigma = triad["bias_instability"] / 0.61736  # IEEE Std 952-1997, eq. C.16, at its peak
    return white, 2.0 * sigma**2 / triad["correlation_time_s"] + triad["rate_random_walk"] ** 2


def fixes(run, spec):
    """Times, places (rad, rad, m), velocities and variances (north, east, down) of the fixes."""
    gnss = table(run / "gnss.csv")
    place = np.column_stack([np.radians(gnss["lat_deg"]), np.radians(gnss["lon_deg"]), gnss["alt_m"]])
    velocity = columns(gnss, "v_{}_mps", ("north", "east", "down"))
    horizontal = math.hypot(spec["horizontal_sigma"], spec["horizontal_markov_sigma"])
    vertical = math.hypot(spec["vertical_sigma"], spec["vertical_markov_sigma"])
    std = np.tile([horizontal, horizontal, vertical, *3 * [spec["velocity_sigma"]]], (len(place), 1))
    stated = [f"std_{axis}_m" for axis in ("north", "east", "down")]
    stated += [f"std_v_{axis}_mps" for axis in ("north", "east", "down")]
    for k, name in enumerate(stated):
        if name in gnss:
            std[:, k] = gnss[name]
    return gnss["time_s"] - spec["latency_s"], place, velocity, np.maximum(std, LEAST_FIX_STD) ** 2


def configuration(start, std, imu, dt):
    """The filter at the start of a log; and the densities of accelerometers and gyros."""
    accel, accel_drive = densities(imu["accel"], dt)
    gyro, gyro_drive = densities(imu["gyro"], dt)
    gates = {
        f"gnss_{kind}_{axis}_{what}": ANY_ACCURACY
        for kind in ("max", "start_max", "stop_max")
        for axis in ("horizontal", "vertical")
        for what in ("pos_stddev_m", "vel_stddev_mps")
    }
    velocity = columns(start, "v_{}_mps", ("north", "east", "down"))[0]
    config = Config(
        auto_zupt_disable=bool(np.linalg.norm(velocity) > IN_MOTION * std[3:6].max()),
        auto_init=False,
        allow_unlimited_deadreckoning=True,
        gnss_init_dwell_disable=True,
        gnss_stop_disable=True,
        gnss_min_delay_ms=-1,
        gnss_acc_envelope_tau_sec=-1.0,
        time_us=microseconds(start["time_s"][0]),
        lat_rad=start["lat_rad"][0],
        lon_rad=start["lon_rad"][0],
        h_m=start["alt_m"][0],
        init_vel_ned=tuple(velocity),
        rpy_init_rad=tuple(np.radians(columns(start, "{}_deg", ("roll", "pitch", "yaw"))[0])),
        pos_init_stddev_m=std[:3].max(),
        vel_init_stddev_mps=std[3:6].max(),
        rpy_init_stddev_rad=tuple(std[6:9]),
        acc_bias_init_stddev_mps2=std[9:12].max(),
        gyr_bias_init_stddev_rps=std[12:].max(),
        pos_pred_stddev_m_sqrts=NEGLIGIBLE,
        vel_pred_stddev_mps_sqrts=NEGLIGIBLE,
        rpy_pred_stddev_rad_sqrts=NEGLIGIBLE,
        acc_bias_pred_stddev_mps2_sqrts=math.sqrt(accel_drive) or NEGLIGIBLE,
        gyr_bias_pred_stddev_rps_sqrts=math.sqrt(gyro_drive) or NEGLIGIBLE,
        **{f"gnss_{what}_stddev_cap_{axis}": -1.0 for what, axis in LIMITS},
        **{f"gnss_{what}_stddev_floor_{axis}": NEGLIGIBLE for what, axis in LIMITS},
        gnss_vel_noise_acc_scale_hor=NEGLIGIBLE,
        gnss_vel_noise_acc_scale_ver=NEGLIGIBLE,
        **gates,
    )
    return config, (accel,) * 3, (gyro,) * 3


LIMITS = (("pos", "hor_m"), ("pos", "ver_m"), ("vel", "hor_mps"), ("vel", "ver_mps"))
"""Of the library on a stated accuracy, from above and below, all switched off; so is what it adds in manoeuvres."""


def microseconds(t):
    return round(1e6 * t)


def filtered(run):
    """The answer to one log, (N,20) in the order of `COLUMNS`."""
    imu, start = table(run / "imu.csv"), table(run / "initial.csv")
    meta = json.loads((run / "log.json").read_text())
    t, begin = imu["time_s"], start["time_s"][0]
    gyro = columns(imu, "gyro_{}_radps", "xyz") - columns(start, "gyro_bias_{}_radps", "xyz")
    accel = columns(imu, "accel_{}_mps2", "xyz") - columns(start, "accel_bias_{}_mps2", "xyz")
    names = [name for name in start if name.startswith("std_")]
    std = np.maximum([start[name][0] for name in names], LEAST_STD)
    dt = np.diff(t, prepend=begin)
    config, accel_density, gyro_density = configuration(start, std, meta["imu"], float(dt.mean()))
    fix_t, place, velocity, variance = fixes(run, meta["gnss"])
    ins = Ins(config)
    # the library takes the start for the time of its first epoch, so the log's first mean is shown for an instant before
    ins.imu(microseconds(begin), dt[0], accel[0].tolist(), gyro[0].tolist(), accel_density, gyro_density)
    ins.update()
    due = np.searchsorted(t, fix_t - 1e-7)
    fix = int(np.searchsorted(fix_t, begin - 1e-7))
    answer = np.empty((len(t), len(COLUMNS)))
    sigmas = std[:9]
    for k in range(len(t)):
        ins.imu(microseconds(t[k]), dt[k], accel[k].tolist(), gyro[k].tolist(), accel_density, gyro_density)
        fixed = fix < len(due) and due[fix] <= k
        if fixed:
            ins.gnss_leverarm(meta["gnss"]["lever_arm_b"])
            age = microseconds(t[k] - fix_t[fix])
            ins.gnss_pos_llh(place[fix].tolist(), variance[fix, :3].tolist(), delay_us=age)
            ins.gnss_vel(velocity[fix].tolist(), variance[fix, 3:].tolist())
            fix += 1
        ins.update()
        if fixed or k % SIGMAS_EVERY == 0:
            sigmas = np.sqrt(np.diag(ins.covariance()))[:9]
        lat, lon, h = ins.position_llh()
        answer[k] = t[k], math.degrees(lat), math.degrees(lon), h, *ins.velocity_ned(), *ins.quaternion(), *sigmas
    q = answer[:, 7:11]
    q /= np.linalg.norm(q, axis=1, keepdims=True)  # single precision
    return answer


def main(logs, out):
    for run in sorted(path for path in Path(logs).iterdir() if path.is_dir() and path.name.isdigit()):
        header = ",".join(COLUMNS)
        np.savetxt(Path(out) / f"{run.name}.csv", filtered(run), "%.12g", delimiter=",", header=header, comments="")


if __name__ == "__main__":
    main(*sys.argv[1:])
