"""`ahrs-lstm`: the compiled network against torch, what it learns from, training and resuming."""

import shutil
import tracemalloc

import numpy as np
import pytest
import torch
from small_training import Flight, trained

from estimators.learning.ahrs_lessons import Lesson, Teacher, true_acceleration, write_lesson
from estimators.learning.ahrs_lstm import AhrsLstm
from estimators.learning.ahrs_lstm_kernels import network_step, work_space
from estimators.learning.ahrs_weights import assemble, load_weights, untrained_weights
from estimators.methods.ahrs_kf import WITHOUT, AhrsKf
from testbed.base.errors import InputError

torch.set_num_threads(1)  # the arrays are small: threads only cost


@pytest.fixture(scope="module")
def flights():
    return [Flight(seed) for seed in range(3)]


def tensors(path):
    from safetensors.numpy import load_file

    return load_file(path)


def test_untrained_it_is_the_kalman_filter(flights):
    log = flights[0].log()
    mine, kf = AhrsLstm(weights="untrained").run(log), AhrsKf().run(log)
    assert np.array_equal(mine.q_nb, kf.q_nb)
    assert np.array_equal(mine.gyro_bias, kf.gyro_bias)


@pytest.mark.parametrize(("layers", "activation"), [(2, "sigmoid"), (3, "linear")])
def test_the_compiled_network_is_the_torch_network(layers, activation):
    from estimators.learning.ahrs_torch import GainNetwork

    torch.manual_seed(1)
    rng = np.random.default_rng(1)
    norm = [torch.as_tensor(rng.uniform(0.5, 2.0, 90), dtype=torch.float32) for _ in range(2)]
    network = GainNetwork(layers, 12, activation, *norm)
    torch.nn.init.normal_(network.head.weight)
    arrays = {key: value.numpy() for key, value in network.state_dict().items()}
    weights = assemble(arrays, {"activation": activation, "filter": {}, "step_s": 0.2})
    h, c = np.zeros((layers, 12), np.float32), np.zeros((layers, 12), np.float32)
    inputs, out = rng.normal(0.0, 20.0, (30, 90)), np.zeros(72, np.float32)
    with torch.no_grad():
        expected, _ = network(torch.as_tensor(inputs, dtype=torch.float32)[None])
    for row, wanted in zip(inputs, expected[0].numpy(), strict=True):
        network_step(row, tuple(weights.network), h, c, work_space(12), out)
        np.testing.assert_allclose(out, wanted, atol=2e-5)  # float32 sums of a few dozen terms of size one


def test_true_acceleration_is_what_gravity_leaves_of_specific_force():
    """A constant 2 m/s² along x, at the ends of the flight too; a swing of one second's period averages out."""
    gravity_b, accel = np.tile([0.0, 0.0, 9.8], (500, 1)), np.tile([2.0, 0.0, 0.0], (500, 1))
    accel[:, 1] = np.sin(2.0 * np.pi * np.arange(500) / 51.0)
    known = true_acceleration(accel - gravity_b, gravity_b, 50.0)
    np.testing.assert_allclose(known[:, 0], 2.0, rtol=1e-12)
    np.testing.assert_allclose(known[30:-30, 1:], 0.0, atol=1e-12)


def test_a_lesson_holds_what_the_filter_saw(flights, tmp_path):
    """Untrained, the filter flies as `ahrs-kf`; a teacher that is the same filter wants the same gain."""
    kf, log = AhrsKf(), flights[0].log()
    lesson = write_lesson(flights[0], kf, Teacher(kf), untrained_weights(1, 4), False, tmp_path / "a.f32")
    rows = lesson.read(0, lesson.rows)
    solution = kf.run(log)
    bias = solution.gyro_bias[: 10 * lesson.rows].reshape(-1, 10, 3).mean(1)
    np.testing.assert_allclose(rows[:, 9:12], bias, rtol=1e-5, atol=1e-9)  # float32
    np.testing.assert_array_equal(rows[:, 18:90], rows[:, 90:])
    np.testing.assert_array_equal(lesson.read(7, 5), rows[7:12])


def test_a_teacher_that_is_told_the_acceleration_trusts_the_rest_more(flights, tmp_path):
    """Where there is more acceleration than usual along an axis, its column of the gain on attitude is smaller."""
    kf = AhrsKf(**WITHOUT | {"linear_accel_mps2": 0.3, "linear_accel_time_s": 0.03})
    lesson = write_lesson(flights[0], kf, Teacher(kf, 4.0), untrained_weights(1, 4), True, tmp_path / "told.f32")
    gain = lesson.read(0, lesson.rows)[:, 90:].reshape(-1, 6, 12)[:, :3, :3]
    log, gravity_b = flights[0].log(), flights[0].gravity_b()
    known = true_acceleration(log.imu.accel, gravity_b, 50.0)[: 10 * lesson.rows].reshape(-1, 10, 3)[:, -1]
    size, much = np.linalg.norm(gain, axis=2), np.abs(known) > np.median(np.abs(known))
    assert size[much].mean() < 0.5 * size[~much].mean()


def test_reading_lessons_takes_memory_for_a_chunk_alone(tmp_path):
    """Ten times the flight, the same memory: a batch is all that is held."""
    peaks = []
    for rows in (2_000, 20_000):
        path = tmp_path / f"{rows}.f32"
        np.zeros((rows, 162), np.float32).tofile(path)
        lesson = Lesson(path)
        tracemalloc.start()
        for start in range(0, rows - 150, 150):
            lesson.read(start, 150)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]  # a chunk is 97 kB, the flights 1.3 and 13 MB


def test_training_lowers_the_error_and_stores_it(flights, tmp_path):
    """The filter expects far larger field noise than there is: higher gains are better, and there is much to learn."""
    said, wrong = [], WITHOUT | {"mag_noise_scale": 300.0, "linear_accel_mps2": 60.0}
    right = {"mag_noise_scale": 8.0, "linear_accel_mps2": 1.0}
    path = trained(flights, tmp_path, epochs=8, chunk_s=1.0, tell=said.append, filter_params=wrong, teacher=right)
    curve = (tmp_path / "learning-curve.csv").read_text().splitlines()
    errors = [float(line.split(",")[3]) for line in curve[1:]]
    assert len(errors) == 9 and min(errors[1:]) < 0.9 * errors[0]
    log = flights[2].log()
    assert not np.array_equal(AhrsLstm(weights=str(path)).run(log).q_nb, AhrsKf(**wrong).run(log).q_nb)
    stored = load_weights(str(path))
    assert stored.metadata["validation_deg"] == pytest.approx(min(errors), rel=1e-4)
    assert any("s left" in text for text in said)


def test_a_training_that_was_stopped_ends_in_the_same_weights(flights, tmp_path):
    trained(flights, tmp_path / "whole", epochs=3)

    class Stopped(Exception):
        pass

    def stop(text):
        if text.startswith("epoch 2"):
            raise Stopped

    with pytest.raises(Stopped):
        trained(flights, tmp_path / "cut", epochs=3, tell=stop)
    trained(flights, tmp_path / "cut", epochs=3, resume=True)
    for name in ("checkpoint.safetensors", "ahrs-lstm.safetensors"):
        whole, cut = tensors(tmp_path / "whole" / name), tensors(tmp_path / "cut" / name)
        assert whole.keys() == cut.keys()
        assert all(np.array_equal(whole[key], cut[key]) for key in whole)


def test_other_settings_do_not_resume(flights, tmp_path):
    trained(flights, tmp_path, epochs=1)
    with pytest.raises(InputError, match="other settings"):
        trained(flights, tmp_path, epochs=2, resume=True)


def test_a_training_whose_flights_are_gone_does_not_resume(flights, tmp_path):
    class Stopped(Exception):
        pass

    def stop(text):
        if text.startswith("epoch 1"):
            raise Stopped

    with pytest.raises(Stopped):
        trained(flights, tmp_path, epochs=4, tell=stop)
    shutil.rmtree(tmp_path / "lessons")
    with pytest.raises(InputError, match="are gone"):
        trained(flights, tmp_path, epochs=4, resume=True)


@pytest.mark.parametrize(
    ("settings", "named"),
    [({"layers": 0}, "layers"), ({"activation": "relu"}, "activation"), ({"chunk_s": 60.0}, "chunk_s")],
)
def test_wrong_settings_are_refused(flights, tmp_path, settings, named):
    with pytest.raises(InputError, match=named):
        trained(flights, tmp_path, **settings)


def test_missing_and_foreign_weights_are_refused(flights, tmp_path):
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(b"nothing of the kind")
    for path in (tmp_path / "none.safetensors", foreign):
        with pytest.raises(InputError, match=path.name):
            AhrsLstm(weights=str(path)).run(flights[0].log())
