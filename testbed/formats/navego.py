"""NaveGo-style MATLAB files: structs ``imu``, ``gnss`` and ``ref`` in version 5 .mat files, in and out.

Layout: the open-source toolbox NaveGo (rodralez/NaveGo) for MATLAB and GNU Octave. SI units, radians, NED, body
forward-right-down. Structs ``mag`` (t, mb in µT) and ``baro`` (t, p in Pa) and fields beyond NaveGo's are this
project's additions, which NaveGo ignores.

Sample k of ``fb``, ``wb`` is taken as the mean over (t[k-1], t[k]], as NaveGo's own mechanization does, and row 0, which
no interval precedes, only gives the initial time. The shipped synthetic example bears this out: the offset of its
specific force against the increments of its reference is 0.1 ± 0.2 ms, where an instantaneous sample would show 2.5 ms.
``sampling="instant"`` converts true point samples to interval means by the trapezoid rule.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError, nearest
from testbed.data import specs
from testbed.data.records import (
    Array,
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    SensorLog,
    Trajectory,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec
from testbed.formats.alignment import REFERENCE_STD, Aligned, cut_before, from_first_fix, reference_at
from testbed.formats.recording import (
    Recording,
    check_finite,
    check_place,
    check_time,
    existing,
    read_mat,
    reference_on_grid,
)
from testbed.physics.rotations import euler_error_matrix, euler_to_quat, eulers_to_quats

STRUCTS = ("imu", "gnss", "ref", "mag", "baro")
_MARKOV_PEAK = TriadSpec(bias_instability=1.0).gauss_markov_sigma()


def load(
    folder: str | Path, files: Mapping[str, str] | None = None, sampling: str = "interval", start: str = "auto"
) -> Recording:
    """Import a folder of NaveGo structs.

    ``files`` maps imu, gnss, ref, mag, baro to file names in ``folder`` (default: NAME.mat, else NAME1.mat, where
    present; imu is required). ``start``: position and velocity at the start come from the first fix ("gnss"; that fix
    is then not offered to the filter a second time) or from the reference ("reference"), both with the GNSS's standard
    deviations. Raises InputError that names file, variable and sample.
    """
    if sampling not in ("interval", "instant"):
        raise InputError(f"navego: sampling '{sampling}' is unknown; {nearest(sampling, ('interval', 'instant'))}")
    paths = _find(Path(folder), files or {})
    imu_struct = Struct(paths["imu"], "imu")
    imu = _imu(imu_struct, sampling)
    gnss = _gnss(Struct(paths["gnss"], "gnss")) if "gnss" in paths else None
    mag = _mag(Struct(paths["mag"], "mag")) if "mag" in paths else None
    baro = _baro(Struct(paths["baro"], "baro")) if "baro" in paths else None
    t_start = imu_struct.time()[0]
    grid = np.concatenate([[t_start], imu.t])
    reference = _reference(Struct(paths["ref"], "ref"), grid) if "ref" in paths else None
    initial = _stored_initial(imu_struct)
    if initial is None:
        aligned = _initial(imu_struct, imu, gnss, reference, start)
        imu, gnss, initial = aligned.imu, aligned.gnss, aligned.initial
    return Recording(SensorLog(imu, initial, gnss, mag, baro, Path(folder).name), reference)


def states_initial(folder: str | Path, files: Mapping[str, str] | None = None) -> bool:
    """Whether the files hold the whole initial state, as those that the bench wrote do."""
    return _stored_initial(Struct(_find(Path(folder), files or {})["imu"], "imu")) is not None


class Struct:
    """One struct of a .mat file: numeric fields with checks that name file, variable and sample."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path
        self.name, self.fields = _read_struct(path, kind)

    def place(self, field: str) -> str:
        return f"{self.path}: {self.name}.{field}"

    def has(self, field: str) -> bool:
        return field in self.fields and self.fields[field].size > 0

    def numbers(self, field: str) -> Array:
        """The field as it stands, float64."""
        if field not in self.fields:
            raise InputError(f"{self.path}: {self.name} has no field '{field}'; {nearest(field, self.fields)}")
        values = self.fields[field]
        if values.dtype.kind not in "fiub":
            raise InputError(f"{self.place(field)} is not numeric")
        return values.astype(np.float64)

    def time(self) -> Array:
        values = self.numbers("t").ravel()
        if len(values) < 2:
            raise InputError(f"{self.place('t')} has {len(values)} samples, at least 2 are needed")
        return check_time(values, self.place("t"))

    def series(self, field: str, width: int = 1) -> Array:
        """(N,) or (N,width), one row per sample of t, all finite."""
        values, n = self.numbers(field), self.numbers("t").size
        if values.shape != (n, width) and not (width == 1 and values.size == n):
            raise InputError(f"{self.place(field)} has shape {values.shape}, expected {(n, width)}")
        return check_finite(values.ravel() if width == 1 else values, self.place(field))

    def vector(self, field: str, default: tuple[float, ...] | None = None) -> Array:
        """(3,); a scalar counts for all axes; ``default`` where the field is absent."""
        if default is not None and not self.has(field):
            return np.array(default)
        values = self.numbers(field).ravel()
        if values.size not in (1, 3):
            raise InputError(f"{self.place(field)} has {values.size} values, expected 3 (or 1 for all axes)")
        return np.broadcast_to(values, 3).copy()


def _find(folder: Path, files: Mapping[str, str]) -> dict[str, Path]:
    for key in files:
        if key not in STRUCTS:
            raise InputError(f"files: unknown part '{key}' of a navego recording; {nearest(key, STRUCTS)}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; the key recording.dir says where the recording lies")
    found: dict[str, Path] = {}
    for kind in STRUCTS:
        if kind in files:
            found[kind] = existing(folder / files[kind], kind)
            continue
        options = [p for p in (folder / f"{kind}.mat", folder / f"{kind}1.mat") if p.is_file()]
        if options:
            found[kind] = options[0]
    if "imu" not in found:
        existing(folder / "imu.mat", "imu")
    return found


def _read_struct(path: Path, kind: str) -> tuple[str, dict[str, Array]]:
    content = read_mat(path)
    found = {k: v for k, v in content.items() if getattr(v, "dtype", np.dtype("f8")).names}
    name = next((k for k in (kind, f"{kind}1") if k in found), None) or (next(iter(found)) if len(found) == 1 else None)
    if name is None:
        others = list(content)
        raise InputError(f"{path}: holds no struct '{kind}' (variables: {', '.join(others) or 'none'})")
    struct = found[name]
    if struct.size != 1:
        raise InputError(f"{path}: {name} is an array of {struct.size} structs, expected one")
    return name, {field: np.asarray(struct.flat[0][field]) for field in struct.dtype.names}


def _imu(struct: Struct, sampling: str) -> ImuSamples:
    t, accel, gyro = struct.time(), struct.series("fb", 3), struct.series("wb", 3)
    if sampling == "instant":
        accel, gyro = 0.5 * (accel[1:] + accel[:-1]), 0.5 * (gyro[1:] + gyro[:-1])
    else:
        accel, gyro = accel[1:], gyro[1:]
    rate = float(np.round(1.0 / np.median(np.diff(t)), 6))
    stored = _stored_spec(struct, ImuSpec)
    spec = stored or ImuSpec(
        _text(struct, "name") or f"navego {struct.name}", rate, _triad(struct, "g"), _triad(struct, "a")
    )
    return ImuSamples(t[1:], gyro, accel, spec)


def _triad(struct: Struct, letter: str) -> TriadSpec:
    """Error profile of one triad: root mean square over the axes; NaveGo's dynamic bias is a Gauss-Markov sigma."""
    white, walk = ("arw", "arrw") if letter == "g" else ("vrw", "vrrw")
    zero = (0.0, 0.0, 0.0)
    times = struct.vector(f"{letter}b_corr", (np.inf,) * 3)
    usable = np.isfinite(times) & (times > 0.0)
    dynamic = _rms(struct, struct.vector(f"{letter}b_dyn", zero), f"{letter}b_dyn") if usable.any() else 0.0
    return TriadSpec(
        turn_on_bias=_rms(struct, struct.vector(f"{letter}b_sta", zero), f"{letter}b_sta"),
        bias_instability=dynamic / _MARKOV_PEAK,
        correlation_time_s=float(times[usable].mean()) if usable.any() else TriadSpec.correlation_time_s,
        white_noise=_rms(struct, struct.vector(white), white),
        rate_random_walk=_rms(struct, struct.vector(walk, zero), walk),
    )


def _rms(struct: Struct, values: Array, field: str) -> float:
    if not np.isfinite(values).all() or (values < 0.0).any():
        raise InputError(f"{struct.place(field)} is {values.tolist()}, expected finite values of at least 0")
    return float(values[0]) if np.ptp(values) == 0.0 else float(np.sqrt(np.mean(values**2)))


def _gnss(struct: Struct) -> GnssFixes:
    t, lat, lon, h = struct.time(), struct.series("lat"), struct.series("lon"), struct.series("h")
    check_place(lat, lon, str(struct.path))
    v_n = struct.series("vel", 3)
    metres, speed = struct.vector("stdm"), struct.vector("stdv")
    for field, values in (("stdm", metres), ("stdv", speed)):
        if not struct.has("testbed_spec") and (not np.isfinite(values).all() or (values <= 0.0).any()):
            raise InputError(f"{struct.place(field)} is {values.tolist()}, expected finite values above 0")
    spec = _stored_spec(struct, GnssSpec) or GnssSpec(
        name=_text(struct, "name") or "navego gnss",
        rate_hz=float(np.round(1.0 / np.median(np.diff(t)), 6)),
        horizontal_sigma=_rms(struct, metres[:2], "stdm"),
        vertical_sigma=float(metres[2]),
        velocity_sigma=_rms(struct, speed, "stdv"),
        lever_arm_b=tuple(struct.vector("larm", (0.0, 0.0, 0.0)).tolist()),
    )
    even = metres[0] == metres[1] and np.ptp(speed) == 0.0
    std = None if even else np.tile(np.concatenate([metres, speed]), (len(t), 1))
    if struct.has("std_fix"):
        std = struct.series("std_fix", 6)
    outages = tuple((float(a), float(b)) for a, b in struct.numbers("outages")) if struct.has("outages") else ()
    return GnssFixes(t, lat, lon, h, v_n, spec, outages, std)


def _mag(struct: Struct) -> MagSamples:
    return MagSamples(struct.time(), struct.series("mb", 3), _stored_spec(struct, MagSpec) or MagSpec("navego mag"))


def _baro(struct: Struct) -> BaroSamples:
    return BaroSamples(struct.time(), struct.series("p"), _stored_spec(struct, BaroSpec) or BaroSpec("navego baro"))


def _reference(struct: Struct, grid: Array) -> Trajectory:
    t, lat, lon, h, v_n = (
        struct.time(),
        struct.series("lat"),
        struct.series("lon"),
        struct.series("h"),
        struct.series("vel", 3),
    )
    check_place(lat, lon, str(struct.path))
    if struct.has("q_nb"):
        q_nb = struct.series("q_nb", 4)
    else:
        q_nb = eulers_to_quats(np.column_stack([struct.series(k) for k in ("roll", "pitch", "yaw")]))
    if struct.has("f_b") and struct.has("w_ib_b"):
        return Trajectory(
            t, lat, lon, h, v_n, q_nb, struct.series("f_b", 3), struct.series("w_ib_b", 3), name="reference"
        )
    return reference_on_grid(grid, (t, lat, lon, h, v_n, q_nb), str(struct.path))


def _initial(
    struct: Struct, imu: ImuSamples, gnss: GnssFixes | None, reference: Trajectory | None, start: str
) -> Aligned:
    """Attitude from ini_align with ini_align_err; place from the first fix or the reference; biases zero, turn-on sigma."""
    if start not in ("auto", "gnss", "reference"):
        raise InputError(f"navego: start '{start}' is unknown; {nearest(start, ('auto', 'gnss', 'reference'))}")
    if start == "auto":
        start = "reference" if gnss is None and reference is not None else "gnss"
    t, spec = float(struct.time()[0]), imu.spec
    roll, pitch, yaw = check_finite(struct.vector("ini_align"), struct.place("ini_align"))
    euler_std = check_finite(struct.vector("ini_align_err"), struct.place("ini_align_err"))
    q_nb = np.array(euler_to_quat(roll, pitch, yaw))
    bias_std = np.repeat([spec.accel.turn_on_bias, spec.gyro.turn_on_bias], 3)
    if start == "gnss" and gnss is not None and len(gnss.t):
        imu, t = cut_before(imu, t, float(gnss.t[0]), str(struct.path.parent))
        lat, lon, h, v_n, motion_std, gnss = from_first_fix(gnss, t, q_nb)
    elif start == "reference" and reference is not None:
        imu, t = cut_before(imu, t, float(reference.t[0]), str(struct.path.parent))
        lat, lon, h, v_n, _ = reference_at(reference, t)
        motion_std = gnss.measurement_std()[0] if gnss is not None and len(gnss.t) else REFERENCE_STD[:6]
    else:
        raise InputError(
            f'{struct.path.parent}: start = "{start}" needs a file {"gnss" if start == "gnss" else "ref"}.mat'
        )
    attitude_std = np.sqrt(np.array(euler_error_matrix(roll, pitch, yaw)) ** 2 @ euler_std**2)
    std = np.concatenate([motion_std, attitude_std, bias_std])
    return Aligned(imu, gnss, InitialState(t, lat, lon, h, v_n, q_nb, np.zeros(3), np.zeros(3), std))


def _text(struct: Struct, field: str) -> str:
    values = struct.fields.get(field)
    return str(values.flat[0]) if values is not None and values.dtype.kind == "U" and values.size else ""


def _stored_spec(struct: Struct, kind: type) -> Any:
    import json

    text = _text(struct, "testbed_spec")
    try:
        return specs.from_dict(kind, json.loads(text)) if text else None
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{struct.place('testbed_spec')} cannot be read ({error})") from None


def _stored_initial(struct: Struct) -> InitialState | None:
    """The initial state that `save_log` wrote, where the file has one."""
    if not struct.has("ini_std"):
        return None
    x = check_finite(struct.numbers("ini_state").ravel(), struct.place("ini_state"))
    std = check_finite(struct.numbers("ini_std").ravel(), struct.place("ini_std"))
    if len(x) != 17 or len(std) != 15:
        raise InputError(
            f"{struct.place('ini_state')} and ini_std have {len(x)} and {len(std)} values, expected 17 and 15"
        )
    t, lat, lon, h = (float(v) for v in x[:4])
    return InitialState(t, lat, lon, h, x[4:7], x[7:11], x[11:14], x[14:17], std)
