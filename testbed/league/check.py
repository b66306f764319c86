"""Whether an entry runs: its folder read, and some seconds of every track of its class answered, in a minute."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from testbed.base.errors import InputError
from testbed.league.cells import KEEP_HZ, scored, sense
from testbed.league.entry import read_entry, shipped_entries, unique
from testbed.league.launch import Logs, answers, build
from testbed.league.speeds import LEAST_US, SEEDS, speed_of
from testbed.league.suite import RECORDED, REFERENCE, TRACKS, load_track, shortened

CHECK_S = 30.0
"""Longest time for a log in a check: the logs are half a minute long, and an answer that takes longer comes too late for a league
whose longest log is of half an hour."""


@dataclass(frozen=True)
class Checked:
    """What an entry made of the beginning of a track: the figure that ranks, and the time per sample."""

    track: str
    metric: str
    error: float
    us: float
    reference_us: float
    tells_sigmas: bool


def check(folder: Path) -> tuple[list[Checked], str]:
    """What an entry makes of the first seconds of its tracks, and a remark. Raises InputError that says why it does not run."""
    entry = read_entry(folder)
    unique([*(other for other in shipped_entries() if other.folder.resolve() != folder.resolve()), entry])
    if missing := entry.missing():
        raise InputError(f"{entry.place}: 'needs': this machine has no {missing}")
    found = []
    limit = min(CHECK_S, entry.table.timeout_s)
    entry = replace(entry, table=entry.table.model_copy(update={"timeout_s": limit}))
    with tempfile.TemporaryDirectory(prefix="testbed-league-") as scratch:
        place = Path(scratch)
        built = build(entry, place / "built")
        for name in TRACKS:
            if name in RECORDED or load_track(name, development=True).table.filters != entry.table.filters:
                continue
            track = shortened(name)
            (sensed,) = sense(track, [0])
            logs = Logs([sensed.log], place / name / "logs", track.table.filters, KEEP_HZ)
            (answer,) = answers(entry, logs, 1, place / name / "home", built)
            row = scored(track, 0, sensed, answer)
            if row["error"] is None:
                raise InputError(f"{entry.place}: does not run on {name}: {row['status']}: {row['reason']}")
            told = float(row["error"]), answer.us or 0.0, answer.reference_us or 0.0
            found.append(Checked(name, track.table.metric, *told, bool(row["nees"])))
    return found, remark(entry.table.speed, found, REFERENCE[entry.table.filters], entry.how == "files")


def remark(speed: str, found: list[Checked], reference: str, by_files: bool) -> str:
    """What the author may want to know: a speed declared wrong, sigmas that are not told."""
    middle = sorted(found, key=lambda each: each.us)[len(found) // 2]
    us, relative = middle.us, middle.us / middle.reference_us
    said = []
    if by_files:
        said.append("its time holds the start of its program, which short logs do not spread")
    else:
        right = speed_of(us)
        # a busy machine slows the reference down as well, and near a bound neither is wrong
        slower = LEAST_US[right] > LEAST_US[speed] and relative > LEAST_US[right]
        faster = us < 0.5 * LEAST_US[speed]
        if slower or faster:
            said.append(
                f"it takes {us:.3g} µs per sample: say speed = '{right}' ({SEEDS[right]} seeds in place of {SEEDS[speed]})"
            )
    if not any(each.tells_sigmas for each in found):
        said.append("it tells no sigmas (std or covariance), and so cannot win")
    return "; ".join(said) or f"its time is told in units of {reference}"
