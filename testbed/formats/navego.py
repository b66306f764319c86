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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError, nearest
from testbed.base.files import from_json
from testbed.data import specs
from testbed.data.records import (
    Array,
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    Trajectory,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.first_motion import EARTH_RATE, rest_at_start
from testbed.formats.raw import Raw
from testbed.formats.recording import (
    check_finite,
    check_folder,
    check_place,
    check_time,
    existing,
    read_mat,
)
from testbed.physics.rotations import eulers_to_quats

LEAST_REST_S = 2.0
ALIKE = 0.1
"""Of the size: a bias that is drawn within ±``gb_sta`` lies so near to it on all three axes once in 8000 units (0.05³)."""
STRUCTS = ("imu", "gnss", "ref", "mag", "baro")
_MARKOV_PEAK = TriadSpec(bias_instability=1.0).gauss_markov_sigma()


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The structs of a folder: NAME.mat, else NAME1.mat, where ``files`` names none; imu is required.

    Raises InputError that names file, variable and sample.
    """
    paths = _find(folder / config.dir, config.files)
    imu = Struct(paths["imu"], "imu")
    names = {"reference" if kind == "ref" else kind: str(path) for kind, path in paths.items()}
    raw = Raw(name=(folder / config.dir).name, places=names, stated=set(paths))
    raw.imu, raw.t_start = _imu(imu, config.sampling), float(imu.time()[0])
    raw.gnss = _gnss(Struct(paths["gnss"], "gnss")) if "gnss" in paths else None
    raw.mag = _mag(Struct(paths["mag"], "mag")) if "mag" in paths else None
    raw.baro = _baro(Struct(paths["baro"], "baro")) if "baro" in paths else None
    if "ref" in paths:
        _add_reference(raw, Struct(paths["ref"], "ref"))
    raw.initial = _stored_initial(imu)
    if raw.initial is None:
        roll_pitch_yaw = check_finite(imu.vector("ini_align"), imu.place("ini_align"))
        raw.attitude = roll_pitch_yaw, check_finite(imu.vector("ini_align_err"), imu.place("ini_align_err"))
        raw.gyro_bias = None if "gyro_bias_dps" in config.imu else _static_bias(imu, raw)
    return raw


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
    check_folder(folder)
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
        turn_on_bias=_rms(struct, np.abs(struct.vector(f"{letter}b_sta", zero)), f"{letter}b_sta"),
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


def _add_reference(raw: Raw, struct: Struct) -> None:
    t, lat, lon, h = struct.time(), struct.series("lat"), struct.series("lon"), struct.series("h")
    v_n = struct.series("vel", 3)
    check_place(lat, lon, str(struct.path))
    if struct.has("q_nb"):
        q_nb = struct.series("q_nb", 4)
    else:
        q_nb = eulers_to_quats(np.column_stack([struct.series(k) for k in ("roll", "pitch", "yaw")]))
    raw.motion = (t, lat, lon, h, v_n, q_nb)
    if struct.has("f_b") and struct.has("w_ib_b"):
        raw.reference = Trajectory(
            t, lat, lon, h, v_n, q_nb, struct.series("f_b", 3), struct.series("w_ib_b", 3), name="reference"
        )


def _static_bias(struct: Struct, raw: Raw) -> Array | None:
    """``gb_sta`` (3,) where it is a signed bias, and the accelerometers less an ``ab_sta`` that is one.

    NaveGo's ins_gnss.m subtracts both from the samples. Its noise_sbias.m and profiles made from data sheets hold the size
    of a turn-on bias there, all positive, within which one is drawn; that is a sigma. A negative value among them, or the
    mean of a rest at the start that agrees with them, says that they are biases; where nothing does, that is told.
    """
    gyro, accel = (
        check_finite(struct.vector(name, (0.0, 0.0, 0.0)), struct.place(name)) for name in ("gb_sta", "ab_sta")
    )
    assert raw.imu is not None
    if (gyro < 0.0).any() or (accel < 0.0).any():
        raw.notes.append(
            f"{struct.place('gb_sta')} or ab_sta has negative values: they are read as the biases of the gyros,"
            f" {gyro.tolist()} rad/s, and of the accelerometers, {accel.tolist()} m/s², which are taken off"
        )
        raw.imu = replace(raw.imu, accel=raw.imu.accel - accel)
        return gyro
    if not gyro.any():
        return None
    rest = rest_at_start(raw.imu, raw.gnss, raw.t_start, LEAST_REST_S)
    if rest is not None:
        if (np.abs(rest.gyro - gyro) > np.maximum(ALIKE * gyro, EARTH_RATE)).any():
            return None
        raw.notes.append(
            f"{struct.place('gb_sta')} is what the gyros show at rest: it is read as their bias, {gyro.tolist()} rad/s"
        )
        return gyro
    raw.notes.append(
        f"{struct.place('gb_sta')} has positive values alone: they are read as the size (1 sigma) of an unknown bias; if they"
        " are a bias, which NaveGo subtracts, [recording.imu] gyro_bias_dps and accel_bias_mg take it off"
    )
    return None


def _text(struct: Struct, field: str) -> str:
    values = struct.fields.get(field)
    return str(values.flat[0]) if values is not None and values.dtype.kind == "U" and values.size else ""


def _stored_spec(struct: Struct, kind: type) -> Any:

    text = _text(struct, "testbed_spec")
    try:
        return specs.from_dict(kind, from_json(text)) if text else None
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
