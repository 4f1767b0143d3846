"""Demonstrations: what comes out of the bags is what was driven."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from study.tiny import row_of, tiny

from tractor_ems.learning.mdp import (
    ActionMapping,
    advance,
    battery_power_w,
    bounds_w,
    make_mdp,
    reward_of,
)
from tractor_ems.learning.online import make_encoder
from tractor_ems.study.baselines import reward_config
from tractor_ems.study.experts import (
    demonstrations,
    drives_of,
    plant,
    record,
    seeds,
    transitions,
)
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_sim.duty_cycle.library import load_cycle


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    for item in demonstrations(tiny("ddqn_shaped_mixed"), folder):
        record(item, tiny("ddqn_shaped_mixed"))
    return folder


def process(mapping: ActionMapping = "p_batt_grid", actions: int = 1600, soc_min: float = 0.836):
    config = tiny("ddqn_shaped_mixed")
    return make_mdp(
        plant(config, soc_min),
        load_cycle("planter").power_demand_w,
        reward_config("piecewise"),
        mapping=mapping,
        actions=actions,
        soc_initial=0.85,
        soc_target=0.836,
    )


@pytest.mark.parametrize("expert", ["dp", "rule_based"])
@pytest.mark.parametrize(("mapping", "actions"), [("p_batt_grid", 1600), ("p_eng_knots", 65)])
def test_a_recorded_action_drives_the_recorded_power_to_half_a_grid_step(
    expert, mapping: ActionMapping, actions: int, bags: Path
) -> None:
    config = tiny("ddqn_shaped_mixed")
    mdp = process(mapping, actions)
    step_w = mdp.action_power_w[1] - mdp.action_power_w[0]
    drive = drives_of(config, bags, expert, 0.836)[0]
    told = transitions(drive, mdp, make_encoder(mdp, 200), 0.99)
    for k in range(len(told)):
        demand_w, soc = drive.power_demand_w[k], drive.soc[k]
        lb, ub = bounds_w(mdp, demand_w, soc)
        power_w = battery_power_w(mdp, told.action[k], demand_w, lb, ub)
        off = drive.engine_power_w[k] == 0.0
        assert abs(power_w - drive.battery_power_w[k]) <= (1.0 if off else step_w)
        assert (advance(mdp, demand_w, soc, power_w)[1] <= 1.0) == off
        assert told.first[k] <= told.action[k] <= told.last[k]


def test_transitions_are_counted_anew_in_the_studys_reward(bags: Path) -> None:
    config, mdp = tiny("ddqn_shaped_mixed"), process()
    drive = drives_of(config, bags, "dp", 0.836)[0]
    told = transitions(drive, mdp, make_encoder(mdp, 200), 0.99)
    for k in (0, 5, 100, 700):
        own = reward_of(
            mdp, drive.engine_power_w[k], drive.fuel_kg[k], drive.soc[k], drive.soc[k + 1]
        )
        assert told.reward[k] == np.float32(own)
    assert len(told) == len(drive.power_demand_w) - 1, "the last step has no successor"
    np.testing.assert_array_equal(told.next_inputs[:-1], told.inputs[1:])


def test_mixed_seeds_fill_half_of_the_replay_and_are_shuffled(bags: Path) -> None:
    config, mdp = tiny("ddqn_shaped_mixed"), process()
    drawn, report = seeds(
        row_of(config), config, bags, mdp, make_encoder(mdp, 200), np.random.default_rng(0)
    )
    assert len(drawn) == config.replay_capacity // 2
    assert report["dp"].share == report["rule_based"].share == 0.25
    dp = transitions(drives_of(config, bags, "dp", 0.836)[0], mdp, make_encoder(mdp, 200), 0.99)
    known = {row.tobytes() for row in dp.inputs}
    from_dp = np.array([row.tobytes() in known for row in drawn.inputs])
    assert from_dp[: len(drawn) // 2].any() and from_dp[len(drawn) // 2 :].any()


def test_the_studys_own_cycle_never_seeds(tmp_path: Path) -> None:
    names = {item.cycle for item in demonstrations(tiny("ddqn_shaped_mixed"), tmp_path)}
    assert names and "planter_7" not in names, "planter is planter_7"


def test_too_few_cycles_for_the_share_are_refused(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped_dp")
    config = replace(config, experts=replace(config.experts, seeds=(1, 1)))
    with pytest.raises(ConfigError, match=r"experts\.seeds: \[1, 1\] holds 1 cycles, dp needs 2"):
        demonstrations(config, tmp_path)


def test_drives_are_read_from_the_bags_again_when_a_bag_changes(bags: Path) -> None:
    config = tiny("ddqn_shaped_mixed")
    first = drives_of(config, bags, "dp", 0.836)
    again = drives_of(config, bags, "dp", 0.836)
    assert [d.soc_target for d in again] == [0.836] * len(first)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.soc, other.soc)
        np.testing.assert_array_equal(one.engine_on, other.engine_on)
    bag = next(d.bag for d in demonstrations(config, bags) if d.expert == "dp")
    mcap = next(bag.glob("*.mcap"))
    whole = mcap.read_bytes()
    try:
        mcap.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(BagError, match=bag.name):
            drives_of(config, bags, "dp", 0.836)
    finally:
        mcap.write_bytes(whole)


def test_another_start_or_target_records_other_bags(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped_dp")
    here = {item.bag for item in demonstrations(config, tmp_path)}
    for changes in ({"soc_initial": 0.84}, {"soc_target": 0.84}):
        other = {item.bag for item in demonstrations(replace(config, **changes), tmp_path)}
        assert not here & other


def test_a_bag_that_is_there_is_not_recorded_again(bags: Path) -> None:
    config = tiny("ddqn_shaped_mixed")
    item = demonstrations(config, bags)[0]
    before = {path: path.stat().st_mtime_ns for path in item.bag.iterdir()}
    record(item, config)
    assert {path: path.stat().st_mtime_ns for path in item.bag.iterdir()} == before
    assert not list(bags.rglob(".part*"))
