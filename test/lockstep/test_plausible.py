"""An observation that cannot be true is found, one that can be is not."""

import math

import numpy as np
import pytest

from tractor_ems.plausible import Seen, fastest_soc_per_s, judge, plausible_on
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import Reason
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command, initial_state, power_limits, step

FIELD, PAPER = load_powertrain("field"), load_powertrain("paper")
ALLOWED = plausible_on(FIELD)


def observation(k=0, soc=0.55, demand_w=100e3, engine_w=100e3, limit_w=math.inf) -> Observation:
    """Tick ``k`` of 1 s."""
    one = np.ones(1)
    return Observation(
        stamp_ns=10**12 + round(k * 1e9),
        power_demand_w=demand_w * one,
        soc=soc * one,
        soc_target=0.55 * one,
        engine_on=np.ones(1, bool),
        time_in_state_s=one,
        engine_power_w=engine_w * one,
        charge_limit_w=limit_w * one,
        discharge_limit_w=limit_w * one,
        engine_limit_w=limit_w * one,
        features=np.zeros((1, 0)),
    )


def findings(observations, allowed=ALLOWED) -> list[str]:
    """What is said about each, empty where it is plausible."""
    seen, texts = Seen(), []
    for item in observations:
        seen, found = judge(allowed, seen, item)
        assert found is None or found.reason is Reason.OBSERVATION_IMPLAUSIBLE
        texts.append("" if found is None else found.text)
    return texts


@pytest.mark.parametrize("params", [FIELD, PAPER], ids=lambda params: params.name)
@pytest.mark.parametrize("seed", range(2))
def test_whatever_the_plant_does_is_plausible(params, seed):
    rng = np.random.Generator(np.random.PCG64(seed))
    state, seen, allowed = initial_state(params, params.soc_initial), Seen(), plausible_on(params)
    demand_w = np.zeros(1)
    for k in range(300):
        if k % 20 == 0:
            demand_w = rng.uniform(-150e3, 400e3, 1)
            wish = Command(rng.uniform(-2e5, 2e5, 1), rng.choice([0.0, math.nan], 1))
        limits = power_limits(params, state)
        seen, found = judge(
            allowed,
            seen,
            Observation(
                stamp_ns=10**12 + k * 10**9,
                power_demand_w=demand_w,
                soc=state.soc.astype(np.float32).astype(float),
                soc_target=state.soc,
                engine_on=state.engine_on,
                time_in_state_s=state.time_in_state_s,
                engine_power_w=state.engine_power_w,
                charge_limit_w=limits.charge_w,
                discharge_limit_w=limits.discharge_w,
                engine_limit_w=limits.engine_w,
                features=np.zeros((1, 0)),
            ),
        )
        assert found is None, (k, found)
        state, _ = step(params, state, demand_w, wish)


def test_a_soc_that_jumps_is_named_with_what_was_allowed():
    (_, text) = findings([observation(0), observation(1, soc=0.30)])
    assert text.startswith("soc: 0.3000, allowed 0.52") and text.endswith("it jumped")


def test_a_soc_that_stays_where_it_jumped_to_stays_implausible_until_it_is_back():
    texts = findings([observation(k, soc=0.3 if 2 <= k < 6 else 0.55) for k in range(10)])
    assert [bool(text) for text in texts] == [2 <= k < 6 for k in range(10)]


def test_after_a_silence_the_soc_may_be_where_the_battery_could_have_got_to():
    texts = findings([observation(0), observation(120, soc=0.35)])
    assert texts == ["", ""]


def test_a_step_of_a_signal_in_whole_percent_is_no_jump():
    assert not any(findings([observation(k, soc=0.55 - 0.01 * (k // 9)) for k in range(90)]))


@pytest.mark.parametrize("engine_w", [50e3, 150e3])
def test_a_soc_that_ignores_the_energy_that_flows_is_frozen(engine_w):
    texts = findings([observation(k, engine_w=engine_w) for k in range(60)])
    first = next(k for k, text in enumerate(texts) if text)
    # 1.2 % of 144 MJ at 50 kW
    assert first == math.ceil(0.012 * FIELD.battery.energy_j / 50e3) and all(texts[first:])
    assert "unchanged" in texts[first] and texts[first].endswith("it is frozen")


def test_a_frozen_soc_that_moves_again_is_believed_again():
    socs = [0.55] * 50 + [0.549] * 10
    texts = findings([observation(k, soc, engine_w=50e3) for k, soc in enumerate(socs)])
    assert texts[49] and not any(texts[50:])


def test_a_still_soc_is_fine_while_no_energy_flows_or_none_can():
    still = [observation(k) for k in range(300)]
    full = [observation(k, engine_w=0.0, demand_w=-80e3, limit_w=0.0) for k in range(300)]
    assert not any(findings(still)) and not any(findings(full))


@pytest.mark.parametrize(("soc", "engine_w"), [(0.80, 180e3), (0.79, 180e3), (0.31, 20e3)])
def test_a_full_battery_takes_nothing_and_an_empty_one_gives_nothing_said_or_not(soc, engine_w):
    assert not any(findings([observation(k, soc, engine_w=engine_w) for k in range(300)]))


def test_braking_and_boosting_that_cancel_leave_the_soc_where_it_was():
    demand_w = [150e3, 50e3] * 200
    assert not any(findings(observation(k, demand_w=w) for k, w in enumerate(demand_w)))


def test_energy_that_nobody_saw_flow_does_not_count():
    assert not any(findings([observation(100.0 * k, engine_w=50e3) for k in range(5)]))


@pytest.mark.parametrize("soc", [55.0, 80.0, 100.0, 1.5])
def test_a_soc_in_percent_is_refused_with_the_hint(soc):
    (text,) = findings([observation(soc=soc)])
    assert text.startswith(f"soc: {soc:g}, allowed 0..1") and "scale: 0.01" in text


@pytest.mark.parametrize("soc", [math.nan, math.inf, -0.01, 101.0])
def test_a_soc_that_is_no_fraction_is_refused(soc):
    (text,) = findings([observation(soc=soc)])
    assert text.startswith("soc: ") and "scale" not in text


@pytest.mark.parametrize("demand_w", [math.nan, math.inf, -math.inf, 1.3e6, -1.3e6])
def test_a_demand_that_no_such_tractor_has_is_refused(demand_w):
    (text,) = findings([observation(demand_w=demand_w)])
    assert "power_demand_w: " in text and "allowed -1.275e+06..1.275e+06" in text


def test_a_bad_demand_does_not_poison_what_follows():
    demands_w = [100e3, math.nan, 100e3, math.inf] + [100e3] * 100
    texts = findings(observation(k, demand_w=w) for k, w in enumerate(demands_w))
    assert [k for k, text in enumerate(texts) if text] == [1, 3]


def test_a_new_run_starts_without_a_memory():
    assert findings([observation(0, soc=0.3)]) == [""]


def test_the_fastest_soc_is_full_power_at_the_lowest_voltage():
    assert fastest_soc_per_s(PAPER.battery) == 250e3 / 666e6
    slow, fast = 150e3 / 144e6, 250.0 * 650.0 / 144e6  # full power, full current
    assert slow < fastest_soc_per_s(FIELD.battery) <= fast


@pytest.mark.parametrize(
    "settings", [{"soc_tolerance": 0.0}, {"soc_step": 0.2}, {"soc_step": math.nan}]
)
def test_a_setting_out_of_range_is_refused(settings):
    with pytest.raises(ConfigError, match=f"^{next(iter(settings))}: "):
        plausible_on(FIELD, **settings)
