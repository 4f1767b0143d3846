"""A run from names and files: defaults, refusals, and the run as columns."""

import numpy as np
import pytest

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.types import BatteryPowerCommand, PowerDemand
from tractor_sim.plant_run import prepare_run


def test_defaults_are_the_papers_run():
    info = prepare_run("paper", "planter").info
    assert (info.powertrain, info.cycle, info.steps) == ("paper", "planter", 766)
    assert (info.soc_initial, info.soc_target) == (0.85, 0.85)
    assert info.lockstep and info.t0_ns > 0


def test_target_follows_the_start_unless_it_is_given():
    assert prepare_run("paper", "planter", soc_initial=0.8).info.soc_target == 0.8
    assert prepare_run("paper", "planter", 0.8, 0.836).info.soc_target == 0.836


def test_every_run_has_an_id_of_its_own(make_run):
    assert make_run().info.run_id != make_run().info.run_id


@pytest.mark.parametrize("name", ["soc_initial", "soc_target"])
@pytest.mark.parametrize("value", [0.5, 0.95, -0.5, 0.0])
def test_soc_outside_the_window_is_refused_with_the_window(name, value):
    with pytest.raises(ConfigError, match=rf"{name}: {value}, allowed 0.7..0.9"):
        prepare_run("paper", "planter", **{name: value})


def test_cycle_of_another_step_length_is_refused(tmp_path):
    path = tmp_path / "half.csv"
    path.write_text("time_s,power_demand_w\n0,1\n0.5,1\n")
    with pytest.raises(CycleError, match=r"dt_s 0.5, powertrain paper needs 1.0"):
        prepare_run("paper", str(path))


def test_final_state_is_stamped_after_the_last_step_and_has_no_demand(make_run):
    run = make_run()
    while not run.done:
        run.apply(BatteryPowerCommand(run.stamp_ns, 0.0))
    final = run.samples()
    assert {sample.stamp_ns for sample in final} == {run.info.stamp_ns(run.info.steps)}
    assert not any(isinstance(sample, PowerDemand) for sample in final)
    demand, *rest = run.closing_samples()
    assert demand == PowerDemand(run.info.stamp_ns(run.info.steps - 1), run.power_demand_w[-1])
    assert tuple(rest) == final


def test_trajectory_balances_the_bus_at_every_step(make_run):
    run = make_run()
    while not run.done:
        run.apply(BatteryPowerCommand(run.stamp_ns, 40e3))
    trajectory = run.trajectory()
    np.testing.assert_allclose(
        trajectory.battery_power_w + trajectory.engine_power_w, trajectory.power_demand_w
    )
    assert list(trajectory.stamp_ns) == [run.info.stamp_ns(k) for k in range(run.info.steps)]
