"""The study of what NARX networks can learn: which windows each column is about."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from report_studies import study
from test_narx_networks import synthetic_drifts

from estimators.learning.narx_networks import DriftNetworks, Structure
from estimators.learning.networks.levenberg_marquardt import Training

lessons_study = study("narx_lessons")


def test_what_is_left_of_the_drift_is_told_apart_by_window():
    """A drift with a cause is learnt: in windows trained on, kept back and not seen the networks leave less than half of it.

    The kept-back windows are every third, so with six of them larger by ten their free column is ten times the other's.
    """
    lessons, unseen = synthetic_drifts(18, 0), synthetic_drifts(6, 1)
    known = [drift for k, drift in enumerate(lessons) if k % 3 != 2]
    networks = DriftNetworks(Structure((("roll", "t"),) * 6, ((2, 1),) * 6, neurons=4)).train(
        known, Training(epochs=100)
    )
    pupil = SimpleNamespace(initial_networks=lambda log: networks)
    cells = [cell.strip() for cell in lessons_study._lesson_row("row", pupil, lessons, unseen).strip("|").split("|")]
    assert cells[0] == "row" and len(cells) == 8
    free, left = (np.array([float(value) for value in cells[first:7:2]]) for first in (1, 2))
    assert (left < 0.5 * free).all()
    larger = [replace(d, y=10.0 * d.y) if k % 3 == 2 else d for k, d in enumerate(lessons)]
    again = [cell.strip() for cell in lessons_study._lesson_row("row", pupil, larger, unseen).strip("|").split("|")]
    assert again[1] == cells[1] and float(again[3]) == pytest.approx(10.0 * free[1], rel=0.02)  # one decimal is printed
    table = lessons_study._drift_table(
        {"one": [replace(lessons[0], y=np.full((61, 6), 3.0), variance=np.full((61, 6), 4.0))]}
    )
    assert table[-1] == "| one | 1 | " + " | ".join(["3.0"] * 6 + ["2.0"] * 3) + " |"
