"""The catalogue of sensors: data-sheet figures with the unit in the key, turned into the SI specifications.

Figures and their sources stand in ``catalog.toml`` (or a user's file of the same form). Keys end in their unit, where
``p`` reads "per": ``gyro_arw_dpsqrth`` is °/√h. Results are `testbed.data.specs` in SI units and radians.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError, nearest, shown
from testbed.base.schema import read_toml
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec

SHIPPED = Path(__file__).with_name("catalog.toml")
SPECS: dict[str, type] = {"imu": ImuSpec, "gnss": GnssSpec, "mag": MagSpec, "baro": BaroSpec}
_FIGURES: dict[str, Mapping[str, tuple[str, float]]] = {}
_ENTRIES: dict[str, Mapping[str, Mapping[str, Any]]] = {}
REMARKS = ("source", "assumed")
"""Keys of an entry that are no figures."""
POSITIVE = (
    "rate_hz",
    "correlation_time_s",
    "markov_time_s",
    "bandwidth_hz",
    "range",
    "correlator_chips",
    "multipath_angle",
    "multipath_time_s",
)
"""Figures that must not be zero."""
HIGHEST_RATE_HZ = 10_000.0
"""Ten times the highest rate of a flight: a sensor that is faster records nothing new."""
_DEG = math.pi / 180.0
SIGNALS = {
    "cn0_zenith_dbhz": ("signals.cn0_zenith", 1.0),
    "pattern_drop_db": ("signals.pattern_drop", 1.0),
    "mask_deg": ("signals.mask", _DEG),
    "dll_bandwidth_hz": ("signals.dll_bandwidth_hz", 1.0),
    "correlator_chips": ("signals.correlator_chips", 1.0),
    "range_rate_sigma_mps": ("signals.rate_sigma", 1.0),
    "multipath_zenith_m": ("signals.multipath_zenith", 1.0),
    "multipath_horizon_m": ("signals.multipath_horizon", 1.0),
    "multipath_angle_deg": ("signals.multipath_angle", _DEG),
    "multipath_time_s": ("signals.multipath_time_s", 1.0),
    "clock_h0_s": ("signals.clock_h0_s", 1.0),
    "clock_hm2_ps": ("signals.clock_hm2_ps", 1.0),
}
"""Keys of a GNSS receiver that count where it is simulated down to the satellites."""
_MGAUSS = 0.1  # µT


def declare(
    kind: str, spec: type, figures: Mapping[str, tuple[str, float]], entries: Mapping[str, Mapping[str, Any]]
) -> None:
    """Make a kind of sensor known, with its keys (none: those written here) and entries beside the shipped ones."""
    SPECS[kind] = spec
    if figures:
        _FIGURES[kind] = figures
    for name, table in entries.items():
        _resolve(kind, table, f"catalogue: [{kind}.{name}]")
    _ENTRIES[kind] = {"ideal": {"source": "no errors at all"}} | dict(entries) if figures else dict(entries)


def shipped(kind: str) -> dict[str, Mapping[str, Any]]:
    """The entries of the shipped catalogue: name to figures."""
    return dict(_ENTRIES.get(kind, {})) | read(SHIPPED).get(kind, {})


def entry(kind: str, model: str, file: Path | None = None) -> dict[str, Any]:
    """The figures of one sensor, from the user's ``file`` if it has the model, else from the shipped catalogue.

    Raises InputError that names the file, the key and the nearest valid name.
    """
    own = read(file) if file is not None else {}
    for entries in (own.get(kind, {}), shipped(kind)):
        if model in entries:
            return dict(entries[model])
    names = set(own.get(kind, {})) | set(shipped(kind))
    raise InputError(f"{file or 'sensor catalogue'}: no {kind} named '{model}'; {nearest(model, names)}")


def specification(kind: str, model: str, overrides: Mapping[str, Any] | None = None, file: Path | None = None) -> Any:
    """The SI specification (a class of `testbed.data.specs`) of a catalogue entry with some figures replaced.

    ``overrides`` uses the catalogue's keys. A figure replaces the entry's whatever unit either is given in.
    """
    values = _resolve(kind, entry(kind, model, file), f"{file or 'catalog.toml'}: [{kind}.{model}]")
    values |= _resolve(kind, overrides or {}, f"[sensors.{kind}]")
    density = values.pop("noise_density", None)
    if density is not None and "noise_sigma" not in values:
        # A data sheet's density is one-sided: white noise sampled at a rate has sigma² = density² rate / 2.
        values["noise_sigma"] = density * math.sqrt(values.get("rate_hz", SPECS[kind]().rate_hz) / 2.0)
    spec = SPECS[kind](name=model)
    for path, value in values.items():
        head, _, tail = path.partition(".")
        spec = replace(spec, **{head: replace(getattr(spec, head), **{tail: value}) if tail else value})
    for triad in (f.name for f in fields(spec) if isinstance(getattr(spec, f.name), TriadSpec)):
        if getattr(spec, triad).nonlinearity and math.isinf(getattr(spec, triad).range):
            raise InputError(
                f"[{kind}.{model}]: {triad}_nonlinearity_pctfs is relative to the range: give {triad}_range_*"
            )
    return spec


@functools.cache
def keys(kind: str) -> dict[str, tuple[str, float]]:
    """Every valid key of a kind of sensor: the field of its specification (dotted path) and the factor to SI."""
    if kind in _FIGURES:
        return {"rate_hz": ("rate_hz", 1.0)} | dict(_FIGURES[kind])
    if kind == "imu":
        return {"rate_hz": ("rate_hz", 1.0)} | _triad_keys("gyro") | _triad_keys("accel")
    plain = {
        "gnss": "rate_hz horizontal_sigma_m vertical_sigma_m horizontal_markov_sigma_m vertical_markov_sigma_m "
        "markov_time_s velocity_sigma_mps latency_s",
        "mag": "rate_hz soft_iron_pct misalignment_deg",
        "baro": "rate_hz drift_papsqrts",
    }[kind].split()
    factors = {"soft_iron_pct": 0.01, "misalignment_deg": _DEG}
    kept = {"rate_hz", "markov_time_s", "latency_s"} & {f.name for f in fields(SPECS[kind])}
    out = {key: (key if key in kept else key.rpartition("_")[0], factors.get(key, 1.0)) for key in plain}
    if kind == "gnss":
        out |= SIGNALS
    if kind == "mag":
        units = {"ut": 1.0, "mgauss": _MGAUSS, "gauss": 1e3 * _MGAUSS, "nt": 1e-3}
        out |= _united(units, noise="noise_sigma", turn_on_bias="turn_on_bias", range="range", resolution="resolution")
        out |= {f"noise_density_{u}psqrthz": ("noise_density", f) for u, f in units.items()}
    if kind == "baro":
        quantities = {q: q for q in ("turn_on_bias", "minimum", "maximum", "resolution")}
        out |= _united({"pa": 1.0, "mbar": 100.0}, noise="noise_sigma", **quantities)
    return out


@functools.cache
def read(file: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """A checked catalogue file: kind to name to entry. Raises InputError that names the file and the key."""
    tables = read_toml(file)
    for kind, entries in tables.items():
        if kind not in SPECS:
            raise InputError(f"{file}: unknown kind of sensor [{kind}]; {nearest(kind, SPECS)}")
        for name, table in entries.items() if isinstance(entries, dict) else [(kind, entries)]:
            if not isinstance(table, dict):
                raise InputError(f"{file}: '{kind}.{name}' must be a table [{kind}.NAME]")
            _resolve(kind, table, f"{file}: [{kind}.{name}]")
            for key in ("source",) if "source" not in table else ():
                raise InputError(f'{file}: [{kind}.{name}] must say where its figures come from: {key} = "..."')
    return tables


def _resolve(kind: str, table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Field of the specification (dotted path) to value in SI."""
    valid = keys(kind)
    out: dict[str, Any] = {}
    origin: dict[str, str] = {}
    for key, value in table.items():
        if key in REMARKS:
            continue
        if key not in valid:
            raise InputError(f"{where}: unknown key '{key}'; {nearest(key, valid)}")
        path, factor = valid[key]
        if path in origin:
            raise InputError(f"{where}: '{key}' and '{origin[path]}' say the same thing; give one")
        origin[path] = key
        out[path] = _number(value, factor, path.endswith("true_bias"), f"{where}: '{key}'")
        if path.rpartition(".")[2] in POSITIVE and not out[path] > 0.0:
            raise InputError(f"{where}: '{key}' must be positive, is {shown(value)}")
        if path == "rate_hz" and out[path] > HIGHEST_RATE_HZ:
            raise InputError(f"{where}: '{key}' must be at most {HIGHEST_RATE_HZ:g}, is {shown(value)}")
    return out


def _number(value: Any, factor: float, vector: bool, where: str) -> Any:
    if vector:
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise InputError(f"{where} must be a list of three numbers, is {shown(value)}")
        return tuple(factor * _finite(v, where) for v in value)
    if (number := _finite(value, where)) < 0.0:
        raise InputError(f"{where} must not be negative, is {shown(value)}")
    return factor * number


def _finite(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where} must be a finite number, is {shown(value)}")
    return float(value)


def _triad_keys(triad: str) -> dict[str, tuple[str, float]]:
    from testbed.physics.earth import G0

    if triad == "gyro":
        units = {"dps": _DEG, "dph": _DEG / 3600.0, "radps": 1.0}
        per_kelvin = {"dpspk": _DEG, "dphpk": _DEG / 3600.0}
        white = {"arw_dpsqrth": _DEG / 60.0, "arw_radpsqrts": 1.0}
        walk = {"rrw_dpsqrth3": _DEG / 3600.0**1.5, "rrw_radpssqrts": 1.0}
        own = {"g_sensitivity_dpspg": ("g_sensitivity", _DEG / G0)}
    else:
        units = {"mg": 1e-3 * G0, "ug": 1e-6 * G0, "g": G0, "mps2": 1.0}
        per_kelvin = {"mgpk": 1e-3 * G0, "ugpk": 1e-6 * G0}
        white = {"vrw_mpspsqrth": 1.0 / 60.0, "vrw_mpspsqrts": 1.0}
        walk = {"rrw_mpspsqrth3": 1.0 / 3600.0**1.5, "rrw_mps2psqrts": 1.0}
        own = {}
    out = _united(units, **{q: q for q in ("turn_on_bias", "true_bias", "bias_instability", "range", "resolution")})
    out |= _united(per_kelvin, bias_temperature="bias_temperature")
    out |= {key: ("white_noise", factor) for key, factor in white.items()}
    out |= {key: ("rate_random_walk", factor) for key, factor in walk.items()}
    out |= _united({"pct": 1e-2, "ppm": 1e-6}, scale_factor="scale_factor")
    out |= _united({"deg": _DEG, "mrad": 1e-3}, misalignment="misalignment", nonorthogonality="nonorthogonality")
    out |= {
        "correlation_time_s": ("correlation_time_s", 1.0),
        "nonlinearity_pctfs": ("nonlinearity", 1e-2),
        "scale_temperature_ppmpk": ("scale_temperature", 1e-6),
        "bandwidth_hz": ("bandwidth_hz", 1.0),
    }
    return {f"{triad}_{key}": (f"{triad}.{path}", factor) for key, (path, factor) in (out | own).items()}


def _united(units: Mapping[str, float], **quantities: str) -> dict[str, tuple[str, float]]:
    return {f"{q}_{unit}": (field, factor) for q, field in quantities.items() for unit, factor in units.items()}
