"""A tuning study that takes seconds."""

from testbed.scenario import Scenario


def scenario(**settings):
    """12 s of straight flight at 50 Hz, two IMUs, six scales to be tuned."""
    tuning = {
        "algorithms": ["pso", "sipo", "de"],
        "iterations": [4],
        "population": 5,
        "train_runs": [0],
        "test_runs": [1, 2],
        "innovation_search": "pso",
        "cases": [{"name": name, "set": {"sensors.imu.model": name}} for name in ("ADIS16405", "ADIS16488")],
    }
    data = {
        "scenario": {"name": "tuned"},
        "flight": {
            "aircraft": "aerosonde",
            "rate_hz": 50.0,
            "initial": {"alt_m": 500.0, "speed_mps": 30.0},
            "manoeuvres": [{"type": "straight", "duration_s": 12.0}],
        },
        "sensors": {"imu": {"model": "ADIS16405"}, "gnss": {"model": "Garmin16x"}},
        "estimators": [{"name": "indirect-kf"}],
        "extra": {"tune": tuning | settings},
    }
    return Scenario.model_validate(data)
