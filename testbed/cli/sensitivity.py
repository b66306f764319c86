"""The verb ``testbed sensitivity``: which figures of a data sheet decide a metric."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from testbed.cli.options import (
    OutOption,
    PluginOption,
    ProfileOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    VariantOption,
    load_plugins,
    loader,
)


def sensitivity_command(
    scenario: ScenarioArgument,
    over: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=LOW..HIGH",
            help="A figure and its range, e.g. sensors.imu.gyro_arw_dpsqrth=0.1..3 (or 0.1..3:log).",
        ),
    ] = None,
    metric: Annotated[
        list[str] | None, typer.Option(help="As 'testbed list metrics' shows; default: rmse_position_3d_m.")
    ] = None,
    window: Annotated[list[str] | None, typer.Option(help="Scoring window; default: all.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="morris, sobol; default: both.")] = None,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Base samples of Sobol, a power of 2; each is (figures + 2) points.")
    ] = None,
    trajectories: Annotated[
        int | None, typer.Option(min=2, help="Trajectories of Morris; each is (figures + 1) points.")
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Noise seeds, the same at every point.")] = None,
    estimators: Annotated[str | None, typer.Option(metavar="A,B", help="Only these rows of the scenario.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Complete an earlier study, or go on to more samples.")
    ] = False,
    time_limit: Annotated[float | None, typer.Option(min=1.0, help="Stop, resumable, after so many seconds.")] = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
    seed: SeedOption = None,
    plugin: PluginOption = None,
) -> None:
    """Which figures of a data sheet decide a metric: Morris screening and Sobol indices, with intervals."""
    from testbed.montecarlo.runner import with_settings
    from testbed.sensitivity.factors import parse_factor
    from testbed.sensitivity.question import Question
    from testbed.sensitivity.study import sensitivity

    load_plugins(plugin)
    loaded = loader(scenario, profile, variant, settings, seed)({})
    if estimators is not None:
        loaded = with_settings(loaded, estimators=[part.strip() for part in estimators.split(",") if part.strip()])
    given = {
        "metrics": _words(metric),
        "windows": _words(window),
        "methods": _words(method),
        "samples": samples,
        "trajectories": trajectories,
        "runs": runs,
    }
    asked = Question(
        tuple(parse_factor(text) for text in over or []),
        **{key: value for key, value in given.items() if value is not None},  # type: ignore[arg-type]
    )
    variant_part = f"-{loaded.variant}" if loaded.variant else ""
    folder = out or Path("results") / f"{loaded.name}{variant_part}-sensitivity"
    with _progress() as show:
        sensitivity(loaded, asked, folder, jobs, resume, time_limit, show, plugin or [])
    _print(folder)


def _words(texts: list[str] | None) -> tuple[str, ...] | None:
    """What an option names, several times or with commas."""
    if texts is None:
        return None
    return tuple(dict.fromkeys(part.strip() for text in texts for part in text.split(",") if part.strip()))


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A line of progress for each method."""
    from testbed.cli.console import progress_line

    with ExitStack() as stack:
        lines: dict[str, Callable[[int, int], None]] = {}

        def show(method: str, done: int, total: int) -> None:
            if method not in lines:
                stack.close()
                lines[method] = stack.enter_context(progress_line(f"points of {method}"))
            lines[method](done, total)

        yield show


def _print(folder: Path) -> None:
    """The text of the study, which is meant for a screen too, and where the rest lies."""
    print((folder / "sensitivity.md").read_text(encoding="utf-8"))
    print(f"tables and figures: {folder / 'sensitivity.csv'}, {folder / 'sensitivity.md'}")
