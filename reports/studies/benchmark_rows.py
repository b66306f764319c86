"""Which benchmark stands for which hot path, what it is measured against, and the papers' own computation times."""

from __future__ import annotations

from dataclasses import dataclass, field

TRIPLE = "triple product 15 x 15"


@dataclass(frozen=True)
class Row:
    """A hot path: its benchmark, the unit of its cost, the benchmark of its arithmetic (taken ``times``), its peers."""

    label: str
    name: str
    unit: str = "samples"
    what: str = ""
    floor: str = ""
    times: int = 1
    peers: dict[str, str] = field(default_factory=dict)


def _direct(name: str, branches: int = 1) -> Row:
    what = TRIPLE if branches == 1 else f"{branches} {TRIPLE.replace('product', 'products')}"
    return Row(
        f"`{name}`", f"test_bench_direct_filter[{name}]", "samples", what, "test_bench_direct_triple_product", branches
    )


def _side_by_side(name: str) -> Row:
    """Of eight runs; beside the filter's own single run on the same flight."""
    return Row(
        f"`{name}`, eight runs side by side in vector lanes",
        f"test_bench_side_by_side_runs[{name}]",
        "samples",
        "its own single run",
        f"test_bench_direct_filter[{name}]",
    )


def _narx(name: str, below: str) -> Row:
    return Row(
        f"`{name}`, learning on line",
        f"test_bench_narx[{name}]",
        "samples",
        f"`{below}` below it",
        f"test_bench_narx[{below}]",
    )


def _flight(name: str) -> Row:
    return Row(f"flying the `{name}`", f"test_fly[{name}]", "steps", "bare `fdm.run()`", f"test_bare_jsbsim[{name}]")


def _sense(model: str) -> Row:
    return Row(
        f"sensing, {model} at 200 Hz", f"test_imu[{model}]", "flight_s", "six normals per sample", "test_numpy_normals"
    )


def _outage(name: str) -> Row:
    return Row(
        f"`{name}`", f"test_whole_log[{name}]", "samples", "triple product 9 x 9", "test_whole_log_triple_product"
    )


ROWS = (
    Row(
        "`ins` (strapdown)",
        "test_bench_strapdown",
        what="2 rotation vectors, 2 quaternion products, vector rotated, sine, cosine, root",
        floor="test_bench_strapdown_arithmetic",
        peers={
            "python-ins": "test_bench_strapdown_python_ins",
            "plain Python and numpy": "test_bench_strapdown_plain_python",
        },
    ),
    Row(
        "`indirect-kf`",
        "test_bench_indirect_kf",
        what=TRIPLE,
        floor="test_bench_triple_product",
        peers={"python-ins, covariance at 10 Hz": "test_bench_python_ins"},
    ),
    Row(
        "`eskf`, 21 states and a barometer's bias, height at 10 Hz",
        "test_bench_composed[21]",
        what=TRIPLE,
        floor="test_bench_triple_product",
    ),
    Row("`eskf`, 42 states", "test_bench_composed[42]", what=TRIPLE, floor="test_bench_triple_product"),
    Row(
        "`indirect-kf` in a search, scored", "test_bench_filter_search", what=TRIPLE, floor="test_bench_triple_product"
    ),
    _direct("direct-ekf"),
    _direct("stekf"),
    _direct("rstekf"),
    _direct("imm-ekf", 3),
    _direct("imm-rstekf", 3),
    Row(
        "`direct-ukf`",
        "test_bench_direct_filter[direct-ukf]",
        what="Cholesky, 30 sigma points, strapdown arithmetic of each, their products",
        floor="test_bench_sigma_points",
        peers={"filterpy UKF, compiled model": "test_bench_filterpy_ukf"},
    ),
    Row(
        "`indirect-kf` at 100 Hz",
        "test_bench_direct_filter[indirect-kf]",
        "samples",
        TRIPLE,
        "test_bench_direct_triple_product",
        peers={
            "INSLIB (C, through its Python binding, own process)": "test_bench_inslib",
            "sidereon EKF (Rust, through its Python binding)": "test_bench_sidereon",
        },
    ),
    *(_side_by_side(name) for name in ("indirect-kf", "direct-ekf", "direct-ukf", "imm-rstekf")),
    _outage("lkf9"),
    _outage("ann"),
    _outage("kfann"),
    _narx("nnckf-ekf", "direct-ekf"),
    _narx("nnakf-ekf", "direct-ekf"),
    _narx("nnakf-ukf", "direct-ukf"),
    Row(
        "`ahrs-kf`",
        "test_bench_ahrs[ahrs-kf]",
        what="triple product 12 x 12",
        floor="test_bench_ahrs_triple_product",
        peers={
            f"ahrs {name}": f"test_bench_ahrs[{key}]"
            for name, key in (("Madgwick", "madgwick"), ("Mahony", "mahony"), ("EKF", "ahrs-ekf"))
        },
    ),
    Row(
        "`ahrs-eskf`",
        "test_bench_ahrs[ahrs-eskf]",
        what="triple product 12 x 12",
        floor="test_bench_ahrs_triple_product",
        peers={"VQF (C++)": "test_bench_ahrs[vqf]"},
    ),
    Row(
        "`ahrs-lstm`",
        "test_bench_ahrs[ahrs-lstm]",
        what="its matrix-vector products by BLAS",
        floor="test_bench_ahrs_matrix_vector",
    ),
    Row(
        "training, 30 epochs of Levenberg-Marquardt",
        "test_train_here",
        "calls",
        "30 x J'J and Cholesky, 111 weights",
        "test_train_normal_equations",
        peers={"scipy least_squares": "test_train_scipy"},
    ),
    _sense("ADIS16405"),
    _sense("ADIS16448"),
    Row(
        "GNSS, 24 satellites simulated",
        "test_bench_satellites",
        "epochs",
        "six normals per satellite",
        "test_bench_normals_of_an_epoch",
    ),
    Row("GNSS receiver, 12 satellites: fix, velocity, fault test", "test_bench_receiver[12]", "epochs"),
    Row(
        "`tight-kf`, 12 satellites at 5 Hz", "test_bench_tight[states]", what=TRIPLE, floor="test_bench_triple_product"
    ),
    Row(
        "`tight-kf`, slow errors as larger noise",
        "test_bench_tight[inflate]",
        what=TRIPLE,
        floor="test_bench_triple_product",
    ),
    _flight("aerosonde"),
    _flight("transport"),
    _flight("agile"),
    Row("spline truth", "test_spline_truth"),
    Row(
        "scoring",
        "test_score_15000_samples",
        what="nine columns subtracted, squared, summed",
        floor="test_subtract_and_square_15000_samples",
    ),
    Row(
        "one run of five estimators",
        "test_unit_of_the_quickstart[unit]",
        what="its estimators alone",
        floor="test_unit_of_the_quickstart[estimators]",
    ),
    Row(
        "trajectory to Parquet",
        "test_save_a_trajectory_of_15000_samples",
        what="its bytes to the disk",
        floor="test_write_the_bytes_of_15000_samples",
    ),
    Row(
        "trajectory from Parquet",
        "test_load_a_trajectory_of_15000_samples",
        what="its bytes to the disk",
        floor="test_write_the_bytes_of_15000_samples",
    ),
    Row("figures of a report", "test_report_of_the_quickstart[figures]", "calls"),
    Row("page of a report", "test_report_of_the_quickstart[html]", "calls"),
    Row("tuning objective, two filter runs of 437 s, one by one", "test_bench_one_by_one", "evaluations"),
    Row(
        "the same, candidates side by side in vector lanes",
        "test_bench_side_by_side",
        "evaluations",
        "one by one",
        "test_bench_one_by_one",
    ),
)

PAPER_TIMES = (
    ("KF", "test_bench_direct_filter[indirect-kf]", 5.283),
    ("UKF", "test_bench_direct_filter[direct-ukf]", 22.227),
    ("IMM-EKF", "test_bench_direct_filter[imm-ekf]", 10.404),
    ("IMM-RSTEKF", "test_bench_direct_filter[imm-rstekf]", 11.517),
)
"""Computation times (s) of the paper's table: MATLAB 2019b, i5-5200U at 2.2 GHz."""

TUNING_TABLE, TUNING_HOURS = 450_000, 1140
"""Evaluations and machine hours of the tuning paper's table."""
