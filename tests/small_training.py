"""A training of `ahrs-lstm` that takes a second, and what it learns from."""

from ahrs_simulation import HEIGHT, LATITUDE, simulate

from testbed.physics.earth import gravity
from testbed.physics.rotations import quats_to_matrices

SMALL = {"neurons": 8, "batch": 3, "rounds": 2, "window_s": 10.0, "chunk_s": 5.0, "learning_rate": 1e-2}


class Flight:
    """What training asks of a flight: a simulated log with its truth."""

    def __init__(self, seed: int, duration_s: float = 30.0) -> None:
        self.simulated = simulate(seed, duration_s)
        self.rows = len(self.simulated.q_nb)

    def log(self):
        return self.simulated.log

    def window(self, start, rows):
        log, part = self.simulated.log, slice(start, start + rows)
        samples = {"gyro": log.imu.gyro, "accel": log.imu.accel, "mag": log.mag.field, "q_nb": self.simulated.q_nb}
        return {key: values[part] for key, values in samples.items()}

    def gravity_b(self):
        return gravity(LATITUDE, HEIGHT) * quats_to_matrices(self.simulated.q_nb)[:, 2]


def trained(flights, folder, resume=False, tell=lambda text: None, filter_params=None, **settings):
    from estimators.learning.ahrs_methods import train

    return train(flights[:2], flights[2:], folder, SMALL | settings, filter_params, resume, tell)
