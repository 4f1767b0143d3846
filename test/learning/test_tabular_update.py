"""One tabular update and one choice, by hand and on processes whose Q* is known."""

import numpy as np
import pytest
from numba import njit

from tractor_ems.learning.tabular_kernel import (
    Place,
    best_action,
    largest,
    place_of,
    read_row,
    td_update,
    value_of,
)
from tractor_ems.learning.tabular_pairs import Grid

TABLES = pytest.mark.parametrize("count", [1, 2], ids=["q", "double_q"])


def at(row: int) -> Place:
    return Place(row, row, 0.0)


def update(tables, here, action, reward, following, first, last, gamma, alpha, seed=0):
    rng, scratch = np.random.default_rng(seed), np.empty(tables.shape[2], dtype=np.float32)
    td_update(tables, here, action, reward, following, first, last, gamma, alpha, scratch, rng)


# ---- by hand


def test_a_single_table_learns_from_its_own_maximum():
    tables = np.array([[[0.5, 0.0, 0.0], [1.0, 4.0, 3.0]]], dtype=np.float32)
    update(tables, at(0), 0, -2.0, at(1), 0, 2, 0.5, 0.1)
    assert tables[0, 0, 0] == pytest.approx(0.5 + 0.1 * (-2.0 + 0.5 * 4.0 - 0.5))
    np.testing.assert_array_equal(tables[0, 1], [1.0, 4.0, 3.0])


def test_two_tables_choose_with_one_and_evaluate_with_the_other():
    """A prefers action 1, which B values at 7; B prefers action 2, which A values at 3."""
    start = np.array([[[0, 0, 0], [1, 4, 3]], [[0, 0, 0], [5, 7, 9]]], dtype=np.float32)
    learnt = [0, 0]
    for seed in range(400):
        tables = start.copy()
        update(tables, at(0), 0, 1.0, at(1), 0, 2, 1.0, 1.0, seed)
        (changed,) = np.flatnonzero(tables[:, 0, 0])
        learnt[changed] += 1
        assert tables[changed, 0, 0] == 1.0 + (7.0 if changed == 0 else 3.0)
    assert min(learnt) > 160  # a fair coin: 200 each, standard deviation 10


@TABLES
def test_the_target_never_uses_an_infeasible_action(count: int):
    tables = np.zeros((count, 2, 4), dtype=np.float32)
    tables[:, 1] = [100.0, 1.0, 2.0, 100.0]
    update(tables, at(0), 3, 0.0, at(1), 1, 2, 1.0, 1.0)
    assert tables.sum(axis=0)[0, 3] == 2.0


def test_a_maximum_of_negative_values_and_of_values_of_both_signs():
    rng = np.random.default_rng(0)
    for shift in (-10.0, 0.0, 10.0):
        for size in (1, 2, 63, 64, 65, 1600):
            row = rng.normal(shift, 1.0, size).astype(np.float32)
            assert largest(row) == row.max()
    assert largest(np.array([-1e-45, -3e38, -0.0], dtype=np.float32)) == 0.0


@TABLES
@pytest.mark.parametrize("share", [0.0, 0.25])
def test_the_greedy_action_is_the_best_feasible_one_of_the_sum(count: int, share: float):
    rng = np.random.default_rng(1)
    for size in (1, 5, 64, 200):
        tables = rng.normal(size=(count, 2, size)).astype(np.float32)
        first, last = sorted(rng.integers(0, size, 2))
        summed = tables.sum(axis=0)
        row = (1 - share) * summed[0] + share * summed[1]
        place = Place(0, 1 if share else 0, share)
        scratch = np.empty(size, dtype=np.float32)
        got = best_action(tables, 0, count, place, first, last, scratch, rng)
        assert got == first + np.argmax(row[first : last + 1])


def test_ties_prefer_no_index_for_being_low():
    tables, scratch = np.zeros((1, 1, 300), dtype=np.float32), np.empty(300, dtype=np.float32)
    rng = np.random.default_rng(0)
    chosen = np.array(
        [best_action(tables, 0, 1, at(0), 100, 199, scratch, rng) for _ in range(5000)]
    )
    counts = np.bincount(chosen, minlength=300)
    assert counts[:100].sum() == counts[200:].sum() == 0
    assert counts[100:200].min() > 15  # 50 expected of each, standard deviation 7


# ---- interpolation

GRID = Grid(50, 3, 0.70, 0.004, 0.0, 1.0, True)


def linear_table(slope: float, offset: float) -> np.ndarray:
    """Q of action a in a column j: offset + a + 10 j + slope SOC, at the bin centres."""
    centres = 0.70 + (np.arange(50) + 0.5) * 0.004
    q = offset + slope * centres[:, None, None] + np.arange(4) + 10 * np.arange(3)[:, None]
    return q.reshape(1, 150, 4).astype(np.float32)


def test_interpolation_is_exact_where_q_is_linear_in_soc():
    tables, scratch = linear_table(-30.0, 5.0), np.empty(4, dtype=np.float32)
    for soc in np.random.default_rng(0).uniform(0.702, 0.898, 200):
        place = place_of(GRID, soc, 2)
        expected = 5.0 - 30.0 * soc + np.arange(4) + 20
        got = read_row(tables, 0, 1, place, 0, 3, scratch)
        np.testing.assert_allclose(got, expected, atol=1e-5)  # float32
        assert value_of(tables[0], place, 3) == pytest.approx(expected[3], abs=1e-5)


@pytest.mark.parametrize(("soc", "bin_at_end"), [(0.70, 0), (0.7019, 0), (0.8981, 49), (0.90, 49)])
def test_beyond_the_outermost_centres_interpolation_is_constant(soc: float, bin_at_end: int):
    table = linear_table(-30.0, 5.0)[0]
    expected = table[bin_at_end * 3 + 1, 2]
    assert value_of(table, place_of(GRID, soc, 1), 2) == pytest.approx(expected, rel=1e-6)


def test_an_update_is_split_by_the_weights_of_the_look_up():
    tables = np.zeros((1, 150, 4), dtype=np.float32)
    here = place_of(GRID, 0.70 + 10.75 * 0.004, 0)  # a quarter of the way from centre 10 to 11
    update(tables, here, 2, 8.0, at(0), 0, 3, 0.0, 0.5)
    changed = {(row, action): tables[0, row, action] for row, action in np.argwhere(tables[0])}
    assert changed == {(30, 2): pytest.approx(3.0), (33, 2): pytest.approx(1.0)}


def test_one_soc_bin_can_be_interpolated():
    grid = Grid(1, 1, 0.70, 0.2, 0.0, 0.0, True)
    assert place_of(grid, 0.71, 0) == place_of(grid, 0.89, 0) == (0, 0, 0.0)


# ---- Q* of a small process

STATES, ACTIONS, DISCOUNT = 6, 5, 0.8


def random_process(seed: int):
    """Stochastic: two followers per pair with a probability; a feasible range per state."""
    rng = np.random.default_rng(seed)
    reward = rng.uniform(-1.0, 1.0, (STATES, ACTIONS))
    following = rng.integers(0, STATES, (STATES, ACTIONS, 2))
    chance = rng.uniform(0.1, 0.9, (STATES, ACTIONS))
    first, last = rng.integers(0, 2, STATES), rng.integers(2, ACTIONS, STATES)
    return reward, following, chance, first, last


def optimal_q(reward, following, chance, first, last):
    """Value iteration in plain numpy."""
    q = np.zeros((STATES, ACTIONS))
    for _ in range(500):
        best = np.array([q[s, first[s] : last[s] + 1].max() for s in range(STATES)])
        expected = chance * best[following[..., 0]] + (1 - chance) * best[following[..., 1]]
        q = reward + DISCOUNT * expected
    return q


@njit
def learn(tables, reward, following, chance, first, last, sweeps, rng):
    """Every feasible pair in turn, one sampled follower, step size falling with the sweep."""
    scratch = np.empty(tables.shape[2], dtype=np.float32)
    for sweep in range(sweeps):
        alpha = 1.0 / (1.0 + sweep) ** 0.75
        for s in range(tables.shape[1]):
            for a in range(first[s], last[s] + 1):
                then = following[s, a, 0 if rng.random() < chance[s, a] else 1]
                td_update(
                    tables,
                    Place(s, s, 0.0),
                    a,
                    reward[s, a],
                    Place(then, then, 0.0),
                    first[then],
                    last[then],
                    DISCOUNT,
                    alpha,
                    scratch,
                    rng,
                )


@TABLES
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_q_star_of_a_small_process_is_reached_within_1_percent(count: int, seed: int):
    process = random_process(seed)
    tables = np.zeros((count, STATES, ACTIONS), dtype=np.float32)
    learn(tables, *process, 60_000, np.random.default_rng(seed))
    exact, (*_, first, last) = optimal_q(*process), process
    scale = np.abs(exact).max()
    for s in range(STATES):
        feasible = slice(first[s], last[s] + 1)
        for table in tables:
            np.testing.assert_allclose(table[s, feasible], exact[s, feasible], atol=0.01 * scale)


# ---- overestimation


@njit
def noisy_bandit(tables, noise, rng):
    """One state, actions worth N(0, 1) each, so that Q* is 0; uniform exploration."""
    actions = tables.shape[2]
    scratch = np.empty(actions, dtype=np.float32)
    here = Place(0, 0, 0.0)
    for reward in noise:
        action = rng.integers(0, actions)
        td_update(tables, here, action, reward, here, 0, actions - 1, 0.9, 0.1, scratch, rng)


@pytest.mark.slow
def test_double_q_overestimates_less_on_a_noisy_bandit():
    """The truth is 0. Mean over actions and 50 seeds: Q-learning is above 2.5, double Q within
    a tenth of that."""
    mean_q = {}
    for count in (1, 2):
        runs = []
        for seed in range(50):
            tables = np.zeros((count, 1, 10), dtype=np.float32)
            rng = np.random.default_rng([7, seed])
            noisy_bandit(tables, rng.normal(size=5000), rng)
            runs.append(tables.mean())
        mean_q[count] = np.mean(runs)
    assert mean_q[1] > 2.5
    assert abs(mean_q[2]) < 0.25


@njit
def maximisation_bias(tables, noise, rng):
    """Sutton & Barto, example 6.7. Row 0 is A: action 0 goes left to B for nothing, action 1
    ends. Row 1 is B: ten actions that end with a reward of N(-0.1, 1). Returns left moves in one
    episode per entry of ``noise``."""
    scratch, left, start = np.empty(10, dtype=np.float32), 0, Place(0, 0, 0.0)
    for shock in noise:
        here, last, ends = start, 1, False
        while not ends:
            if rng.random() < 0.1:
                action = int(rng.integers(0, last + 1))
            else:
                action = best_action(tables, 0, len(tables), here, 0, last, scratch, rng)
            ends = here.low == 1 or action == 1
            left += 0 if ends else 1
            reward = shock - 0.1 if here.low == 1 else 0.0
            following, gamma = Place(1, 1, 0.0), 0.0 if ends else 1.0
            td_update(tables, here, action, reward, following, 0, 9, gamma, 0.1, scratch, rng)
            here, last = following, 9
    return left


@pytest.mark.slow
def test_double_q_goes_left_less_often_in_the_example_of_sutton_and_barto():
    """Left is worth -0.1, and the best policy with this exploration takes it in 5 % of the
    episodes. Over 100 episodes and 1,000 seeds Q-learning takes it at least 40 points more often
    than double Q."""
    share = {}
    for count in (1, 2):
        left = 0
        for seed in range(1000):
            tables = np.zeros((count, 2, 10), dtype=np.float32)
            rng = np.random.default_rng([11, seed])
            left += maximisation_bias(tables, rng.normal(size=100), rng)
        share[count] = left / 100_000
    assert share[1] > share[2] + 0.4
