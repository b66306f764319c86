"""`testbed dataset` and `testbed train` on the AHRS scenario: flights, split, memory, killed calls and wrong input."""

import json
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.physics.rotations import quats_to_matrices
from testbed.scenario import load_scenario
from testbed.training.dataset import ROWS_PER_GROUP, Shard, make_dataset, open_dataset, open_split, write_shard

SHORT = {"extra.dataset.duration_s": 31.0}


def scenario(**changes):
    return load_scenario("ahrs-lstm-2022", profile="smoke", overrides=SHORT | changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_dataset(scenario(), tmp_path_factory.mktemp("data"), flights=3)


def command(*arguments, folder):
    return subprocess.run(
        [sys.executable, "-m", "testbed.cli", *arguments], cwd=folder, capture_output=True, text=True, timeout=120
    )


def test_flights_differ_and_are_split_whole(folder):
    training, validation = open_dataset(folder)
    assert [len(training), len(validation)] == [2, 1]
    manifest = json.loads((folder / "manifest.json").read_text())
    scripts = [json.dumps(entry["flight"]["manoeuvres"]) for entry in manifest["flights"]]
    assert len(set(scripts)) == 3
    assert {shard.path for shard in training}.isdisjoint({shard.path for shard in validation})


def test_a_shard_gives_the_log_and_its_truth(folder):
    """In the mean over half a minute of flight specific force opposes gravity, and the field is the one of the place."""
    shard = open_dataset(folder)[0][0]
    data, log = shard.window(0, shard.rows), shard.log()
    c_nb = quats_to_matrices(data["q_nb"].astype(float))
    force = np.einsum("nij,nj->ni", c_nb, log.imu.accel).mean(0)
    assert abs(force[2] + 9.8) < 1.5  # a change of vertical speed by 45 m/s would be needed for more
    field = np.einsum("nij,nj->ni", c_nb, log.mag.field).mean(0)
    np.testing.assert_allclose(field, log.mag.spec.field_n, atol=1.5)  # µT: hard iron of 0.5 µT (1 sigma)
    part = shard.window(777, 100)
    assert all(np.array_equal(part[key], data[key][777:877]) for key in part)


def test_an_interrupted_data_set_is_completed_with_the_same_bytes(folder, tmp_path):
    made = make_dataset(scenario(), tmp_path / "again", flights=3)
    lost = made / "flight-001.parquet"
    before = lost.read_bytes()
    lost.unlink()
    (made / "manifest.json").unlink()
    make_dataset(scenario(), made, flights=3)
    assert lost.read_bytes() == before == (folder / lost.name).read_bytes()


def test_another_scenario_does_not_write_into_the_folder(folder):
    with pytest.raises(InputError, match="another scenario"):
        make_dataset(scenario(**{"extra.dataset.seed": 5}), folder)


def test_memory_of_a_reader_does_not_grow_with_the_flight(folder, tmp_path):
    """Windows of a flight eight times as long take the memory of a row group or two, no more."""
    from testbed.data.records import ImuSamples, MagSamples, SensorLog, Trajectory

    shard = open_dataset(folder)[0][0]
    log = shard.log()
    peaks = []
    for times in (6, 48):
        n = times * shard.rows
        t = np.arange(1, n + 1) * 0.02
        imu = ImuSamples(t, np.tile(log.imu.gyro, (times, 1)), np.tile(log.imu.accel, (times, 1)), log.imu.spec)
        mag = MagSamples(t, np.tile(log.mag.field, (times, 1)), log.mag.spec)
        q = np.tile([1.0, 0.0, 0.0, 0.0], (n + 1, 1))
        zero = np.zeros((n + 1, 3))
        truth = Trajectory(np.append(0.0, t), zero[:, 0], zero[:, 0], zero[:, 0], zero, q, zero, zero)
        write_shard(tmp_path / "long.parquet", SensorLog(imu, log.initial, mag=mag), truth, {})
        long = Shard(tmp_path / "long.parquet")
        tracemalloc.start()
        for start in range(0, long.rows - 1500, 1500):
            long.window(start, 1500)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert long.rows > 10 * ROWS_PER_GROUP and peaks[1] < 1.2 * peaks[0]


def test_the_command_line_makes_a_data_set_and_trains_on_it(tmp_path):
    small = ["--profile", "smoke", "--set", "extra.dataset.duration_s=31"]
    made = command("dataset", "ahrs-lstm-2022", *small, "--flights", "2", "--out", "data", folder=tmp_path)
    assert made.returncode == 0 and "data set: data" in made.stdout, made.stderr
    trained = command(
        "train",
        "ahrs-lstm-2022",
        *small,
        "--set",
        "extra.train.epochs=1",
        "--data",
        "data",
        "--out",
        "net",
        folder=tmp_path,
    )
    assert trained.returncode == 0 and "ahrs-lstm.safetensors" in trained.stdout, trained.stderr
    assert (tmp_path / "net" / "learning-curve.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("dataset", "ahrs-lstm-2022", "--flights", "1"), "for validation"),
        (("dataset", "ahrs-lstm-2022", "--set", "extra.dataset.flihgts=2"), "flihgts"),
        (("dataset", "ahrs-lstm-2022", "--set", "extra.dataset.bank_deg=[50,15]"), "bank_deg"),
        (("train", "quickstart"), "none of its estimators"),
        (("train", "ahrs-lstm-2022", "--profile", "smoke", "--set", "extra.train.nurons=3"), "nurons"),
        (("train", "ahrs-lstm-2022", "--profile", "smoke", "--set", "extra.train.epochs=0"), "epochs"),
    ],
)
def test_wrong_input_is_told_and_ends_with_2(tmp_path, arguments, said, capsys, monkeypatch, folder):
    from testbed.cli import main

    if arguments[:2] == ("train", "ahrs-lstm-2022"):
        arguments = (*arguments, "--set", "extra.dataset.duration_s=31", "--data", str(folder))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["testbed", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert said in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(
    "content", ["", "text", "[]", "{}", '{"key": "x", "flights": [{"file": 3, "split": "train"}]}']
)
def test_a_damaged_manifest_is_refused_by_name(tmp_path, content):
    from testbed.base.errors import InputError
    from testbed.training.dataset import open_dataset

    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json: (damaged|not the manifest)"):
        open_dataset(tmp_path)


UAV = {
    "extra.dataset": {"duration_s": 31.0, "test": 1, "manoeuvre_s": [5.0, 10.0]},
    "sensors.mag": {"model": "ADIS16448", "rate_hz": 10.0},
    "sensors.baro": {"model": "ADIS16448", "rate_hz": 25.0},
    "sensors.gnss.outages": [],
}
"""The quickstart's aircraft with sensors of other rates than its IMU, 100 Hz."""


@pytest.fixture(scope="module")
def uav(tmp_path_factory):
    """Four flights: two to train on, one for validation, one that no training sees."""
    return make_dataset(load_scenario("quickstart", overrides=UAV), tmp_path_factory.mktemp("uav"), flights=4)


def test_a_split_is_by_flight_and_test_flights_are_in_no_other(uav):
    splits = {name: {shard.path.name for shard in open_split(uav, name)} for name in ("train", "validation", "test")}
    assert [len(files) for files in splits.values()] == [2, 1, 1]
    assert len(set.union(*splits.values())) == 4
    assert {shard.path.name for part in open_dataset(uav) for shard in part}.isdisjoint(splits["test"])
    with pytest.raises(InputError, match="did you mean 'test'"):
        open_split(uav, "tests")


def test_labels_fit_the_motion_and_the_samples(uav):
    """Position is the integral of velocity: by trapezoids at 100 Hz off by dt²/12 times the change of acceleration, 1e-4 m.

    Gyros at one time are true rate plus bias plus noise, so over 31 s their mean differs from that of the biases by the mean turn
    rate, which the attitude labels give.
    """
    shard = open_split(uav, "train")[0]
    data = shard.window(0, shard.rows)
    step = 0.5 * (data["v_n"][1:].astype(float) + data["v_n"][:-1]) * 0.01
    travelled = data["position"][-1].astype(float) - data["position"][0]
    np.testing.assert_allclose(
        step.sum(axis=0), travelled, atol=0.05
    )  # a curved Earth: 1 km² / 12,700 km = 0.08 m at most
    assert (
        np.ptp(data["gyro_bias"], axis=0).max() < 0.01 < np.abs(data["gyro_bias"]).max()
    )  # rad/s: turn-on, hardly moving


def test_sensors_of_other_rates_stand_in_the_rows_of_their_times(uav):
    """5 Hz, 10 Hz and 25 Hz on rows at 100 Hz: a sample in each 20th, 10th and 4th row, and none between."""
    shard = open_split(uav, "validation")[0]
    data = shard.window(0, shard.rows)
    for name, every in (("gnss", 20), ("mag", 10), ("baro", 4)):
        rows = np.flatnonzero(np.isfinite(data[name]).all(axis=1))
        assert set(np.diff(rows)) == {every} and np.isnan(np.delete(data[name], rows, axis=0)).all()
    fixes = np.isfinite(data["gnss"][:, 0])
    off = data["gnss"][fixes, :3] - data["position"][fixes]
    sigma = shard.log().gnss.spec.horizontal_sigma
    assert abs(off[:, :2].std() / sigma - 1.0) < 0.25  # of 300 values: 4 sigma of a standard deviation are 0.16


def test_a_shard_runs_through_a_filter(uav):
    from testbed.data.registry import make_estimator

    shard = open_split(uav, "test")[0]
    solution = make_estimator("indirect-kf").run(shard.log())
    truth = shard.window(shard.rows - 1, 1)["v_n"][0]
    assert np.abs(solution.v_n[-1] - truth).max() < 1.0  # m/s: the receiver's velocity is good to 0.05


def test_windows_feed_a_network_of_torch(uav):
    torch = pytest.importorskip("torch")
    from testbed.training.windows import torch_windows

    data = torch_windows(uav, "train", length=200, stride=100, inputs=("gyro", "accel", "gnss"), labels=("v_n", "q_nb"))
    assert isinstance(data, torch.utils.data.Dataset)
    x, y = next(iter(torch.utils.data.DataLoader(data, batch_size=4, shuffle=False)))
    assert x.shape == (4, 200, 12) and y.shape == (4, 200, 7) and x.dtype == torch.float32
    first = data.shards[0].window(100, 200)
    np.testing.assert_array_equal(x[1, :, :3], first["gyro"])
    count = sum((shard.rows - 200) // 100 + 1 for shard in data.shards)
    assert len(data) == count
    last = data[len(data) - 1][1]
    np.testing.assert_array_equal(
        last[:, 3:], data.shards[1].window(((data.shards[1].rows - 200) // 100) * 100, 200)["q_nb"]
    )
    with pytest.raises(InputError, match="has no column group 'lidar'"):
        torch_windows(uav, "train", inputs=("lidar",))
