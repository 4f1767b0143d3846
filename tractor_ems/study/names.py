"""What readers call rows, drives and rewards: one name each for tables, claims and figures."""

from collections.abc import Iterable, Mapping

SOC_MINS = (0.70, 0.836)
"""The paper's final SOC of 70 % and of 83.6 % need different lower limits: shaped rows run at
both."""

ROW_NAMES: Mapping[str, str] = {
    "q": "Q-learning",
    "double_q": "double Q-learning",
    "double_q_interpolated": "double Q, interpolated",
    "dqn": "DQN",
    "ddqn": "DDQN",
    "ddqn_soft_target": "DDQN, soft target",
    "ddqn_fuel_knots": "DDQN, engine knots",
    "ddqn_shaped": "DDQN, shaped",
    "ddqn_shaped_dp": "DDQN, shaped, DP seeds",
    "ddqn_shaped_mixed": "DDQN, shaped, DP + rule seeds",
    "ddqn_shaped_rule": "DDQN, shaped, rule seeds",
    "ddqn_shaped_continuous_soc": "DDQN, shaped, continuous SOC",
    "ddqn_shaped_knots": "DDQN, shaped, engine knots",
    "ddqn_shaped_dp_kept": "DDQN, shaped, DP kept",
    "ddqn_shaped_dp_margin": "DDQN, shaped, DP kept, margin",
    "ddqn_corrected": "DDQN, corrected reward",
    "ddqn_corrected_knots": "DDQN, corrected, engine knots",
}

BASELINE_NAMES: Mapping[str, str] = {
    "conventional": "conventional",
    "dp": "DP, least fuel to 83.6 %",
    "best_point": "best point (engine at its best power)",
    "rule_based": "rule base (engine above 110 kW)",
    "random_feasible": "random feasible",
    "myopic": "myopic greedy on the reward",
    "optimum": "exact optimum of the reward",
}

REWARD_NAMES: Mapping[str, str] = {
    "fuel": "fuel",
    "piecewise": "shaped, as printed",
    "piecewise_corrected": "shaped, corrected",
    "equivalent_fuel": "equivalent fuel",
}


def row_name(key: str) -> str:
    """What a reader calls the row of this key."""
    name = key.split("@")[0]
    return ROW_NAMES.get(name, name)


def soc_min_of(key: str) -> float:
    """SOC_min of a row key."""
    return float(key.split("@")[1])


def soc_min_text(soc_min: float) -> str:
    """``70 %``, ``83.6 %``: the only way in which SOC_min is written."""
    return f"{round(100.0 * soc_min, 4):g} %"


def full_name(key: str) -> str:
    """``DDQN, SOC_min 70 %``."""
    return f"{row_name(key)}, SOC_min {soc_min_text(soc_min_of(key))}"


def names_within(keys: Iterable[str]) -> dict[str, str]:
    """Names of rows that are spoken of together; SOC_min only where they differ in it."""
    found = list(keys)
    same = len({soc_min_of(key) for key in found}) == 1
    return {key: row_name(key) if same else full_name(key) for key in found}


def reward_name(reward: str) -> str:
    """What a reader calls a reward."""
    return REWARD_NAMES.get(reward, reward)
