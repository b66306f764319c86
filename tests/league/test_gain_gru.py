"""The shipped row whose gain is learned: its network against torch's, its lessons against the filter, its training twice, its row in a child."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from league.tracks import table, use
from report_studies import study
from synthetic import sensor_log, weaving_flight

from testbed.base.errors import InputError
from testbed.data.records import SensorErrors
from testbed.data.registry import make_estimator
from testbed.league import suite
from testbed.league.entry import read_entry
from testbed.league.run import Wanted, league
from testbed.physics.earth import position_difference

FOLDER = study("gain_plugin").folder()
ROUNDING = 1e-9
"""Two implementations in double precision: each sum of at most twelve products rounds by 1e-16, and a memory of 40 fixes passes
that on by factors near one; 1e-9 is far above that and far below any other function."""


@pytest.fixture(scope="module")
def gain_gru():
    return study("gain_plugin").plugin()


@pytest.fixture(scope="module")
def gain_filter():
    pytest.importorskip("torch")
    return study("gain_filter")


def weights_of(gain_gru, seed=3):
    """Weights of which none is zero, with outputs that pass their bounds."""
    rng = np.random.default_rng(seed)
    size = {"weight_out": 3.0}
    return {
        name: size.get(name, 0.5) * rng.standard_normal(shape).astype(np.float32)
        for name, shape in gain_gru.SHAPES.items()
    }


def test_the_policy_is_the_network_that_torch_has(gain_gru, gain_filter):
    """Forty fixes of every size, of which some are far off, so that all bounds are met."""
    import torch

    rng, weights = np.random.default_rng(1), weights_of(gain_gru)
    network = gain_filter.GainNetworks([1]).take({name: array[None] for name, array in weights.items()})
    memory, state = gain_gru.memory_of(weights), torch.zeros(1, 3, 12, dtype=torch.float64)
    factors = []
    for _ in range(40):
        r = rng.uniform(0.01, 4.0, 6)
        root = rng.standard_normal((6, 6))
        s = root @ root.T * 10.0 ** rng.uniform(-3.0, 1.0) + np.diag(r)
        residual = rng.standard_normal(6) * np.sqrt(np.diag(s)) * 10.0 ** rng.uniform(-1.0, 3.0)
        scaled = r.copy()
        fading = gain_gru.judge(memory, residual, s, scaled, np.zeros((6, 15)), np.zeros((15, 15)))
        with torch.no_grad():
            given = (torch.as_tensor(x)[None] for x in (residual, np.diag(s).copy(), r))
            factor, expected, state = network.judge(*given, state)
        np.testing.assert_allclose(scaled / r, factor[0].numpy(), rtol=ROUNDING)
        assert fading == pytest.approx(float(expected[0]), rel=ROUNDING)
        factors.append(scaled / r)
    lowest, highest = (np.isclose(factors, np.exp(bound)) for bound in (gain_gru.LOWEST, gain_gru.HIGHEST))
    assert lowest.any() and highest.any() and not (lowest | highest).all()


def made(duration=40.0):
    """A weaving flight at 100 Hz with fixes at 5 Hz and a small error at the start, and the errors that its log was made with."""
    truth = weaving_flight(duration, speed=60.0, bank=0.5)
    log = sensor_log(truth, 2, std=(3.0, 0.3, 0.005), gnss_rate=5.0, position_sigma=2.0, velocity_sigma=0.1)
    zero = np.zeros((len(log.imu.t), 3))
    return truth, log, SensorErrors(log.imu.t, zero, zero)


def test_a_lesson_is_what_the_filter_meets(gain_filter):
    """Errors and sigmas of `indirect-kf` by its own strapdown, and by the lesson's matrices, after each fix.

    What a lesson leaves out is of second order: 0.005 rad times the 5 m/s by which the start and the fixes move the velocity is
    some hundredths of the errors, and a hundredth of a sigma.
    """
    truth, log, errors = made()
    batch = gain_filter.batch_of([study("gain_lessons").lesson(truth, log, errors)])
    after = []

    def noted(*given):
        after.append(gain_filter.plain(*given))
        return after[-1]

    gain_filter.follow(batch, noted)
    e, sigma = (
        np.array(x) for x in zip(*((e[0].numpy(), p[0].diagonal().sqrt().numpy()) for e, p, _ in after), strict=True)
    )
    solution = make_estimator("indirect-kf").run(log)
    rows = np.arange(19, len(log.imu.t), 20)  # samples at whose ends the fixes are
    known = solution.lat[rows], solution.lon[rows], solution.h[rows]
    place = np.column_stack(position_difference(*known, truth.lat[rows + 1], truth.lon[rows + 1], truth.h[rows + 1]))
    velocity = solution.v_n[rows] - truth.v_n[rows + 1]
    for ours, theirs in ((e[:, :3], place), (e[:, 3:6], velocity)):
        assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.05 * np.sqrt(np.mean(theirs**2))
    np.testing.assert_allclose(sigma[:, :9], solution.std[rows][:, :9], rtol=0.02)


def test_the_unit_is_that_of_torch(gain_gru, gain_filter):
    import torch

    weights, rng = weights_of(gain_gru), np.random.default_rng(2)
    networks = gain_filter.GainNetworks([1]).take({name: array[None] for name, array in weights.items()})
    unit = torch.nn.GRUCell(gain_gru.INPUTS, gain_gru.HIDDEN, dtype=torch.float64)
    unit.load_state_dict({name: torch.as_tensor(weights[name]) for name in unit.state_dict()})
    x, memory = (torch.as_tensor(rng.standard_normal((6, n))) for n in (gain_gru.INPUTS, gain_gru.HIDDEN))
    with torch.no_grad():
        np.testing.assert_allclose(networks.recur(x[None], memory[None])[0], unit(x, memory), rtol=ROUNDING)


def test_training_is_the_same_twice_and_lowers_the_loss(gain_filter):
    """Fixes that are three times as bad as stated: there is something to learn within two passes of a few seconds."""
    training = study("gain_training")
    truth, log, errors = made(12.0)
    worse = replace(log.gnss, std=log.gnss.measurement_std() / 3.0)
    lesson = study("gain_lessons").lesson(truth, replace(log, aiding={"gnss": worse}), errors)
    batch = gain_filter.batch_of([lesson, lesson])
    settings = training.Settings(epochs=3, batch=1, window=20, rate=0.03)
    (first, other), (second, _) = (training.train((1, 2), batch, batch, settings, lambda _text: None) for _ in range(2))
    (alone,) = training.train((1,), batch, batch, settings, lambda _text: None)
    assert first.loss == second.loss < training.untrained_loss(batch)
    assert alone.loss == pytest.approx(first.loss, rel=1e-9), "networks share passes and nothing else"
    assert all(np.array_equal(first.weights[name], second.weights[name]) for name in first.weights)
    assert first.loss != other.loss and not first.failed(training.untrained_loss(batch))
    assert first.failed(first.loss - 1.0) and replace(first, finite=False).failed(np.inf)


def test_a_gate_in_a_lesson_is_the_gate_of_the_filter(gain_filter):
    """A fix that is 30 m off is refused by both: the errors stay what they are without it."""
    truth, log, errors = made(12.0)
    lesson = study("gain_lessons").lesson(truth, log, errors)
    wrong, none = lesson.fix.copy(), lesson.r.copy()
    wrong[40] += 30.0
    none[40] = 1e12
    classical = gain_filter.Classical(1.0, 1.0, 1.0, 16.27)
    with_it, without = (
        gain_filter.follow(gain_filter.batch_of([changed]), classical.fix)
        for changed in (lesson._replace(fix=wrong), lesson._replace(r=none))
    )
    np.testing.assert_allclose(with_it.e.numpy(), without.e.numpy(), atol=1e-9)


def test_its_file_holds_five_networks_and_says_so(gain_gru, tmp_path):
    memories = [gain_gru.start(6, network) for network in range(1, 6)]
    assert all(np.isfinite(memory).all() and len(memory) == gain_gru.STATES + 36 for memory in memories)
    assert len({memory.tobytes() for memory in memories}) == 5
    for network, told in ((0, "from 1 to 5"), (6, "from 1 to 5"), (True, "from 1 to 5"), (1.5, "from 1 to 5")):
        with pytest.raises(InputError, match=told):
            gain_gru.GainGru(network).filter  # noqa: B018
    with pytest.raises(InputError, match="not 3"):
        gain_gru.start(3)
    (tmp_path / "cut.safetensors").write_bytes(gain_gru.WEIGHTS.read_bytes()[:-8])
    with pytest.raises(InputError, match="not the weights of gain-gru"):
        gain_gru.start(6, file=str(tmp_path / "cut.safetensors"))


def test_the_row_runs_in_the_leagues_child(tmp_path, monkeypatch):
    """On a car that rolls north with an ideal receiver: however fixes without error are weighed, the filter leaves its start, 5 m off
    on each axis, behind; a free INS of this unit (0.5 deg/s of turn-on bias) is off by hundreds of metres within the minute."""
    entry = read_entry(FOLDER)
    told = tomllib.loads((FOLDER / "entry.toml").read_text())
    assert told["division"] == "open" and told["plugin"]["params"] == {"network": 1}
    use(monkeypatch, tmp_path, seeds=2)
    monkeypatch.setitem(suite.REFERENCE, "position", "indirect-kf")  # which its child knows
    league(Wanted([FOLDER], development=True), tmp_path / "out")
    found = table(tmp_path / "out", "open")[entry.name]
    assert found["error"] < 5.0 and found["lost"] == 0 and found["nees"]


def test_the_tuned_row_beside_it_has_the_numbers_of_the_report():
    """``tuned.csv`` and the row, as the study makes the filter of the first."""
    module = study("gain_network")
    made = module.filters(module.tuned(FOLDER.parents[2] / "reports" / "gain-network"), FOLDER / "none", ())
    told = tomllib.loads((FOLDER.parent / "eskf-tuned" / "entry.toml").read_text())["eskf"]
    own, wanted = make_estimator("eskf", **told), made[module.CLASSICAL]
    assert own.std_scale == wanted.std_scale and own.noise_scale == wanted.noise_scale
    assert tuple(own.aiding) == tuple(wanted.aiding) and set(own.states) == set(wanted.states)
    assert own.policy == wanted.policy
