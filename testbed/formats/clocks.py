"""Do the times of a recording's tables belong together? Their unit, what they share with the IMU's, and their gaps.

Part of `testbed.formats.plausibility`; s, Hz.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.shapes import gaps_of
from testbed.formats.raw import Raw
from testbed.formats.recording import seconds, thousandfold

IMU_HZ = (1.0, 40e3)
"""Rates of an IMU recording: a vehicle swings and turns within seconds, which slower samples miss; MEMS IMUs end at 32 kHz."""
SLOW_IMU_HZ = 5.0
"""The slowest setting of phones; a swing or a manoeuvre of a second wants several samples. In ms, 5 kHz would be this."""
FEWEST_INSIDE = 3
"""Rows of a sensor while the IMU records, below which nothing can be filtered or scored with them."""
LEAST_SHARED = 0.1
"""Of the shorter of two files' times: loggers of one vehicle are started and stopped minutes apart, not nine tenths."""


def parts_of(raw: Raw) -> dict[str, Any]:
    """Every recorded table by the name of its part, the IMU first."""
    named = {"imu": raw.imu, "gnss": raw.gnss, "mag": raw.mag, "baro": raw.baro, **raw.others}
    return {name: samples for name, samples in named.items() if samples is not None}


def rates(raw: Raw) -> list[str]:
    """IMU times in another unit than their name says, and an initial state that does not lie before them."""
    imu = raw.imu
    assert imu is not None
    place = raw.place("imu")
    rate = 1.0 / float(np.median(np.diff(imu.t)))
    if not IMU_HZ[0] * 0.99 <= rate <= IMU_HZ[1]:
        raise InputError(
            f"{place}: has {rate:.4g} samples a second, an IMU recording has {IMU_HZ[0]:g} to {IMU_HZ[1]:g};"
            f" {_time_question(place, rate < 1.0)}"
        )
    if raw.t_start >= imu.t[0]:
        raise InputError(
            f"{place}: the first sample is at {seconds(imu.t[0])} s, and the initial state (log.json) at {seconds(raw.t_start)} s:"
            " it must lie before, where the first sample's interval begins"
        )
    if rate < SLOW_IMU_HZ:
        return [
            f"{place}: has {rate:.4g} samples a second, too few for the motion of most vehicles;"
            f" {_time_question(place, True)}"
        ]
    return []


def _time_question(place: str, slow: bool) -> str:
    """Whether times are in another unit, and in tables how a column says so."""
    table = place.endswith((".csv", ".parquet"))
    if slow:
        return "are its times in milliseconds?" + (" Such a column is called time_ms" if table else "")
    return "are its times in another unit?" + (" Columns are called time_s, time_ms, time_us, time_ns" if table else "")


def overlaps(raw: Raw) -> list[str]:
    """Times of the other tables against those of the IMU: none, a thousandth or hardly any in common."""
    assert raw.imu is not None
    notes = []
    start, end = raw.t_start, float(raw.imu.t[-1])
    times = {name: samples.t for name, samples in parts_of(raw).items() if name != "imu"}
    if raw.motion is not None:
        times["reference"] = raw.motion[0]
    counted = f"; times count from {seconds(raw.utc)} s since 1970" if raw.utc else ""
    for name, t in times.items():
        if not len(t):
            continue
        span, place = float(t[-1] - t[0]), raw.place(name)
        told = f"{place}: {seconds(t[0])} to {seconds(t[-1])} s"
        imu = f"the IMU, {seconds(start)} to {seconds(end)} s"
        thousand = thousandfold(span, end - start)
        asked = f"; {_time_question(place if span > end - start else raw.place('imu'), True)}" if thousand else ""
        inside = int(((t >= start - 1e-9) & (t <= end + 1e-9)).sum())
        if t[-1] < start - 1e-9 or t[0] > end + 1e-9:
            own = name in ("gnss", "mag", "baro")
            shift = (start - float(t[0])) * (1.0 if own else -1.0)
            raise InputError(
                f"{told} does not overlap {imu}; if the clocks differ, recording.{name if own else 'imu'} clock_s says by how much"
                f" ({seconds(shift)} would let both begin together{counted}){asked}"
            )
        if thousand and len(t) > FEWEST_INSIDE and inside < FEWEST_INSIDE:
            raise InputError(f"{told} has {inside} of its {len(t)} rows within the times of {imu}{asked}")
        shared = min(float(t[-1]), end) - max(float(t[0]), start)
        if (len(t) > FEWEST_INSIDE and inside < FEWEST_INSIDE) or shared < LEAST_SHARED * min(span, end - start):
            notes.append(
                f"{told} has {inside} of its {len(t)} rows within the times of {imu}: do the clocks differ?{asked}"
            )
    return notes


def gaps(raw: Raw) -> list[str]:
    notes = []
    for name, samples in parts_of(raw).items():
        if (found := gaps_of(np.unique(samples.t))) and not (name == "gnss" and samples.outages):
            longest = max(found, key=lambda gap: gap[1] - gap[0])
            count = f"{len(found)} gaps, the longest" if len(found) > 1 else "a gap"
            notes.append(
                f"{raw.place(name)}: {count} from {seconds(longest[0])} to {seconds(longest[1])} s ({longest[1] - longest[0]:.3g} s)"
                + (", which no filter can bridge well; the rest is scored" if name == "imu" else "")
            )
    return notes
