"""The paper's claims, each with a verdict that is computed from this study's runs, never by hand.

Rules and thresholds are fixed beside the judges, before any result (that on tables was split by
agent after the first runs were seen, with the same thresholds). A difference needs 5 seeds
and a 95 % interval that excludes equality; sameness needs an interval within a stated margin.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from tractor_ems.study.convergence import MIN_SEEDS
from tractor_ems.study.drive_claims import (
    calibrated,
    efficient,
    low_power,
    near_dp,
    same_fuel,
    tabular_unsuitable,
    weakly_negative,
)
from tractor_ems.study.names import SOC_MINS, names_within, soc_min_text
from tractor_ems.study.paper_values import (
    DQN_DDQN_FUEL_GAL,
    PEARSON,
    PERCENTAGES,
    SUMMARY,
    episodes_of,
    episodes_text,
    percent_text,
)
from tractor_ems.study.results import StudyResults
from tractor_ems.study.slips import Slip, fewer, slips
from tractor_ems.study.speed_claims import (
    all_converge,
    faster,
    lies_between,
    speed_not_optimality,
)
from tractor_ems.study.verdicts import Found, Verdict, unresolved

__all__ = ["Claim", "Slip", "Verdict", "claims", "slips"]

NONE, DP, MIXED, RULE = "ddqn_shaped", "ddqn_shaped_dp", "ddqn_shaped_mixed", "ddqn_shaped_rule"


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        id: short, the same at every SOC_min.
        text: as the paper states it.
        where: the place in the paper.
        setting: what it was tried on here: reward and SOC_min.
        verdict: ``calibrated`` marks agreement that the plant was tuned to, which proves nothing.
        evidence: this study's numbers, and why it is not resolved where it is not.
    """

    id: str
    text: str
    where: str
    setting: str
    verdict: Verdict
    evidence: str


_Judge = Callable[[StudyResults, Sequence[str]], Found]

_Item: TypeAlias = tuple[str, str, str, tuple[str, ...], _Judge]
"""Id, text, place in the paper, rows, judge."""


def claims(results: StudyResults) -> tuple[Claim, ...]:
    """Every claim with its verdict; those about shaped rewards once per SOC_min."""
    listed = [_judged(results, 0.70, *item) for item in _unshaped()]
    listed += [_calibrated(results, name) for name in ("conventional", "dp")]
    for soc_min in SOC_MINS:
        listed += [_judged(results, soc_min, *item) for item in _shaped()]
    return tuple(listed)


def _unshaped() -> list[_Item]:
    share = PERCENTAGES.ddqn_faster_than_dqn
    text, deep = "Results of Double Q-Learning", "Deep Q-Network Result"
    return [
        (
            "ddqn_faster",
            f"DDQN converges {percent_text(share, 0)} faster than DQN",
            "abstract",
            ("ddqn", "dqn"),
            partial(faster, printed=share),
        ),
        (
            "both_converge",
            "Both DQN and DDQN converge",
            "Conclusion",
            ("dqn", "ddqn"),
            all_converge,
        ),
        (
            "same_fuel",
            f"DQN and DDQN burn the same fuel ({DQN_DDQN_FUEL_GAL} gal)",
            deep,
            ("dqn", "ddqn"),
            same_fuel,
        ),
        (
            "low_power",
            "Without shaping the engine runs mostly below 60 kW, at 20-25 % efficiency",
            deep,
            ("dqn", "ddqn"),
            low_power,
        ),
        (
            "double_q_unsuitable",
            "Tabular double Q-learning is not suitable: most pairs are rarely or never met in "
            "100,000 episodes",
            text,
            ("double_q",),
            tabular_unsuitable,
        ),
        (
            "q_unsuitable",
            "Tabular Q-learning, which the paper names with it, is not suitable either",
            text,
            ("q",),
            tabular_unsuitable,
        ),
        (
            "pearson",
            f"Q and reward have a weak negative correlation ({PEARSON})",
            text,
            ("double_q",),
            weakly_negative,
        ),
    ]


def _shaped() -> list[_Item]:
    combined = "Pre-seeding Replay Buffer with Combined Data"
    shaping = "Reward Shaping Results"
    none, rule = episodes_of(NONE), episodes_of(RULE)
    assert none is not None
    assert rule is not None
    dp_share, mixed_share = PERCENTAGES.seeding_faster, PERCENTAGES.mixed_seeding_faster
    return [
        (
            "efficient",
            "The shaped reward steers the engine into its efficient region (43 %)",
            shaping,
            (NONE,),
            efficient,
        ),
        (
            "near_dp",
            "The shaped DDQN reaches 97 % of DP's fuel economy and 98.4 % of its efficiency at "
            "the same final SOC",
            shaping,
            (NONE,),
            near_dp,
        ),
        (
            "dp_faster",
            f"DP seeding converges {percent_text(dp_share, 0)} faster than no seeding",
            "abstract",
            (DP, NONE),
            partial(faster, printed=dp_share),
        ),
        (
            "mixed_faster",
            f"DP and rule-based seeding converges {percent_text(mixed_share)} faster than no "
            "seeding",
            "summary table",
            (MIXED, NONE),
            partial(faster, printed=mixed_share),
        ),
        (
            "mixed_between",
            "Mixed seeding lies between DP and rule-based seeding",
            combined,
            (DP, MIXED, RULE),
            lies_between,
        ),
        (
            "rule_slower",
            f"Rule-based seeding takes {episodes_text(rule)} episodes, more than no seeding "
            f"({episodes_text(none)})",
            combined,
            (NONE, RULE),
            partial(faster, printed=fewer(rule, none)),
        ),
        (
            "speed_not_optimality",
            "The quality of the seeds changes convergence speed, not optimality",
            "Preseeding Replay Buffer Results",
            (NONE, DP, MIXED, RULE),
            speed_not_optimality,
        ),
    ]


def _judged(
    results: StudyResults,
    soc_min: float,
    name: str,
    text: str,
    where: str,
    ids: Sequence[str],
    judge: _Judge,
) -> Claim:
    """Judge once every row has seeds enough."""
    keys = [f"{row_id}@{soc_min:g}" for row_id in ids]
    names = names_within(keys)
    counts = {key: len(results.of(key)) for key in keys}
    few = [f"{names[key]} has {count} seeds" for key, count in counts.items() if count < MIN_SEEDS]
    if few:
        verdict, evidence = unresolved(f"{', '.join(few)}, {MIN_SEEDS} are needed")
    else:
        verdict, evidence = judge(results, keys)
    reward = "shaped reward" if ids[0] in (NONE, DP, MIXED) else "fuel reward"
    setting = f"{reward}, SOC_min {soc_min_text(soc_min)}"
    return Claim(name, text, where, setting, verdict, evidence)


def _calibrated(results: StudyResults, name: str) -> Claim:
    printed = next(item for item in SUMMARY if item.id == name)
    text = f"{printed.label}: {printed.fuel_gal:.2f} gal at {100 * printed.efficiency[0]:g} %"
    if printed.soc_final is not None:
        text += f", final SOC {100 * printed.soc_final:g} %"
    verdict, evidence = calibrated(results, name)
    setting = "the plant was calibrated on this row"
    return Claim(name, text, "summary table", setting, verdict, evidence)
