"""The chain counts what was seen; its optimum stops for long pauses and not for short ones."""

import numpy as np
import pytest

from tractor_ems.optimal.sdp import cell_of, fit_chain

EDGES = (np.array([50e3]),)


def test_shares_are_what_was_counted():
    demand_w = np.array([10e3, 10e3, 90e3, 10e3, 10e3, 90e3])[:, None]
    chain = fit_chain(EDGES, [demand_w])
    low, high = chain.number
    followers = slice(chain.first[low], chain.first[low + 1])
    share = dict(zip(chain.follower[followers], chain.share[followers], strict=True))
    assert share == {low: pytest.approx(0.5), high: pytest.approx(0.5)}
    assert chain.demand_w[low] == pytest.approx(10e3)
    assert chain.demand_w[high] == pytest.approx(90e3)


def test_every_situation_is_followed_by_something():
    rng = np.random.Generator(np.random.PCG64(3))
    traces = [rng.uniform(0.0, 200e3, (40, 2)) for _ in range(3)]
    edges = (np.array([50e3, 100e3, 150e3]), np.array([80e3, 120e3]))
    chain = fit_chain(edges, traces)
    for z in range(len(chain.demand_w)):
        assert chain.share[chain.first[z] : chain.first[z + 1]].sum() == pytest.approx(1.0)


def test_a_cell_never_seen_stands_for_the_nearest_that_was():
    edges = (np.array([50e3, 100e3, 150e3]),)
    chain = fit_chain(edges, [np.array([[10e3], [70e3], [10e3]])])
    assert chain.number[cell_of(edges, np.array([[190e3]]))[0]] == chain.number[1]
