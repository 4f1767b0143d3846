"""Where the paper contradicts itself or leaves a reader stuck: what is printed, what follows.

What is arithmetic is computed here from the printed numbers (``paper_values``).
"""

import math
from dataclasses import dataclass

import numpy as np

from tractor_ems.learning.rewards import ENGINE_OFF_REWARD, piecewise_reward
from tractor_ems.study.paper_values import (
    DQN_DDQN_FUEL_GAL,
    PERCENTAGES,
    SETTINGS,
    SUMMARY,
    TABLE_1,
    MethodValue,
    episodes_of,
    episodes_text,
    percent_text,
)
from tractor_ems.study.table1 import implied_battery_j
from tractor_sim.config import load_powertrain
from tractor_sim.engine import best_power_w
from tractor_sim.fuel import DENSITY_KG_PER_L, L_PER_US_GALLON

_J_PER_KWH = 3.6e6

_TABLE_1_EFFICIENCIES = (0.42, 0.435)
"""Engine efficiency that a control of Table 1 can have on average; the paper's best is 42-44 %."""


@dataclass(frozen=True)
class Slip:
    """One inconsistency.

    Attributes:
        subject: what it is about.
        printed: what the paper says.
        follows: what follows from its own numbers or text.
        where: the place in the paper.
    """

    subject: str
    printed: str
    follows: str
    where: str


def slips() -> tuple[Slip, ...]:
    """The paper's inconsistencies, in the order of their subjects."""
    return (
        *_speed_slips(),
        *_fuel_slips(),
        *_battery_slips(),
        *_reward_slips(),
        *_method_slips(),
    )


def fewer(before: float, after: float) -> float:
    """Relative reduction, a fraction."""
    return 1.0 - after / before


def _printed(row_id: str) -> MethodValue:
    return next(item for item in SUMMARY if item.id == row_id)


def _episodes(row_id: str) -> int:
    value = episodes_of(row_id)
    assert value is not None
    return value


def _speed_slips() -> tuple[Slip, ...]:
    dqn, ddqn, shaped = _episodes("dqn"), _episodes("ddqn"), _episodes("ddqn_shaped")
    dp, mixed = _episodes("ddqn_shaped_dp"), _episodes("ddqn_shaped_mixed")
    rule = _episodes("ddqn_shaped_rule")
    return (
        Slip(
            "DDQN against DQN",
            f"{percent_text(PERCENTAGES.ddqn_faster_than_dqn, 0)} faster convergence",
            f"{episodes_text(dqn)} to {episodes_text(ddqn)} episodes is "
            f"{percent_text(fewer(dqn, ddqn))}",
            "abstract; Deep Q-Network Result",
        ),
        Slip(
            "DP seeding",
            f"{percent_text(PERCENTAGES.seeding_faster, 0)} in the abstract, "
            f"{percent_text(PERCENTAGES.dp_seeding_faster)} elsewhere",
            f"{episodes_text(shaped)} to {episodes_text(dp)} episodes is "
            f"{percent_text(fewer(shaped, dp))}",
            "abstract; summary table; Preseeding Replay Buffer Results",
        ),
        Slip(
            "rule-based seeding",
            f"{episodes_text(rule)} episodes, and that expert-guided data effectively enhances "
            "convergence",
            f"{percent_text(-fewer(shaped, rule))} slower than no seeding at all "
            f"({episodes_text(shaped)}); it is in no table and no figure",
            "Pre-seeding Replay Buffer with Combined Data",
        ),
        Slip(
            "mixed against DP seeding",
            "only slightly behind DP-only seeding",
            f"{episodes_text(mixed)} against {episodes_text(dp)} episodes is "
            f"{percent_text(mixed / dp - 1.0)} more",
            "Pre-seeding Replay Buffer with Combined Data, last paragraph",
        ),
        Slip(
            "what shaping does to learning",
            "reward shaping is introduced to improve learning efficiency",
            f"the shaped agent needs {shaped / ddqn:.1f} times the episodes of the unshaped one "
            f"({episodes_text(shaped)} against {episodes_text(ddqn)})",
            "abstract; summary table",
        ),
        Slip(
            "exploration of seeded agents",
            "the shorter training is put down to the seeds",
            f"seeded agents start at epsilon {SETTINGS.epsilon_seeded:g}, unseeded ones at "
            f"{SETTINGS.epsilon_unseeded:g}: two things change at once, and "
            "neither the number of runs nor a spread is given",
            "Reward Shaping Results; Preseeding Replay Buffer",
        ),
    )


def _fuel_slips() -> tuple[Slip, ...]:
    conventional, dp = _printed("conventional"), _printed("dp")
    shaped, mixed, plain = _printed("ddqn_shaped"), _printed("ddqn_shaped_mixed"), _printed("ddqn")
    base, best = conventional.efficiency[0], dp.efficiency[0]
    load, control_1 = TABLE_1[0], TABLE_1[1]
    load_j = SETTINGS.table1_load_w * SETTINGS.table1_duration_s
    lhv = load_powertrain("paper").engine.fuel_lhv_j_per_kg
    fuel_j = load.fuel_gal * L_PER_US_GALLON * DENSITY_KG_PER_L * lhv
    reduction = fewer(conventional.fuel_gal, dp.fuel_gal)
    from_efficiency = fewer(best, base)
    return (
        Slip(
            "fuel reduction of the shaped DDQN",
            f"{percent_text(PERCENTAGES.shaped_reduction)} in the text, "
            f"{percent_text(shaped.reduction or 0.0)} in the table",
            f"{conventional.fuel_gal} to {shaped.fuel_gal} gal is "
            f"{percent_text(fewer(conventional.fuel_gal, shaped.fuel_gal))}; "
            f"{percent_text(reduction)} is DP's",
            "Reward Shaping Results; summary table",
        ),
        Slip(
            "fuel of the unshaped DDQN",
            f"{DQN_DDQN_FUEL_GAL:.2f} gal in the text, {plain.fuel_gal:.2f} gal in both tables",
            f"the text's number would be a reduction of "
            f"{percent_text(fewer(conventional.fuel_gal, DQN_DDQN_FUEL_GAL))}, not "
            f"{percent_text(plain.reduction or 0.0)}",
            "Deep Q-Network Result; Table 2; summary table",
        ),
        Slip(
            "thermal efficiency against DP",
            f"{percent_text(shaped.efficiency_of_dp or 0.0)} and "
            f"{percent_text(mixed.efficiency_of_dp or 0.0)} for the same 43 %",
            f"43 of 43.67 % is {percent_text(shaped.efficiency[0] / best)} for both",
            "summary table",
        ),
        Slip(
            "fuel against DP, mixed seeding",
            percent_text(mixed.fuel_of_dp or 0.0),
            f"{dp.fuel_gal:.2f} of {mixed.fuel_gal} gal is "
            f"{percent_text(dp.fuel_gal / mixed.fuel_gal)}; for {shaped.fuel_gal} gal, printed as "
            f"97.0 %, it is {percent_text(dp.fuel_gal / shaped.fuel_gal)}",
            "summary table",
        ),
        Slip(
            "efficiency gain of shaping",
            f"{percent_text(PERCENTAGES.shaped_efficiency_gain)} over conventional; from 25 % to "
            "43 % in the conclusion",
            f"41 to 43 % is {100 * (shaped.efficiency[0] - base):.0f} points or "
            f"{percent_text(shaped.efficiency[0] / base - 1.0)}; the unshaped agent is printed as "
            "20-25 %",
            "Reward Shaping Results; Conclusion",
        ),
        Slip(
            "savings at unequal final SOC",
            f"DP saves {percent_text(reduction)} of fuel against conventional",
            f"41 to 43.67 % efficiency explains {percent_text(from_efficiency)}; the other "
            f"{100 * (reduction - from_efficiency):.1f} points are battery energy, because the "
            "conventional tractor leaves the battery alone",
            "Table 2; summary table",
        ),
        Slip(
            "same final SOC",
            "the same final SOC of 83.6 % with and without seeding",
            f"the mixed-seeded agent ends at {percent_text(mixed.soc_final or 0.0)}",
            "seeding table",
        ),
        Slip(
            "lowest fuel",
            "DP achieves the lowest fuel consumption (1.70 gal)",
            f"the unshaped DDQN burns {plain.fuel_gal:.2f} gal in the same table; DP is optimal "
            "only for its own final SOC, which is not stated as a constraint",
            "Preseeding Replay Buffer Results, last paragraphs; summary table",
        ),
        Slip(
            "Table 1, load",
            "13 minutes at 216 kW on 1.69 gal",
            f"as a mean load that needs {percent_text(load_j / fuel_j)} engine efficiency; "
            "216 kW can only be a peak",
            "Table 1",
        ),
        Slip(
            "Table 1, first reduction",
            "-9.4 %, called a reduction",
            f"{load.fuel_gal} to {control_1.fuel_gal} gal is "
            f"{percent_text(fewer(load.fuel_gal, control_1.fuel_gal))}, and a "
            "reduction needs no sign",
            "Table 1",
        ),
        Slip(
            "Table 1, what it shows",
            "certain duty cycles burn more than the conventional tractor under a rule base",
            "the table has one duty cycle, and both controls burn less than conventional",
            "Introduction; Table 1",
        ),
    )


def _battery_slips() -> tuple[Slip, ...]:
    plain, shaped, dp = _printed("ddqn"), _printed("ddqn_shaped"), _printed("dp")
    second = TABLE_1[2]
    assert plain.soc_final is not None
    assert shaped.soc_final is not None
    assert second.soc_final is not None
    low, high = (
        implied_battery_j(efficiency) / _J_PER_KWH for efficiency in _TABLE_1_EFFICIENCIES
    )
    other = load_powertrain("paper").battery.energy_j / _J_PER_KWH
    return (
        Slip(
            "no single SOC_min",
            f"final SOC {percent_text(plain.soc_final)} without shaping, "
            f"{percent_text(shaped.soc_final)} with shaping and for DP",
            "both rewards pay most for a stopped engine, so each optimum ends at SOC_min: one "
            f"bound of {percent_text(plain.soc_final)} would end the shaped rows there too, one "
            f"of {percent_text(shaped.soc_final)} would keep the unshaped row from "
            f"{percent_text(plain.soc_final)}",
            "Table 2; summary table",
        ),
        Slip(
            "Table 1, final SOC",
            f"Control 2 ends at {percent_text(second.soc_final, 0)}",
            f"below the {percent_text(plain.soc_final, 0)} at which the unshaped agent of the "
            "other tables stops; a bound there would not allow it",
            "Table 1; Table 2",
        ),
        Slip(
            "Table 1, battery",
            f"Control 1 to Control 2: {TABLE_1[1].fuel_gal:.2f} to {second.fuel_gal:.2f} gal for "
            f"{100 * ((TABLE_1[1].soc_final or 0.0) - second.soc_final):.0f} points of SOC",
            f"that is {low:.0f}-{high:.0f} kWh at an engine efficiency of "
            f"{100 * _TABLE_1_EFFICIENCIES[0]:g}-{100 * _TABLE_1_EFFICIENCIES[1]:g} %, against "
            f"{other:.0f} kWh that fit the other tables (final SOC of DP "
            f"{percent_text(dp.soc_final or 0.0)})",
            "Table 1; summary table",
        ),
    )


def _reward_slips() -> tuple[Slip, ...]:
    engine = load_powertrain("paper").engine
    before, start, edge, above, top, best = piecewise_reward(
        engine,
        np.array(
            [
                np.nextafter(SETTINGS.efficient_from_w, 0.0),
                SETTINGS.efficient_from_w,
                SETTINGS.efficient_to_w,
                np.nextafter(SETTINGS.efficient_to_w, np.inf),
                SETTINGS.engine_max_w,
                best_power_w(engine),
            ]
        ),
    )
    return (
        Slip(
            "notation of the shaped reward",
            "1.1e^5, 2e^{-6}",
            f"powers of ten are meant (110 kW, 2 x 10^-6 per W); with e^5 the efficient region "
            f"would be {1.1 * math.e**5:.0f} to {1.9 * math.e**5:.0f} W",
            "Reward Shaping",
        ),
        Slip(
            "shaped reward at the engine's maximum",
            "the branch above 190 kW ends below 275 kW",
            f"exactly 275 kW, a legal power, earns {top:.0f} like an impossible one",
            "Reward Shaping",
        ),
        Slip(
            "shaped reward at 110 kW",
            "110 kW is the start of the efficient region",
            f"the reward jumps by {start - before:.1f} there, from {before:.2f} to {start:.2f} "
            "(engine curve of this study): 1 W decides more than all efficiencies within it",
            "Reward Shaping",
        ),
        Slip(
            "shaped reward at 190 kW",
            "190 kW is the end of the efficient region",
            f"the reward falls from {edge:.3f} to {above:.3f} there (engine curve of this study); "
            "below 110 kW it falls as efficiency rises",
            "Reward Shaping",
        ),
        Slip(
            "what the shaped reward asks for",
            "it promotes operation at peak engine efficiency",
            f"engine off earns {ENGINE_OFF_REWARD:.2f}, the best engine point {best:.2f}: its "
            "optimum empties the battery to SOC_min",
            "Reward Shaping",
        ),
    )


def _method_slips() -> tuple[Slip, ...]:
    size = SETTINGS.soc_bins_tabular * SETTINGS.demand_bins * SETTINGS.actions
    return (
        Slip(
            "lower bound of the battery power",
            "Delta P = P_e,max - P_dem",
            "with P_ice <= P_e,max the bound is P_dem - P_e,max; as printed the battery would "
            "have to discharge at every demand below 275 kW",
            "Model Framework",
        ),
        Slip(
            "expert policies",
            "demonstrations from three distinct policies",
            "two are listed, DP and DP + rules; rules alone are reported with one number",
            "Preseeding Replay Buffer with Expert Data; Conclusion",
        ),
        Slip(
            "size of the table",
            "far exceeds the practical limits of tabular Q-learning",
            f"{size:,} entries are {4 * size / 1e6:.0f} MB in single precision, "
            "twice that for double Q: memory is not the limit",
            "Results of Double Q-Learning",
        ),
        Slip(
            "symbols of the correlation",
            "rho_Q, rho_r are standard deviations and rho_Q,r the correlation",
            "one letter for two things; it is said to relate Q to a covariance, and the "
            "pairs it is taken over are not stated",
            "Results of Double Q-Learning",
        ),
    )
