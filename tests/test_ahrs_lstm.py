"""`ahrs-lstm`: the compiled network against torch, the torch filter against the compiled one, training and resuming."""

import numpy as np
import pytest
import torch
from ahrs_simulation import simulate

from estimators.ahrs_kf import AhrsKf
from estimators.ahrs_lstm import AhrsLstm, assemble, load_weights
from estimators.ahrs_lstm_kernels import network_step
from testbed.errors import InputError

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


def test_the_error_budget_is_what_many_flights_show():
    """Forty logs with one motion: the mean square attitude error of the Kalman gain is the budget's expectation.

    Each log's accelerations differ, so the budget's mean is averaged too. Errors about one axis dominate: the
    sampling error of a mean square of 40 is sqrt(2/40) = 22 %; three of these are allowed.
    """
    from estimators.ahrs_torch import BatchFilter, ErrorBudget
    from estimators.ahrs_windows import make_batch, prepare_flight

    flights = [Flight(seed, 10.1) for seed in range(40)]
    kf, cpu = flights[0].simulated.estimator, torch.device("cpu")
    prepared = [prepare_flight(flight, kf, 20) for flight in flights]
    batch = make_batch([(p, 200) for p in prepared], 300, cpu, torch.float64)
    filter_ = BatchFilter(prepared[0].model, cpu, torch.float64)
    budget = ErrorBudget(filter_, prepared[0].model, np.radians(2.5e-4), (1e-12, 100.0))
    errors = budget.start(batch)
    for n in range(300):
        z, k, turn = filter_.before(batch, n)
        filter_.after(batch, z, k)
        seen = filter_.seen(batch, batch.truth[:, n + 1])
        errors = budget.step(errors, turn, seen, torch.cat([-batch.accel[:, n], batch.mag[:, n]], 1) - seen, k)
    tilt, _ = budget.cost(errors, seen, 0.0, 0.0)
    actual = ((batch.c_nb - batch.truth[:, -1])[:, 2] ** 2).sum(1).mean()
    assert float(actual) == pytest.approx(float(tilt), rel=0.67)


def test_the_gradient_of_the_budget_is_that_of_finite_differences(flights):
    """Of the expected error after eight samples, by every layer's weights, with the inputs of the network as given."""
    from estimators.ahrs_torch import BatchFilter, ErrorBudget, GainNetwork
    from estimators.ahrs_windows import make_batch, normalisation, prepare_flight

    cpu, kf = torch.device("cpu"), AhrsKf()
    prepared = [prepare_flight(flight, kf, 20) for flight in flights[:2]]
    torch.manual_seed(0)
    norm = {key: torch.as_tensor(v).double() for key, v in normalisation(prepared).items()}
    network = GainNetwork(2, 6, "sigmoid", **norm).double()
    torch.nn.init.normal_(network.head.weight, std=0.3)
    filter_ = BatchFilter(prepared[0].model, cpu, torch.float64)
    budget = ErrorBudget(filter_, prepared[0].model, 1e-6, (1e-4, 50.0))

    def loss():
        batch, memory = make_batch([(p, 200) for p in prepared], 8, cpu, torch.float64), network.start(2)
        errors, total = budget.start(batch), 0.0
        for n in range(8):
            z, k, turn = filter_.before(batch, n)
            change, memory = network(filter_.inputs(z, k, batch.bias, batch.disturbance), memory)
            filter_.after(batch, z, k)  # the KF's own gain: the inputs do not depend on the weights
            seen = filter_.seen(batch, batch.truth[:, n + 1])
            beyond = torch.cat([-batch.accel[:, n], batch.mag[:, n]], 1) - seen
            errors = budget.step(errors, turn, seen, beyond, k + change)
            total = total + budget.cost(errors, seen, 0.05, 30.0)[1]
        return total

    loss().backward()
    for parameter in (network.head.bias, network.lstm[0].weight_hh, network.input.weight):
        direction = torch.sign(parameter.grad)
        slope, step = float((parameter.grad * direction).sum()), 1e-5
        with torch.no_grad():
            parameter += step * direction
            above = float(loss())
            parameter -= 2 * step * direction
            below = float(loss())
            parameter += step * direction
        assert (above - below) / (2 * step) == pytest.approx(slope, rel=1e-3)


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
