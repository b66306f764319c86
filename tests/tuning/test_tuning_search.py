"""Search algorithms: their equations by hand, their use of evaluations, their seeds, and the functions they are measured on."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.tuning.functions import FUNCTIONS, minimise
from testbed.tuning.ga import crossover, roulette
from testbed.tuning.ipo import acceleration, ipo, mipo
from testbed.tuning.search import ALGORITHMS, Bounds, least_population, make_search
from testbed.tuning.sipo import iipo, sipo

BOX = Bounds(np.full(5, -2.0), np.full(5, 4.0))


def bowl(x):
    return ((x - 1.0) ** 2).sum(axis=1)


def course(search, evaluate=bowl):
    """All that a search asks for, and in what portions."""
    asked = []
    while not search.done:
        asked.append(search.ask())
        search.tell(evaluate(asked[-1]))
    return asked


@pytest.mark.parametrize("name", ALGORITHMS)
def test_budget_box_and_seed(name):
    """Each uses population x iterations evaluations, all in the box; the seed alone decides where."""
    runs = [course(make_search(name, BOX, 8, 6, seed)) for seed in (3, 3, 4)]
    first, again, other = (np.concatenate(run) for run in runs)
    assert len(first) == 8 * 6
    assert (first >= BOX.low).all() and (first <= BOX.high).all()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("population", [2, 3, 6, 20])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_single_coordinate_is_searched(name, population):
    """Its minimum lies outside of the box, towards which steps grow: CMA-ES then meets the limit of its step, which the package
    cannot apply to one coordinate."""
    box = Bounds(np.array([-2.0]), np.array([4.0]))
    population = max(population, least_population(name))
    for seed in range(3):
        asked = np.concatenate(course(make_search(name, box, population, 15, seed), lambda x: (x[:, 0] - 9.0) ** 2))
        assert len(asked) == 15 * population
        assert (asked >= box.low).all() and (asked <= box.high).all()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_improves_on_its_first_population(name):
    """On a bowl, 100 iterations (IPO is drawn to the best from the 80th on) must beat the first draw for three seeds."""
    for seed in range(3):
        f = [bowl(x) for x in course(make_search(name, BOX, 10, 100, seed))]
        assert min(part.min() for part in f) < f[0].min()


@pytest.mark.parametrize("name", ["sipo", "iipo"])
def test_sequential_agents_are_asked_one_by_one(name):
    sizes = [len(part) for part in course(make_search(name, BOX, 7, 4, 0))]
    assert sizes == [7] + [1] * 21


@pytest.mark.parametrize("name", ["ipo", "mipo", "ga", "pso", "cma-es", "de"])
def test_others_move_together(name):
    assert {len(part) for part in course(make_search(name, BOX, 7, 4, 0))} == {7}


class FixedDraws:
    """A generator whose every uniform number is one half."""

    def uniform(self, low, high, size):
        return np.linspace(low, high, size[0])

    def random(self, size=None):
        return 0.5 if size is None else np.full(size, 0.5)


def test_slope_angles_by_hand():
    """Agent 0 at 1 with f = 3, agent 1 at 4 with f = 7: only agent 1 accelerates, by sin(atan(-4/3)) = -4/5."""
    a = acceleration(np.array([[1.0], [4.0]]), np.array([3.0, 7.0]))
    np.testing.assert_allclose(a, [[0.0], [-0.8]], atol=1e-15)


def test_agents_at_one_place_have_no_slope():
    assert (acceleration(np.ones((3, 2)), np.array([1.0, 2.0, 3.0])) == 0.0).all()


def test_ipo_step_by_hand():
    """At t = 1 with shift1 = 1: k1 = c1/2 = 0.1 and k2 is 1.7/(1 + exp(57.67)), nothing; the worse agent of two moves."""
    box = Bounds(np.array([0.0]), np.array([6.0]))
    steps = ipo(box, 2, 2, FixedDraws())
    x = next(steps).copy()
    moved = steps.send(np.array([0.0, 6.0]))
    np.testing.assert_allclose(x, [[0.0], [6.0]])
    np.testing.assert_allclose(moved, [[0.0], [6.0 - 0.1 * 0.5 / np.sqrt(2.0)]], atol=1e-12)


def test_mipo_step_by_hand():
    """T = 2, t = 1: k1 = 0.5/2, k2 = 1.5/2; the worse agent feels the slope -1/sqrt(2) and the best at distance -6."""
    steps = mipo(Bounds(np.array([0.0]), np.array([6.0])), 2, 2, FixedDraws())
    next(steps)
    moved = steps.send(np.array([0.0, 6.0]))
    np.testing.assert_allclose(moved[1], 6.0 + 0.25 * 0.5 * -np.sqrt(0.5) + 0.75 * 0.5 * -6.0, atol=1e-12)


def test_equation_seven_as_printed_forgets_the_place():
    """The same step without x_i on the right: what is left of the worse agent is its pull; the best one falls to 0."""
    steps = mipo(Bounds(np.array([-9.0]), np.array([9.0])), 2, 2, FixedDraws(), keeps_place=False)
    x = next(steps).copy()
    moved = steps.send(np.array([0.0, 6.0]))
    slope = -np.sin(np.arctan(6.0 / 18.0))
    np.testing.assert_allclose(x, [[-9.0], [9.0]])
    np.testing.assert_allclose(moved, [[0.0], [0.25 * 0.5 * slope + 0.75 * 0.5 * -18.0]], atol=1e-12)


def test_planes_of_worse_agents_push_away():
    """Agent 0 at 1 with f = 3, agent 1 at 4 with f = 7: the better one is pushed from the worse by sin(atan(4/-3)) = -4/5."""
    a = acceleration(np.array([[1.0], [4.0]]), np.array([3.0, 7.0]), "worse")
    np.testing.assert_allclose(a, [[-0.8], [0.0]], atol=1e-15)
    with pytest.raises(InputError, match="planes = 'best': of 'better' or of 'worse'"):
        make_search("ipo", BOX, 4, 2, 0, {"planes": "best"})


@pytest.mark.parametrize(
    ("algorithm", "k2"), [(sipo, 2.0 / (1.0 + np.exp(-(1.0 - 0.1 * 10)))), (iipo, 1.75 / (1.0 + np.exp(-1.0)))]
)
def test_sipo_steps_by_hand(algorithm, k2):
    """Two agents at 1 (f = 5) and 2 (f = 9), T = 10, t = 1 (k1 = 1), the mean of the second over both; the first finds f = 7.

    The first has no better agent: m = 1, a = 10 - 1. The second then sees its new place, and the best stays at 1.
    """
    box = Bounds(np.array([1.0]), np.array([2.0]))
    wide = Bounds(np.array([-100.0]), np.array([100.0]))

    class Draws(FixedDraws):
        def uniform(self, low, high, size):
            return np.linspace(box.low, box.high, size[0])

    steps = algorithm(wide, 2, 10, Draws())
    next(steps)
    first = steps.send(np.array([5.0, 9.0])).copy()
    np.testing.assert_allclose(first, [[1.0 + 0.5 * 9.0]])
    second = steps.send(np.array([7.0])).copy()
    mean = 0.5 * (5.5 + 2.0)
    np.testing.assert_allclose(second, [[2.0 + 0.5 * (10.0 * mean - 2.0) + k2 * 0.5 * (1.0 - 2.0)]])


def test_roulette_prefers_by_rank():
    """Weights N - rank: of three, 3/6, 2/6 and 1/6 of the draws; 5 sigma of 6000 draws is below 0.033."""
    drawn = roulette(np.array([2.0, 1e9, 1.0]), 6000, np.random.default_rng(0))
    np.testing.assert_allclose(np.bincount(drawn) / 6000, [2 / 6, 1 / 6, 3 / 6], atol=0.033)


def test_crossover_keeps_every_gene():
    """Single-point crossover only exchanges: the two children together hold their parents' genes, place by place."""
    parents = np.arange(12.0).reshape(2, 6)
    children = crossover(parents, 1.0, np.random.default_rng(1))
    np.testing.assert_array_equal(np.sort(children, axis=0), parents)
    assert not np.array_equal(children, parents)


def test_genetic_algorithm_never_loses_its_best():
    seen = course(make_search("ga", BOX, 10, 40, 0))
    best = [min(bowl(x).min() for x in seen[: k + 1]) for k in range(len(seen))]
    assert best[-1] < 0.2 * best[0]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_minimum_of_each_function_is_zero(function):
    evaluate, half, place = FUNCTIONS[function]
    rng = np.random.default_rng(0)
    assert abs(evaluate(np.full((1, 18), place))[0]) < 1e-12
    assert (evaluate(rng.uniform(-half, half, (100, 18))) > 0.0).all()


def test_yardsticks_are_in_line_with_the_literature():
    """10,000 evaluations of the 18-D sphere from |x| = 100: linear convergence takes all three below 1e-2."""
    for name in ("pso", "cma-es", "de"):
        assert minimise(name, "sphere", 0) < 1e-2, name


def test_simplified_planes_depend_on_the_origin():
    """The term T/t times m_i pulls away from x = 0: with the minimum elsewhere SIPO ends at the walls, PSO does not care."""
    elsewhere = [minimise("sipo", "sphere", seed, shift=0.3, iterations=60, population=20) for seed in range(3)]
    pso = [minimise("pso", "sphere", seed, shift=0.3, iterations=60, population=20) for seed in range(3)]
    assert min(elsewhere) > 10.0 * max(pso)


def test_tell_refuses_what_is_no_value():
    search = make_search("pso", BOX, 4, 3, 0)
    for wrong in (np.array([1.0, 2.0, 3.0]), np.array([1.0, np.nan, 2.0, 3.0])):
        with pytest.raises(ValueError, match="finite value"):
            search.tell(wrong)


def test_names_and_settings_are_checked():
    with pytest.raises(InputError, match="did you mean 'sipo'"):
        make_search("sipo2", BOX, 4, 3, 0)
    with pytest.raises(InputError, match="did you mean 'inertia'"):
        make_search("pso", BOX, 4, 3, 0, {"inertja": 0.7})
    with pytest.raises(InputError, match="population"):
        make_search("pso", BOX, 1, 3, 0)
    with pytest.raises(InputError, match="by de needs a population of at least 5"):
        make_search("de", BOX, 4, 3, 0)


def test_library_is_let_go_when_a_search_ends_early():
    """scipy waits for values in a thread; closing the search ends it."""
    before = threading.active_count()
    search = make_search("de", BOX, 8, 50, 0)
    search.tell(bowl(search.ask()))
    assert threading.active_count() == before + 1
    search.close()
    deadline = time.monotonic() + 10.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before
