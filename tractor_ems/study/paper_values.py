"""Every number that the paper prints and this study re-makes, with the place where it stands.

Source: Abououf, Bhatti, Ahmed, "Improving Q-Learning for Real-World Control: A Case Study in
Series Hybrid Agricultural Tractors". Values are as printed, slips included; units in the names.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Table1Value:
    """One column of Table 1: 13 minutes of planter work "at 216 kW load"."""

    id: str
    label: str
    fuel_gal: float
    reduction: float | None
    soc_final: float | None


@dataclass(frozen=True)
class MethodValue:
    """One row of Table 2, the summary table or the seeding table.

    Attributes:
        id: row of this study, or baseline, that re-makes it.
        label: as printed.
        fuel_gal: fuel [US gal].
        efficiency: lowest and highest printed, equal where one number is printed (fractions).
        soc_final: fraction; None where the paper prints a dash.
        episodes: until convergence.
        reduction: of fuel against conventional (fraction).
        fuel_of_dp, efficiency_of_dp: "% achieved" against DP (fractions).
    """

    id: str
    label: str
    fuel_gal: float
    efficiency: tuple[float, float]
    soc_final: float | None
    episodes: int | None = None
    reduction: float | None = None
    fuel_of_dp: float | None = None
    efficiency_of_dp: float | None = None


@dataclass(frozen=True)
class Episodes:
    """Episodes until convergence of one agent, and where the paper says so."""

    id: str
    episodes: int
    where: str


@dataclass(frozen=True)
class Percentages:
    """Percentages of the text, as fractions."""

    ddqn_faster_than_dqn: float = 0.70  # abstract
    seeding_faster: float = 0.33  # abstract
    dp_seeding_faster: float = 0.324  # summary table, seeding results, conclusion
    mixed_seeding_faster: float = 0.135  # summary table, seeding results, conclusion
    shaped_reduction: float = 0.128  # reward shaping results, of the shaped DDQN
    shaped_efficiency_gain: float = 0.048  # reward shaping results
    shaped_fuel_of_dp: float = 0.97  # reward shaping results
    shaped_efficiency_of_dp: float = 0.984  # reward shaping results
    mixed_fuel_of_dp: float = 0.965  # summary table
    mixed_efficiency_of_dp: float = 0.986  # summary table
    efficiency_unshaped_conclusion: float = 0.25  # conclusion, "from 25% to 43%"
    efficiency_shaped_conclusion: float = 0.43
    best_efficiency: tuple[float, float] = (0.42, 0.44)  # reward shaping, at 110-190 kW


@dataclass(frozen=True)
class Settings:
    """The study's sizes, where the paper prints them."""

    soc_bins_tabular: int = 50
    soc_bins_deep: int = 200
    demand_bins: int = 766
    actions: int = 1600
    tabular_episodes: int = 100_000
    learning_rate: float = 0.001
    replay_size: int = 200_000
    batch_size: int = 64
    epsilon_unseeded: float = 1.0
    epsilon_seeded: float = 0.5
    dp_share_of_replay: float = 0.25
    mixed_share_of_replay: float = 0.50
    engine_max_w: float = 275e3
    low_power_w: float = 60e3
    efficient_from_w: float = 110e3
    efficient_to_w: float = 190e3
    table1_duration_s: float = 13 * 60.0
    table1_load_w: float = 216e3


TABLE_1 = (
    Table1Value("conventional", "Conventional", 1.69, None, None),
    Table1Value("control_1", "Control 1", 1.53, 0.094, 0.71),
    Table1Value("control_2", "Control 2", 1.20, 0.29, 0.65),
)

TABLE_2 = (
    MethodValue("conventional", "Conventional", 1.95, (0.41, 0.41), None),
    MethodValue("ddqn", "Baseline DDQN (No Reward Shaping)", 0.30, (0.20, 0.25), 0.70),
    MethodValue("ddqn_shaped", "DDQN (Reward Shaping)", 1.75, (0.43, 0.43), 0.836),
    MethodValue("dp", "DP", 1.70, (0.4367, 0.4367), 0.836),
)

SUMMARY = (
    MethodValue("conventional", "Conventional", 1.95, (0.41, 0.41), None),
    MethodValue("dp", "DP", 1.70, (0.4367, 0.4367), 0.836, None, 0.128, 1.0, 1.0),
    MethodValue(
        "ddqn", "Baseline DDQN (No Reward Shaping)", 0.30, (0.20, 0.25), 0.70, 9_000, 0.846
    ),
    MethodValue(
        "ddqn_shaped",
        "DDQN (Reward Shaping)",
        1.75,
        (0.43, 0.43),
        0.836,
        37_000,
        0.102,
        0.970,
        0.984,
    ),
    MethodValue(
        "ddqn_shaped_dp",
        "DDQN (Reward Shaping + DP Seeding)",
        1.75,
        (0.43, 0.43),
        0.836,
        25_000,
        0.102,
        0.970,
        0.984,
    ),
    MethodValue(
        "ddqn_shaped_mixed",
        "DDQN (Reward Shaping + RB and DP Seeding)",
        1.76,
        (0.43, 0.43),
        0.837,
        32_000,
        0.097,
        0.965,
        0.986,
    ),
)

SEEDING = (
    MethodValue("ddqn_shaped", "DDQN (No expert data)", 1.75, (0.43, 0.43), 0.836, 37_000),
    MethodValue("ddqn_shaped_dp", "DDQN (DP Data)", 1.75, (0.43, 0.43), 0.836, 25_000),
    MethodValue("ddqn_shaped_mixed", "DDQN (DP+RB Data)", 1.76, (0.43, 0.43), 0.837, 32_000),
)

CONVERGENCE = (
    Episodes("dqn", 40_000, "Deep Q-Network Result"),
    Episodes("ddqn", 9_000, "Deep Q-Network Result"),
    Episodes("ddqn_shaped", 37_000, "Reward Shaping Results"),
    Episodes("ddqn_shaped_dp", 25_000, "Preseeding Replay Buffer Results"),
    Episodes("ddqn_shaped_mixed", 32_000, "Pre-seeding Replay Buffer with Combined Data"),
    Episodes("ddqn_shaped_rule", 40_000, "Pre-seeding Replay Buffer with Combined Data"),
)

PERCENTAGES = Percentages()
SETTINGS = Settings()

DQN_DDQN_FUEL_GAL = 0.34
"""Fuel of DQN and of DDQN in the text ("Deep Q-Network Result"); Table 2 prints 0.30."""

UNSHAPED_EFFICIENCY = (0.20, 0.25)
"""Average thermal efficiency without shaping ("Deep Q-Network Result")."""

PEARSON = -0.213
"""Correlation between Q and reward of tabular double Q ("Results of Double Q-Learning")."""

PEARSON_SCALE: tuple[tuple[float, str], ...] = ((0.5, "strong"), (0.3, "moderate"), (0.0, "weak"))
"""Least |r| of each strength, strongest first; 1 is perfect, 0 is none."""


def episodes_of(row_id: str) -> int | None:
    """Printed episodes until convergence of a row of this study; None where none are printed."""
    return next((item.episodes for item in CONVERGENCE if item.id == row_id), None)


def episodes_text(episodes: float) -> str:
    """Episodes as the paper writes them: ``37,000``."""
    return f"{round(episodes):,}"


def percent_text(share: float, digits: int = 1) -> str:
    """A fraction as text: ``77.5 %``."""
    return f"{round(100.0 * share, digits) + 0.0:.{digits}f} %"  # + 0.0 turns -0.0 into 0.0
