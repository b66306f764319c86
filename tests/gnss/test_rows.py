"""Fixes of sidereon and RTKLIB as rows that ``testbed score`` takes: the figures that those programs are known for."""

from pathlib import Path

import numpy as np
import pytest
from report_studies import study

from testbed.formats.solutions import read
from testbed.physics.ecef import ecef_to_geodetic

DATA = Path(__file__).parents[3] / "shared" / "data" / "rinex"
PLACE = (-3962108.6617, 3381309.5232, 3668678.6410)


def test_other_programs_are_rows(tmp_path):
    """95 % of the horizontal errors, and the mean in height: 1.27 and 1.19 m of sidereon, 1.28 and 1.39 m of RTKLIB, to half
    a unit of the last digit."""
    pytest.importorskip("sidereon")
    pytest.importorskip("pyrtklib")
    if not DATA.is_dir():
        pytest.skip("needs the shared observation file")
    made = study("gnss_rows").make(DATA / "SEPT078M_GE.21O", DATA / "SEPT078M.21P", PLACE, tmp_path)
    assert [path.name for path in made] == ["sidereon.csv", "rtklib.csv", "testbed.csv"]
    origin = ecef_to_geodetic(*PLACE)
    places = {path.stem: read(path, origin).ned for path in made}
    # the bench's receiver wants a rate, which the first and the last epoch have not
    assert [len(ned) for ned in places.values()] == [900, 900, 898]
    for name, figures in {"sidereon": (1.27, 1.19), "rtklib": (1.28, 1.39)}.items():
        ned = places[name]
        found = np.percentile(np.hypot(ned[:, 0], ned[:, 1]), 95), ned[:, 2].mean()
        assert found == pytest.approx(figures, abs=0.006), name
