"""
A track of one's own as truth
=============================

A table with times and places takes the place of the flight; everything behind it stays as it is.
"""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import testbed

t = np.arange(0.0, 121.0)
angle = 2.0 * np.pi * t / 60.0
east, north = 300.0 * np.sin(angle), 150.0 * np.sin(2.0 * angle)  # a figure of eight
table = pd.DataFrame({"time_s": t, "north_m": north, "east_m": east, "down_m": -20.0 * np.sin(angle)})
file = Path(tempfile.mkdtemp()) / "mine.csv"
table.to_csv(file, index=False)

flight = {
    "trajectory": str(file),
    "origin": {"lat_deg": 47.26, "lon_deg": 11.35, "alt_m": 600.0},
    "attitude": "coordinated",
}
scenario = testbed.load_scenario("quickstart", overrides={f"flight.{key}": value for key, value in flight.items()})
testbed.fly(scenario).plot()
