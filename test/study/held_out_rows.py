"""Rows of a held-out study whose truth is known, without driving anything."""

from typing import Any

from tractor_ems.study.held_out_config import load_held_out
from tractor_ems.study.held_out_results import results_of

OPERATIONS = ("light", "heavy")
CYCLES = 6
SCORES = {
    "ddqn_counterfactual": 0.997,
    "ddqn_unplanned": 0.990,
    "ddqn_sampled": 0.980,
    "sdp": 0.9965,
    "sdp_unplanned": 0.992,
    "a_ecms": 0.985,
    "never_stop_ecms": 0.980,
    "load_levelling": 0.975,
    "dp": 0.9998,
}
"""Score of every run of a policy, but for a little that depends on the cycle alone."""

LEARNT = ("ddqn_counterfactual", "ddqn_unplanned", "ddqn_sampled")


def row(
    policy: str, seed: int | None, operation: str, number: int, score: float
) -> dict[str, Any]:
    """One run; the subject starts the engine twice."""
    return {
        "policy": policy,
        "seed": seed,
        "cycle": f"{operation}_{number}",
        "operation": operation,
        "hours": 0.5,
        "soc_initial": 0.55,
        "soc_target": 0.55,
        "fuel_kg": 3.0,
        "soc_final": 0.56,
        "soc_min": 0.45,
        "soc_max": 0.65,
        "engine_starts": 2,
        "engine_h": 0.3,
        "shortfall_j": 0.0,
        "dissipated_j": 0.0,
        "violations": 0,
        "dp_ratio": score - 1e-4 * number,
        "note": None,
    }


def found_rows(**scores: float) -> dict[str, Any]:
    """What a study would have found with these scores; see ``SCORES`` for the others."""
    config = load_held_out("held_out", "full")
    rows = [
        row(policy, seed, operation, number, score)
        for policy, score in {**SCORES, **scores}.items()
        for seed in (range(5) if policy in LEARNT else [None])
        for operation in OPERATIONS
        for number in range(CYCLES)
    ]
    training = [
        {
            "policy": policy,
            "seed": seed,
            "powertrain": "field",
            "episodes": 204,
            "transitions": 354_792,
            "seconds": 90.0 + seed,
            "cpu_s": 80.0,
            "read_s": 20.0,
            "peak_rss_bytes": 5e8,
            "file_sha256": "00",
        }
        for policy in LEARNT
        for seed in range(5)
    ]
    curve = [{**training[0], "episodes": n, "dp_ratio": [0.9, None]} for n in (1, 30)]
    settings = config.to_json()
    settings["budget"]["resamples"] = 100
    return {
        "settings": settings,
        "package_version": "0",
        "recorded": {"bags": 204, "transitions": 354_792, "cpu_s": 300.0},
        "training": training,
        "curve": curve,
        "rows": rows,
        "traces": {},
        "robustness_rows": [
            {
                "disturbance": disturbance,
                "policy": policy,
                "seed": None if policy == "never_stop_ecms" else 0,
                "cycle": f"light_{n}",
                "soc_final": 0.55,
                "shortfall_j": 0.0,
                "engine_starts": 1,
                "violations": 0,
                "dp_ratio": ratio,
            }
            for policy, ratios in (
                ("ddqn_counterfactual", (0.997, 0.996, 0.99)),
                ("never_stop_ecms", (0.980, 0.978, 0.979)),
            )
            for disturbance, ratio in zip(("none", "delay_1", "noise"), ratios, strict=True)
            for n in range(3)
        ],
        "transfer_rows": [],
    }


def results(**scores: float) -> dict[str, Any]:
    """The whole document of :func:`found_rows`."""
    return results_of(found_rows(**scores))
