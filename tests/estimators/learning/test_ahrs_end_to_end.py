"""`ahrs-lstm` end to end: the way back through the unrolled filter, and training on the attitude error."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_training import Flight, trained

from estimators.learning.ahrs_unrolled import Flight as Cut
from estimators.learning.ahrs_unrolled import Unrolled, cut
from estimators.learning.ahrs_unrolled_kernels import fly, fly_back, make_tape
from estimators.methods.ahrs_kf import WITHOUT, AhrsKf
from testbed.base.errors import InputError
from testbed.physics.rotations import quat_multiply, rotvec_to_quat

torch.set_num_threads(1)  # the arrays are small: threads only cost
BATCH, STEPS, EVERY, STEP = 2, 4, 3, 1e-6
LIVELY = AhrsKf(**WITHOUT | {"linear_accel_mps2": 1.0, "linear_accel_time_s": 0.3, "mag_disturbance_time_s": 2.0})
"""Disturbances that neither stay nor vanish within the few samples of a test."""
TRUSTING = WITHOUT | {"linear_accel_mps2": 0.3, "linear_accel_time_s": 0.03}
"""Takes the flights' accelerations of 1 m/s² for gravity."""


@pytest.fixture(scope="module")
def flights():
    return [Flight(seed) for seed in range(3)]


def windows_of(flights):
    places = [(Cut(flight, LIVELY, np.radians([0.3, -0.2, 0.1])), 40) for flight in flights[:BATCH]]
    return cut(places, STEPS * EVERY, np.random.default_rng(3))


def weighed_sum(windows, answers, weights, errors=None):
    """All that `STEPS` steps give, weighed and summed; ``errors`` (B,12) are put upon the start. And the tape."""
    by_inputs, by_loss = weights
    windows = windows._replace(state=windows.state.copy(), p=windows.p.copy())
    for state, error in zip(windows.state, np.zeros((BATCH, 12)) if errors is None else errors, strict=True):
        state[:4] = quat_multiply(tuple(state[:4]), rotvec_to_quat(tuple(error[:3])))
        state[4:] += error[3:]
    tape, inputs, loss, total = make_tape(STEPS, BATCH, EVERY), np.empty((BATCH, 90)), np.empty(BATCH), 0.0
    for m in range(STEPS):
        fly(windows, m * EVERY, answers[m], tape, m, inputs, loss)
        total += (by_inputs[m] * inputs).sum() + (by_loss[m] * loss).sum()
    return total, windows, tape


def test_the_way_back_is_the_numerical_derivative_of_the_way_there(flights):
    """For errors of the start and for the network's answers, through attitude, covariance and gain alike."""
    rng = np.random.default_rng(1)
    windows, answers = windows_of(flights), rng.normal(0.0, 0.5, (STEPS, BATCH, 72))
    weights = rng.normal(0.0, 1.0, (STEPS, BATCH, 90)), rng.normal(0.0, 1e3, (STEPS, BATCH))
    _, flown, tape = weighed_sum(windows, answers, weights)
    back, by_answers = (np.zeros((BATCH, 12)), np.zeros((BATCH, 12, 12))), np.zeros((STEPS, BATCH, 72))
    for m in range(STEPS - 1, -1, -1):
        fly_back(flown, answers[m], tape, m, back, (weights[0][m], weights[1][m], by_answers[m]))

    def slope(answer=None, error=None):
        sides = []
        for side in (STEP, -STEP):
            moved, errors = answers.copy(), np.zeros((BATCH, 12))
            if answer is not None:
                moved[answer] += side
            if error is not None:
                errors[error] += side
            sides.append(weighed_sum(windows, moved, weights, errors)[0])
        return (sides[0] - sides[1]) / (2.0 * STEP)

    for error in np.ndindex(BATCH, 12):  # a central difference of 1e-6 of a sum of about 100: 1e-8 of rounding
        assert slope(error=error) == pytest.approx(back[0][error], abs=1e-6 * np.abs(back[0]).max()), error
    for answer in [(m, b, i) for m in range(STEPS) for b in range(BATCH) for i in range(m, 72, 11)]:
        assert slope(answer) == pytest.approx(by_answers[answer], abs=1e-6 * np.abs(by_answers).max()), answer


def test_a_limited_answer_has_no_gradient(flights):
    windows, answer = windows_of(flights), np.zeros((BATCH, 72))
    answer[:, 5] = 6.0
    tape, by_answer = make_tape(1, BATCH, EVERY), np.zeros((BATCH, 72))
    fly(windows, 0, answer, tape, 0, np.empty((BATCH, 90)), np.empty(BATCH))
    back = np.ones((BATCH, 12)), np.zeros((BATCH, 12, 12))
    fly_back(windows, answer, tape, 0, back, (np.zeros((BATCH, 90)), np.ones(BATCH), by_answer))
    assert np.all(by_answer[:, 5] == 0.0) and np.all(by_answer[:, 4] != 0.0)


def test_unrolled_it_is_the_filter(flights):
    """From the start of the log, the network answering nothing: the attitude of `ahrs-kf`, sample for sample."""
    log, steps = flights[0].log(), 20
    windows = cut([(Cut(flights[0], LIVELY, np.zeros(3)), 0)], steps * 10, np.random.default_rng(0))
    state, p = LIVELY.start(log)
    samples = {"gyro": log.imu.gyro, "accel": log.imu.accel - log.initial.accel_bias, "mag": log.mag.field}
    parts = {key: value[None, : steps * 10].copy() for key, value in samples.items()}
    flown = Unrolled(windows._replace(state=state[None], p=p[None], **parts), [], 10, 1)
    expected = LIVELY.run(log)
    for k in range(steps):
        flown.step(flown.chunk(), torch.zeros(1, 72))
        np.testing.assert_allclose(flown.windows.state[0, :4], expected.q_nb[10 * k + 9], atol=1e-14)


def test_the_loss_is_the_square_of_the_tilt_error(flights):
    """A start whose roll is off by 2 degrees, and one whose heading is by half a radian, which does not count."""
    place = [(Cut(flights[0], LIVELY, np.zeros(3)), 0)]
    windows = cut(place, 1, np.random.default_rng(0))
    windows.p[:], windows.figures[:, 0] = 0.0, 0.0  # an attitude that is known: nothing corrects it
    true = windows.down[0, 0]
    q = flights[0].window(0, 1)["q_nb"][0]
    for turn, expected in (((0.0, 0.0, 0.5), 0.0), ((np.radians(2.0), 0.0, 0.0), 2.0)):
        windows.state[0, :4] = quat_multiply(rotvec_to_quat(turn), tuple(q))
        loss = np.empty(1)
        fly(windows, 0, np.zeros((1, 72)), make_tape(1, 1, 1), 0, np.empty((1, 90)), loss)
        assert np.degrees(np.sqrt(loss[0])) == pytest.approx(expected, abs=0.02)  # the gyro's noise and bias in 20 ms
    assert np.linalg.norm(true) == pytest.approx(1.0)


def test_a_step_of_the_network_is_that_of_its_sequence():
    from estimators.learning.ahrs_torch import GainNetwork

    torch.manual_seed(2)
    network = GainNetwork(2, 8, "sigmoid", torch.zeros(90), torch.ones(90))
    torch.nn.init.normal_(network.head.weight)
    inputs, memory = torch.randn(3, 5, 90), None
    expected, (h, c) = network(inputs)
    for k in range(5):
        answer, memory = network.step(inputs[:, k], memory)
        torch.testing.assert_close(answer, expected[:, k])
    torch.testing.assert_close(memory, (h, c))


def test_training_end_to_end_lowers_the_error(flights, tmp_path):
    trained(
        flights,
        tmp_path,
        method="end-to-end",
        epochs=8,
        chunk_s=1.0,
        filter_params=TRUSTING,
        optimiser="sgd",
        learning_rate=0.3,
    )
    with open(tmp_path / "learning-curve.csv", newline="") as file:
        errors = [float(row["validation_deg"]) for row in csv.DictReader(file)]
    assert len(errors) == 9 and min(errors[1:]) < 0.9 * errors[0]
    with open(tmp_path / "gradients.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == int(rows[-1]["update"])
    assert all(float(row["gradient_norm"]) > 0.0 for row in rows)


def test_a_stopped_training_end_to_end_ends_in_the_same_bytes(flights, tmp_path):
    class Stopped(Exception):
        pass

    def stop(text):
        if text.startswith("epoch 1"):
            raise Stopped

    settings = {"method": "end-to-end", "epochs": 2, "filter_params": TRUSTING}
    trained(flights, tmp_path / "whole", **settings)
    with pytest.raises(Stopped):
        trained(flights, tmp_path / "cut", tell=stop, **settings)
    trained(flights, tmp_path / "cut", resume=True, **settings)
    for name in ("checkpoint.safetensors", "ahrs-lstm.safetensors", "learning-curve.csv", "gradients.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes(), name


def test_flights_whose_field_is_slower_are_refused(flights):
    class Slow(Flight):
        def log(self):
            log = super().log()
            mag = replace(log.mag, t=log.mag.t[::5], field=log.mag.field[::5])
            return replace(log, aiding={"mag": mag})

    with pytest.raises(InputError, match="field sample with each IMU sample"):
        Cut(Slow(0, 5.0), LIVELY, np.zeros(3))


@pytest.mark.parametrize(("settings", "named"), [({"device": "tpu9"}, "tpu9"), ({"method": "guess"}, "guess")])
def test_devices_and_methods_that_are_none_are_refused(flights, tmp_path, settings, named):
    with pytest.raises(InputError, match=named):
        trained(flights, tmp_path, **settings)


def test_training_takes_the_gpu_that_torch_finds(monkeypatch):
    from estimators.learning.ahrs_torch import device_of

    for found, expected in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        assert device_of("auto").type == expected
    assert device_of("cpu").type == "cpu"
