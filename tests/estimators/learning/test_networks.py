"""Networks: gradients, Levenberg-Marquardt against scipy, Narendra's plant to the noise floor, closed loop, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.learning.networks import mlp_kernels
from estimators.learning.networks.levenberg_marquardt import Training, train
from estimators.learning.networks.mlp import load_networks, new_mlp, save_networks
from estimators.learning.networks.narx import Narx, lagged, train_narx
from testbed.base.errors import InputError

NOISE = 0.05


def surface(samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (samples, 2)) * [2.0, 50.0]
    return x, np.sin(2.0 * x[:, 0]) + 1e-3 * x[:, 1] ** 2 + NOISE * rng.standard_normal(samples)


def narendra(samples: int, seed: int, noise: float, drive=None) -> tuple[np.ndarray, np.ndarray]:
    """Narendra & Parthasarathy (1990), IEEE Trans. NN 1(1), example 2, with process noise: u (N,) and y (N,)."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, samples) if drive is None else drive(np.arange(samples))
    y = np.zeros(samples)
    for k in range(1, samples - 1):
        a, b = y[k], y[k - 1]
        y[k + 1] = a * b * (a + 2.5) / (1.0 + a * a + b * b) + u[k] + noise * rng.standard_normal()
    return u[:-1], y[1:]  # y(t) then depends on y(t-1), y(t-2) and u(t)


def test_gradient_is_the_numerical_derivative():
    """Central differences of step 1e-6 are right to 1e-12 plus rounding 1e-16/1e-6 = 1e-10."""
    x, y = surface(40)
    net = new_mlp(x, y, neurons=5, seed=3)
    row = np.empty(len(net.weights))
    for sample in net.normalise_inputs(x)[:10]:
        output = mlp_kernels.gradient_row(net.weights, 5, sample, row)
        assert output == mlp_kernels.evaluate(net.weights, 5, sample)
        for i in range(len(net.weights)):
            step = np.zeros(len(net.weights))
            step[i] = 1e-6
            rise = mlp_kernels.evaluate(net.weights + step, 5, sample) - mlp_kernels.evaluate(
                net.weights - step, 5, sample
            )
            assert row[i] == pytest.approx(rise / 2e-6, abs=1e-8)


def test_normal_equations_are_those_of_the_jacobian():
    x, y = surface(43)  # no multiple of the block of four
    net = new_mlp(x, y, neurons=4, seed=0)
    inputs, targets = net.normalise_inputs(x), net.normalise_outputs(y)
    size = len(net.weights)
    jacobian = np.empty((43, size))
    residual = np.array([mlp_kernels.gradient_row(net.weights, 4, inputs[k], jacobian[k]) for k in range(43)]) - targets
    gram, gradient = np.empty((size, size)), np.empty(size)
    total = mlp_kernels.normal_equations(net.weights, 4, inputs, targets, gram, gradient, np.empty((4, size)))
    assert total == pytest.approx(residual @ residual, rel=1e-12)
    np.testing.assert_allclose(gradient, jacobian.T @ residual, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.tril(gram), np.tril(jacobian.T @ jacobian), rtol=1e-9, atol=1e-12)
    solution = np.empty(size)
    assert mlp_kernels.solve_damped(gram, 0.1, gradient, np.zeros((size, size)), solution)
    full = jacobian.T @ jacobian + 0.1 * np.eye(size)
    np.testing.assert_allclose(full @ solution, gradient, rtol=1e-8, atol=1e-10)


def test_training_reaches_what_scipy_reaches():
    """Both end in a local minimum; over five starts the better of each must agree within 5 %."""
    x, y = surface(400)
    ours, theirs = [], []
    for seed in range(5):
        ours.append(train(x, y, 6, seed, Training(epochs=300, validation_share=0.0)).training_rmse)
        net = new_mlp(x, y, 6, seed)
        inputs, targets = net.normalise_inputs(x), net.normalise_outputs(y)

        def residual(weights, inputs=inputs, targets=targets):
            return mlp_kernels.evaluate_all(weights, 6, inputs) - targets

        def jacobian(weights, inputs=inputs):
            rows = np.empty((len(inputs), len(weights)))
            for sample, row in zip(inputs, rows, strict=True):
                mlp_kernels.gradient_row(weights, 6, sample, row)
            return rows

        fit = least_squares(residual, net.weights, jacobian, method="lm", max_nfev=300)
        theirs.append(float(np.sqrt(np.mean(fit.fun**2)) * net.output_scaling[1]))
    assert min(ours) == pytest.approx(min(theirs), rel=0.05)


def test_narendras_plant_to_the_noise_floor():
    """One-step error on unseen data is the process noise: its RMS over 2000 samples is known to 3/√4000 = 5 %, the fit of
    some 50 weights to 1700 rows adds 1.5 %, and the network's own shape error gets as much again.
    """
    train_data, test_data = narendra(2002, 1, NOISE), narendra(2003, 2, NOISE)
    narx, result = train_narx([train_data], output_lags=2, input_lags=0, neurons=15, seed=0)
    error = narx.open_loop(*test_data) - test_data[1][narx.lead :]
    assert np.sqrt(np.mean(error**2)) < 1.10 * NOISE
    assert result.validation_rmse < 1.2 * NOISE
    missing, _ = train_narx([train_data], output_lags=1, input_lags=0, neurons=15, seed=0)
    worse = missing.open_loop(*test_data) - test_data[1][missing.lead :]
    assert np.sqrt(np.mean(worse**2)) > 2.0 * NOISE, "without y(t-2) the floor cannot be reached"


def test_closed_loop_follows_the_plant_on_unseen_data():
    """Narendra's own test input sin(2 pi k/25): the model on its own outputs stays with the plant; the guard sleeps."""
    narx, _ = train_narx([narendra(3002, 5, 0.0)], output_lags=2, input_lags=0, neurons=20, seed=1)
    u, y = narendra(502, 0, 0.0, drive=lambda k: np.sin(2.0 * np.pi * k / 25.0))
    out, clipped = narx.closed_loop(u[2:], y[:2])
    assert clipped == 0
    assert np.sqrt(np.mean((out - y[2:]) ** 2)) < 0.1 * y.std()


def test_closed_loop_equals_open_loop_step_by_step():
    """Each closed-loop output is the open-loop prediction from the closed loop's own past, with lagged inputs."""
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal((60, 2)), rng.standard_normal(60)
    narx, _ = train_narx([(u, y)], output_lags=3, input_lags=2, neurons=4, how=Training(epochs=3), guard=50.0)
    out, _ = narx.closed_loop(u[8:], y[7:10])
    past = np.concatenate([y[:10], out])
    x, _ = lagged(u, past, 3, 2)
    np.testing.assert_allclose(narx.network.predict(x)[10 - narx.lead :], out, rtol=1e-12, atol=1e-12)


def test_guard_bounds_an_unstable_loop_and_counts():
    """y(t) = 1.3 y(t-1) leaves every bound; the guard holds it at its factor times the range seen in training."""
    y = np.linspace(-1.0, 1.0, 200)
    narx, _ = train_narx([(np.zeros(200), y)], output_lags=1, input_lags=0, neurons=3, seed=0)
    net = narx.network
    linear = np.zeros_like(net.weights)
    linear[0], linear[9], linear[10], linear[11], linear[12] = 1e-3, 1.3e3, 0.0, 0.0, 0.0
    unstable = Narx(replace(net, weights=linear), 1, 0, guard=2.0)
    out, clipped = unstable.closed_loop(np.zeros(100), np.array([0.5]))
    centre, span = net.output_scaling
    assert np.all(np.abs(out - centre) <= 2.0 * span * (1.0 + 1e-12))
    assert 80 < clipped < 100


def test_lags_do_not_cross_sequences():
    first, second = (np.arange(5.0), 10.0 + np.arange(5.0)), (np.arange(4.0), 100.0 + np.arange(4.0))
    x, target = lagged(*first, 2, 1)
    assert x.tolist()[0] == [11.0, 10.0, 2.0, 1.0] and target[0] == 12.0
    narx, _ = train_narx([first, second], 2, 1, neurons=2, how=Training(epochs=0))
    assert narx.network.output_scaling.tolist() == [57.5, 45.5]  # targets 12..14 and 102..103


def test_same_seed_same_network_other_seed_another():
    x, y = surface(200)
    one, again, other = (train(x, y, 5, seed, Training(epochs=20)).network.weights for seed in (7, 7, 8))
    assert np.array_equal(one, again) and not np.array_equal(one, other)
    np.random.seed(1)  # noqa: NPY002
    assert np.array_equal(one, train(x, y, 5, 7, Training(epochs=20)).network.weights), "global state has no say"


def test_early_stopping_beats_training_to_the_end_on_noisy_data():
    """80 rows with noise as large as the signal, 61 weights: run to the end the network learns the noise."""
    rng = np.random.default_rng(1)
    x, y = surface(80, seed=1)
    y = y + 0.7 * rng.standard_normal(80)
    unseen_x, unseen_y = surface(2000, seed=2)

    def unseen_error(how: Training) -> float:
        errors = [np.mean((train(x, y, 15, seed, how).network.predict(unseen_x) - unseen_y) ** 2) for seed in range(9)]
        return float(np.median(errors))

    assert unseen_error(Training(validation_share=0.3)) < 0.5 * unseen_error(Training(epochs=500, validation_share=0.0))


def test_training_further_keeps_the_normalisation_and_does_not_get_worse():
    x, y = surface(300)
    first = train(x, y, 6, 0, Training(epochs=3, validation_share=0.0))
    second = train(0.5 * x, y, 6, 0, Training(epochs=1), start=first.network)
    assert np.array_equal(first.network.input_span, second.network.input_span)
    further = train(x, y, how=Training(epochs=30, validation_share=0.0), start=first.network)
    assert further.training_rmse < first.training_rmse


def test_decay_keeps_the_weights_small():
    x, y = surface(100)
    free, held = (train(x, y, 10, 0, Training(validation_share=0.0, decay=decay)).network for decay in (0.0, 0.1))
    assert np.linalg.norm(held.weights) < 0.5 * np.linalg.norm(free.weights)


def test_networks_survive_a_file(tmp_path):
    x, y = surface(100)
    net = train(x, y, 5).network
    save_networks(tmp_path / "n.safetensors", {"lat": net, "lon": new_mlp(x, y, 3, 1)}, {"inputs": "nn3"})
    back, meta = load_networks(tmp_path / "n.safetensors")
    assert meta == {"inputs": "nn3"} and set(back) == {"lat", "lon"}
    assert np.array_equal(back["lat"].predict(x), net.predict(x))
    narx, _ = train_narx([(x, y)], 2, 1, neurons=3, how=Training(epochs=2), guard=3.0)
    narx.save(tmp_path / "narx.safetensors")
    again = Narx.load(tmp_path / "narx.safetensors")
    assert again.guard == 3.0 and np.array_equal(again.open_loop(x, y), narx.open_loop(x, y))


def test_bad_input_is_refused(tmp_path):
    x, y = surface(50)
    with pytest.raises(InputError, match="finite"):
        train(x, np.where(np.arange(50) == 3, np.nan, y))
    with pytest.raises(InputError, match="patience"):
        Training(patience=0)
    (tmp_path / "x.safetensors").write_bytes(b"not a network")
    with pytest.raises(InputError, match="not a network file"):
        load_networks(tmp_path / "x.safetensors")
    with pytest.raises(InputError, match="no such file"):
        load_networks(tmp_path / "missing.safetensors")
