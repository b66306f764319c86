"""The verb ``testbed league``: everybody's filter as a row of one table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def league_command(
    entries: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FOLDER...", help="Entries (folders with entry.toml) beside the shipped rows."),
    ] = None,
    check: Annotated[
        Path | None, typer.Option("--check", metavar="FOLDER", help="Say in a minute whether an entry runs.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Three development seeds of a row, one of a slow row, no very slow row.")
    ] = False,
    development: Annotated[
        bool, typer.Option("--development", help="All runs, on the public development seeds.")
    ] = False,
    rows: Annotated[str | None, typer.Option(metavar="A,B", help="Only these rows.")] = None,
    tracks: Annotated[str | None, typer.Option(metavar="A,B", help="Only these tracks.")] = None,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="FOLDER", help="The recorded drive, for the track real-drive.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the tables; what is there is gone on with.")
    ] = None,
) -> None:
    """A benchmark that others submit to: everybody's filter on eight tracks, ranked with its honesty."""
    if check is not None:
        _check(check)
        return
    from testbed.league.run import Wanted, default_jobs, league

    wanted = Wanted(entries or (), _names(rows), _names(tracks), quick, development, data, jobs or default_jobs())
    suffix = "-quick" if quick else "-development" if development else ""
    written = league(wanted, out or Path("results") / f"league{suffix}")
    print(written[0].with_name("league.md").read_text(encoding="utf-8").split("\n### ", 1)[0])
    print("tables: " + ", ".join(str(path) for path in written))


def _check(folder: Path) -> None:
    from testbed.league.check import check

    found, remark = check(folder)
    for each in found:
        print(
            f"{each.track:14s} {each.metric} {each.error:.4g}, {each.us:.3g} µs per sample ({each.us / each.reference_us:.3g} of the reference)"
        )
    print(f"{folder}: runs; {remark}")


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]
