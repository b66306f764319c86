"""`testbed train`: data set, training and, where the scenario asks for it, the structure sweep of its network.

Training itself belongs to the estimator: the scenario's first estimator whose class has ``train(training, validation,
out, settings, filter_params, resume, tell)``. ``[extra.train]`` are its settings, ``[extra.train.filter]`` parameters of the
filter below it, ``[extra.train.sweep]`` lists of settings whose every combination is trained. ``needed_to_train`` of the
class names the packages that training needs beyond running, each with the extra that brings it.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError, MissingExtra
from testbed.base.resources import cache_root
from testbed.montecarlo.folders import LOCK, MANIFEST, Folder, check_own
from testbed.scenario import Scenario
from testbed.training.dataset import dataset_config, dataset_key, make_dataset, open_dataset

KIND = "testbed training"
FORMAT = 2
"""Of the stored flights: since the second they carry the hash of their content."""


def dataset_folder(scenario: Scenario) -> Path:
    """Where the data set of a scenario is kept unless the user says otherwise."""
    return cache_root() / "datasets" / f"{scenario.name}-{dataset_key(scenario)}-{FORMAT}"


def train(
    scenario: Scenario,
    out: str | Path,
    data: str | Path | None = None,
    resume: bool = False,
    tell: Callable[[str], None] = print,
) -> Path:
    """Make what is missing of the data set, train, and return the file of the weights (or the table of a sweep).

    Raises InputError when the scenario has nothing to train or a setting is wrong.
    """
    trainer = _trainer(scenario)
    check_own(Path(out), KIND)
    folder = Path(data) if data is not None else dataset_folder(scenario)
    if data is None or not (folder / "manifest.json").exists():
        tell(f"data set: {folder}")
        make_dataset(scenario, folder, progress=lambda done, total: tell(f"flight {done} of {total}"))
    training, validation = open_dataset(folder)
    settings = dict(scenario.extra.get("train", {}))
    filter_params, grid = settings.pop("filter", {}), settings.pop("sweep", {})
    wanted = dataset_config(scenario)
    training = training[: max(1, wanted.flights - wanted.validation - wanted.test)]

    def one(point: dict[str, Any], folder: Path) -> Path:
        try:
            made = trainer(training, validation, folder, settings | point, filter_params, resume=resume, tell=tell)
        except TypeError as error:
            raise InputError(f"{scenario.source_path}: extra.train: {error}") from None
        return Path(made)

    with Folder.open(out, KIND) as own:
        own.save()
        before = _contents(own.out)
        try:
            return _sweep(one, grid, own, tell) if grid else one({}, own.out)
        finally:
            own.files.update(dict.fromkeys(_contents(own.out) - before))
            own.save()


def _contents(folder: Path) -> set[str]:
    """Names of the files in a folder; the manifest is not content."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in (LOCK, MANIFEST))
    return {path.relative_to(folder).as_posix() for path in files}


def _trainer(scenario: Scenario) -> Any:
    from testbed.data.registry import estimator_class

    for entry in scenario.estimators:
        kind = estimator_class(entry.name)
        if (trainer := getattr(kind, "train", None)) is not None:
            for package, extra in getattr(kind, "needed_to_train", {}).items():
                if importlib.util.find_spec(package) is None:
                    raise MissingExtra(
                        f"training {entry.name} needs the package {package}: pip install 'navigation-testbed[{extra}]'"
                    )
            return trainer
    raise InputError(f"{scenario.source_path}: none of its estimators is trained beforehand")


def _sweep(
    one: Callable[[dict[str, Any], Path], Path], grid: dict[str, list[Any]], own: Folder, tell: Callable[[str], None]
) -> Path:
    """Train every combination; ``sweep.csv`` has one row for each, with its validation error and that before training."""
    rows = []
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        name = "-".join(str(v) for v in values)
        tell(f"structure {name}")
        folder = one(point, own.out / name).parent
        with open(folder / "learning-curve.csv", newline="") as file:
            errors = [float(row["validation_deg"]) for row in csv.DictReader(file)]
        improvement = 100.0 * (1.0 - min(errors) / errors[0])
        rows.append(
            point | {"untrained_deg": errors[0], "validation_deg": min(errors), "improvement_pct": f"{improvement:.2f}"}
        )
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    own.write("sweep.csv", text.getvalue().encode())
    return own.out / "sweep.csv"
