"""A certificate says how fine is fine enough, and refuses what no grid can answer."""

import dataclasses
import json

import numpy as np
import pytest

from tractor_ems.optimal import certificate as module
from tractor_ems.optimal.certificate import HALVING_LIMIT, ROLLOUT_LIMIT, certify
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

PAPER = load_powertrain("paper")
PLANTER_W = load_cycle("planter").power_demand_w
SMALL = dataclasses.replace(
    PAPER,
    battery=dataclasses.replace(
        PAPER.battery, energy_j=18e6, power_max_w=100e3, soc_min=0.2, soc_max=0.9
    ),
)


def test_certificate_holds_on_the_paper_cycle():
    certificate = certify(PAPER, PLANTER_W, soc_initial=0.85, soc_final=0.836)
    assert certificate.ok
    assert certificate.grid_halving_change < HALVING_LIMIT
    assert abs(certificate.rollout_gap) < ROLLOUT_LIMIT
    assert certificate.soc_points >= 801
    assert certificate.soc_final == pytest.approx(0.836, abs=1e-6)
    assert json.loads(json.dumps(certificate.to_json())) == certificate.to_json()


def test_a_hopeless_grid_is_refined_until_it_stands():
    certificate = certify(SMALL, PLANTER_W[:200], 0.5, 0.5, soc_points=4, actions=2)
    fine = certify(SMALL, PLANTER_W[:200], 0.5, 0.5, soc_points=801, actions=201)
    assert certificate.ok
    assert certificate.soc_points > 7
    assert certificate.fuel_kg == pytest.approx(fine.fuel_kg, rel=1e-3)


def test_a_grid_that_may_not_be_refined_is_not_certified(monkeypatch):
    monkeypatch.setattr(module, "MAX_NODES", 2_000)
    assert not certify(SMALL, PLANTER_W[:200], 0.5, 0.5, soc_points=4, actions=2).ok


def test_float32_rounding_of_soc_is_forgiven():
    certificate = certify(PAPER, np.full(40, 60e3), float(np.float32(0.9)), float(np.float32(0.9)))
    assert certificate.ok
    low = float(np.float32(0.7))
    assert low < 0.7
    assert certify(PAPER, np.full(40, 60e3), low, low).ok


def test_a_final_soc_out_of_reach_is_named_with_the_nearest():
    with pytest.raises(ConfigError, match=r"soc_final: 0.9 cannot be reached from 0.7 .* 0.70"):
        certify(PAPER, np.full(10, 50e3), 0.7, 0.9)
    with pytest.raises(ConfigError, match=r"soc_final: 0.6, allowed 0.7..0.9"):
        certify(PAPER, np.full(10, 50e3), 0.7, 0.6)
