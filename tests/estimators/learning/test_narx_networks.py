"""The six networks of a drift: what they learn, what stops their training, what holds them, and that they keep on disk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.learning.narx_networks import Drift, DriftNetworks, Structure, select_inputs
from estimators.learning.networks.levenberg_marquardt import Training, rows_held_back
from estimators.learning.networks.narx import train_narx


def synthetic_drifts(count, seed, noise=0.0):
    """Drifts that do have a cause: velocity error grows with the bank angle, position with velocity."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        t = np.arange(61.0)
        states = rng.normal(size=(61, 15))
        states[:, 6] = 0.7 * np.sin(2 * np.pi * t / rng.uniform(20, 60) + rng.uniform(0, 6))
        velocity = np.concatenate([[0.0], np.cumsum(0.05 * states[1:, 6])])
        position = np.concatenate([[0.0], np.cumsum(velocity[1:])])
        y = np.column_stack([position, -position, 0.5 * position, velocity, -velocity, 0.5 * velocity])
        out.append(Drift.of(t, states, y + noise * rng.normal(size=y.shape), np.ones((61, 6))))
    return out


def test_networks_learn_a_drift_that_has_a_cause():
    """The scheme works where the inputs hold the answer: of the velocity error of an unseen drift 90 % are foretold.

    MRMR must find the cause among the ten candidates, of which nine are noise or say nothing of the sign.
    """
    lessons, unseen = synthetic_drifts(20, 0), synthetic_drifts(10, 1)
    inputs = select_inputs(lessons, 2)
    assert all("roll" in names for names in inputs[3:])
    structure = Structure((("roll",),) * 6, ((2, 1),) * 6, neurons=3)
    networks = DriftNetworks(structure).train(lessons, Training(epochs=200)).with_statistics(unseen)
    size = np.sqrt(np.mean([d.y[1:, 3:] ** 2 for d in unseen], axis=(0, 1)))
    assert (networks.std[3:] < 0.1 * size).all()


def test_windows_learnt_by_heart_are_seen_in_whole_windows_alone():
    """Lines through zero without a cause, slopes 1 and -1 in turn, and an input that tells which of 8 windows it is.

    Rows of the windows trained on are foretold from it. Of a window that was not shown its neighbours foretell the opposite, so
    that half the size of a line, 0.5 of the time's RMS of 0.58, is left at least.
    """
    t = np.linspace(0.0, 1.0, 60)
    sequences = [(np.column_stack([np.full(60, -1.0 + 2.0 * k / 7.0), t]), (-1.0) ** k * t) for k in range(8)]
    errors = {}
    for whole in (False, True):
        how = Training(epochs=300, patience=300, validation_share=0.25, whole_groups=whole)
        errors[whole] = train_narx(sequences, 0, 0, 30, 1, how)[1].validation_rmse
    assert errors[False] < 0.01 < 0.5 * 0.58 < errors[True]


def test_rows_held_back_are_whole_groups():
    groups = np.repeat(np.arange(16), 60)
    mask = rows_held_back(960, 1, Training(whole_groups=True), groups)
    shares = mask.reshape(16, 60).mean(axis=1)
    assert sorted(shares) == [0.0] * 14 + [1.0] * 2  # 15 % of 16
    assert rows_held_back(120, 1, Training(whole_groups=True), np.repeat([0, 1], 60)).sum() == 60
    one = np.zeros(60, dtype=int)
    for how in (Training(whole_groups=True), Training()):  # one group alone: its rows, as without groups
        assert rows_held_back(60, 1, how, one).sum() == 9
    assert not rows_held_back(960, 1, Training(whole_groups=True, validation_share=0.0), groups).any()


def test_a_wild_network_is_held_and_counted():
    """Weights a hundred times too large: outputs stay within twice the range of the targets, and each hit is counted."""
    lessons = synthetic_drifts(5, 0)
    networks = DriftNetworks(Structure((("roll",),) * 6, ((1, 1),) * 6, 3)).train(lessons, Training(epochs=3))
    wild = replace(
        networks,
        networks=tuple(
            replace(n, network=replace(n.network, weights=100.0 * n.network.weights)) for n in networks.networks
        ),
    )
    out, limited = wild.closed_loop(lessons[0])
    y = np.vstack([d.y for d in lessons])
    limit = 0.5 * (y.max(axis=0) + y.min(axis=0)) + 2.0 * 0.5 * np.ptp(y, axis=0)
    assert limited > 50 and (out <= limit + 1e-9).all()


def test_weights_survive_the_disk(tmp_path):
    lessons = synthetic_drifts(4, 0, 0.1)
    networks = (
        DriftNetworks(Structure((("roll", "t"),) * 6, ((2, 1),) * 6, 3))
        .train(lessons, Training(epochs=3))
        .with_statistics(lessons)
    )
    networks.save(tmp_path / "n.safetensors", {"training": "x"})
    again, meta = DriftNetworks.load(tmp_path / "n.safetensors")
    assert meta["training"] == "x" and again.growth == networks.growth
    np.testing.assert_array_equal(again.closed_loop(lessons[0])[0], networks.closed_loop(lessons[0])[0])
