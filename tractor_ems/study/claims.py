"""The paper's claims, each with a verdict that is computed from this study's runs, never by hand.

Rules and thresholds are fixed beside the judges, before any result. A difference needs 5 seeds
and a 95 % interval that excludes equality; sameness needs an interval within a stated margin.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

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

SOC_MINS = (0.70, 0.836)
"""The paper's final SOC of 70 % and of 83.6 % need different lower limits: shaped rows run at
both."""

NONE, DP, MIXED, RULE = "ddqn_shaped", "ddqn_shaped_dp", "ddqn_shaped_mixed", "ddqn_shaped_rule"


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        text: as the paper states it.
        where: the place in the paper.
        setting: what it was tried on here: reward and SOC_min.
        verdict: ``calibrated`` marks agreement that the plant was tuned to, which proves nothing.
        evidence: this study's numbers, and why it is not resolved where it is not.
    """

    text: str
    where: str
    setting: str
    verdict: Verdict
    evidence: str


_Judge = Callable[[StudyResults, Sequence[str]], Found]


def claims(results: StudyResults) -> tuple[Claim, ...]:
    """Every claim with its verdict; those about shaped rewards once per SOC_min."""
    listed = [_judged(results, 0.70, *item) for item in _unshaped()]
    listed += [_calibrated(results, name) for name in ("conventional", "dp")]
    for soc_min in SOC_MINS:
        listed += [_judged(results, soc_min, *item) for item in _shaped()]
    return tuple(listed)


def _unshaped() -> list[tuple[str, str, tuple[str, ...], _Judge]]:
    share = PERCENTAGES.ddqn_faster_than_dqn
    text, deep = "Results of Double Q-Learning", "Deep Q-Network Result"
    return [
        (
            f"DDQN converges {percent_text(share, 0)} faster than DQN",
            "abstract",
            ("ddqn", "dqn"),
            partial(faster, printed=share),
        ),
        ("Both DQN and DDQN converge", "Conclusion", ("dqn", "ddqn"), all_converge),
        (
            f"DQN and DDQN burn the same fuel ({DQN_DDQN_FUEL_GAL} gal)",
            deep,
            ("dqn", "ddqn"),
            same_fuel,
        ),
        (
            "Without shaping the engine runs mostly below 60 kW, at 20-25 % efficiency",
            deep,
            ("dqn", "ddqn"),
            low_power,
        ),
        (
            "Tabular Q-learning is not suitable: most pairs are never met in 100,000 episodes",
            text,
            ("q", "double_q"),
            tabular_unsuitable,
        ),
        (
            f"Q and reward have a weak negative correlation ({PEARSON})",
            text,
            ("double_q",),
            weakly_negative,
        ),
    ]


def _shaped() -> list[tuple[str, str, tuple[str, ...], _Judge]]:
    combined = "Pre-seeding Replay Buffer with Combined Data"
    shaping = "Reward Shaping Results"
    none, rule = episodes_of(NONE), episodes_of(RULE)
    assert none is not None
    assert rule is not None
    dp_share, mixed_share = PERCENTAGES.seeding_faster, PERCENTAGES.mixed_seeding_faster
    return [
        (
            "The shaped reward steers the engine into its efficient region (43 %)",
            shaping,
            (NONE,),
            efficient,
        ),
        (
            "The shaped DDQN reaches 97 % of DP's fuel economy and 98.4 % of its efficiency at "
            "the same final SOC",
            shaping,
            (NONE,),
            near_dp,
        ),
        (
            f"DP seeding converges {percent_text(dp_share, 0)} faster than no seeding",
            "abstract",
            (DP, NONE),
            partial(faster, printed=dp_share),
        ),
        (
            f"DP and rule-based seeding converges {percent_text(mixed_share)} faster than no "
            "seeding",
            "summary table",
            (MIXED, NONE),
            partial(faster, printed=mixed_share),
        ),
        (
            "Mixed seeding lies between DP and rule-based seeding",
            combined,
            (DP, MIXED, RULE),
            lies_between,
        ),
        (
            f"Rule-based seeding takes {episodes_text(rule)} episodes, more than no seeding "
            f"({episodes_text(none)})",
            combined,
            (NONE, RULE),
            partial(faster, printed=fewer(rule, none)),
        ),
        (
            "The quality of the seeds changes convergence speed, not optimality",
            "Preseeding Replay Buffer Results",
            (NONE, DP, MIXED, RULE),
            speed_not_optimality,
        ),
    ]


def _judged(
    results: StudyResults,
    soc_min: float,
    text: str,
    where: str,
    ids: Sequence[str],
    judge: _Judge,
) -> Claim:
    """Judge once every row has seeds enough."""
    keys = [f"{name}@{soc_min:g}" for name in ids]
    counts = {key: len(results.of(key)) for key in keys}
    few = [f"{key} has {count} seeds" for key, count in counts.items() if count < MIN_SEEDS]
    if few:
        verdict, evidence = unresolved(f"{', '.join(few)}, {MIN_SEEDS} are needed")
    else:
        verdict, evidence = judge(results, keys)
    reward = "shaped reward" if ids[0] in (NONE, DP, MIXED) else "fuel reward"
    return Claim(text, where, f"{reward}, SOC_min {soc_min:g}", verdict, evidence)


def _calibrated(results: StudyResults, name: str) -> Claim:
    printed = next(item for item in SUMMARY if item.id == name)
    text = f"{printed.label}: {printed.fuel_gal:.2f} gal at {100 * printed.efficiency[0]:g} %"
    if printed.soc_final is not None:
        text += f", final SOC {100 * printed.soc_final:g} %"
    verdict, evidence = calibrated(results, name)
    return Claim(text, "summary table", "the plant was calibrated on this row", verdict, evidence)
