"""`ahrs-lstm`: the compiled network against torch, the torch filter against the compiled one, training and resuming."""

import numpy as np
import pytest
import torch
from ahrs_simulation import simulate

from estimators.ahrs_kf import AhrsKf
from estimators.ahrs_lstm import AhrsLstm, assemble, load_weights
from estimators.ahrs_lstm_kernels import network_step
from testbed.errors import InputError

torch.set_num_threads(1)  # the arrays are small: threads only cost
SMALL = {"neurons": 8, "batch": 3, "interleave": 2, "window_s": 2.0, "chunk": 20, "threads": 1, "device": "cpu"}


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


@pytest.fixture(scope="module")
def flights():
    return [Flight(seed) for seed in range(3)]


def trained(flights, folder, resume=False, tell=lambda text: None, filter_params=None, **settings):
    from estimators.ahrs_training import train

    return train(flights[:2], flights[2:], folder, SMALL | settings, filter_params, resume, tell)


def tensors(path):
    from safetensors.numpy import load_file

    return load_file(path)


def test_untrained_it_is_the_kalman_filter(flights):
    log = flights[0].log()
    mine, kf = AhrsLstm(weights="untrained").run(log), AhrsKf().run(log)
    assert np.array_equal(mine.q_nb, kf.q_nb)
    assert np.array_equal(mine.gyro_bias, kf.gyro_bias)


def test_the_torch_filter_is_the_compiled_filter(flights):
    """In float64 the two differ by round-off of a thousand steps alone."""
    from estimators.ahrs_torch import BatchFilter
    from estimators.ahrs_windows import make_batch, prepare_flight
    from testbed.rotations import quats_to_matrices

    kf, cpu = AhrsKf(), torch.device("cpu")
    prepared = [prepare_flight(flight, kf, 20) for flight in flights[:2]]
    batch = make_batch([(p, 20) for p in prepared], 1000, cpu, torch.float64)
    filter_ = BatchFilter(prepared[0].model, cpu, torch.float64)
    for n in range(1000):
        z, k, _ = filter_.before(batch, n)
        filter_.after(batch, z, k)
    for flight, c_nb, bias in zip(flights, batch.c_nb.numpy(), batch.bias.numpy(), strict=False):
        solution = kf.run(flight.log())
        np.testing.assert_allclose(c_nb, quats_to_matrices(solution.q_nb)[1019], atol=1e-12)
        np.testing.assert_allclose(bias, solution.gyro_bias[1019], atol=1e-13)


@pytest.mark.parametrize(("layers", "activation"), [(2, "sigmoid"), (3, "linear")])
def test_the_compiled_network_is_the_torch_network(layers, activation):
    from estimators.ahrs_torch import GainNetwork

    torch.manual_seed(1)
    rng = np.random.default_rng(1)
    norm = [torch.as_tensor(rng.uniform(0.5, 2.0, n), dtype=torch.float32) for n in (90, 90, 72)]
    network = GainNetwork(layers, 12, activation, *norm)
    torch.nn.init.normal_(network.head.weight)
    arrays = {key: value.numpy() for key, value in network.state_dict().items()}
    weights = assemble(arrays, {"activation": activation, "filter": {}})
    h, c = np.zeros((layers, 12), np.float32), np.zeros((layers, 12), np.float32)
    work, out = tuple(np.zeros(n, np.float32) for n in (90, 12, 24, 48)), np.zeros(72, np.float32)
    memory = network.start(1)
    for _ in range(30):
        inputs = rng.normal(0.0, 20.0, 90)  # some beyond the clip
        network_step(inputs, *weights.network, h, c, work, out)
        with torch.no_grad():
            change, memory = network(torch.as_tensor(inputs, dtype=torch.float32)[None], memory)
        expected = (change[0].flatten() / network.scale).numpy()
        np.testing.assert_allclose(out, expected, atol=2e-5)  # float32 sums of a few dozen terms of size one


def test_the_teacher_takes_the_true_acceleration_for_its_sigma():
    """At rest only the floor; at a constant 2 m/s² along x, floor and factor together there, away from the ends too."""
    from estimators.ahrs_windows import teacher_sigma

    gravity_b = np.tile([0.0, 0.0, 9.8], (500, 1))
    sigma = teacher_sigma(np.array([2.0, 0.0, 0.0]) - gravity_b, gravity_b, 50.0, 1.5, 5.0)
    np.testing.assert_allclose(sigma[:, 0], np.hypot(1.5, 10.0), rtol=1e-12)
    np.testing.assert_allclose(sigma[:, 1:], 1.5, rtol=1e-12)


def test_a_filter_that_knows_the_acceleration_is_worth_imitating():
    """The teacher's own attitude is better than the Kalman filter's on flights with accelerations of 1 m/s²."""
    from estimators.ahrs_torch import BatchFilter
    from estimators.ahrs_windows import make_batch, prepare_flight

    cpu, kf = torch.device("cpu"), AhrsKf(linear_accel_mps2=5.0, linear_accel_time_s=0.03, mag_noise_scale=8.0)
    prepared = [prepare_flight(Flight(seed), kf, 20) for seed in range(6)]
    errors = []
    for taught in (False, True):
        batch = make_batch([(p, 20) for p in prepared], 1000, cpu, torch.float64, (0.3, 4.0))
        filter_, teacher = BatchFilter(prepared[0].model, cpu, torch.float64), batch.p.clone()
        for n in range(1000):
            z, k, turn = filter_.before(batch, n)
            wanted, teacher = filter_.gain(teacher, turn, filter_.seen(batch, batch.c_nb), batch.accel_sigma[:, n])
            filter_.after(batch, z, wanted if taught else k)
        errors.append(float(((batch.c_nb - batch.truth[:, -1])[:, 2] ** 2).sum(1).mean()))
    assert errors[1] < 0.7 * errors[0]


def test_training_lowers_the_error_and_stores_it(flights, tmp_path):
    """The filter expects far larger field noise than there is: higher gains are better, and there is much to learn."""
    said, wrong = [], {"mag_noise_scale": 300.0, "linear_accel_mps2": 60.0}
    path = trained(flights, tmp_path, epochs=4, learning_rate=1e-2, tell=said.append, filter_params=wrong)
    curve = (tmp_path / "learning-curve.csv").read_text().splitlines()
    errors = [float(line.split(",")[2]) for line in curve[1:]]
    assert len(errors) == 5 and min(errors[1:]) < 0.9 * errors[0]
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


def test_missing_and_foreign_weights_are_refused(flights, tmp_path):
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(b"nothing of the kind")
    for path in (tmp_path / "none.safetensors", foreign):
        with pytest.raises(InputError, match=path.name):
            AhrsLstm(weights=str(path)).run(flights[0].log())
