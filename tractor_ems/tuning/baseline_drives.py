"""One setting of a baseline over many cycles: compiled where there is a loop, else batched."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.optimal.sdp import cell_of
from tractor_ems.optimal.sdp_fit import Machine, features_of, machine_of
from tractor_ems.policies.a_ecms import AEcms
from tractor_ems.policies.baselines import TUNED_ONLY, make_baseline
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.sdp import SdpPolicy
from tractor_ems.tuning import closed_loop
from tractor_ems.tuning.dev_set import bus_demand_w
from tractor_ems.tuning.sdp_bags import sdp_of_demand, sdp_settings
from tractor_msgs_py.observation import DemandFilter
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.batch import batch_plant
from tractor_sim.powertrain import PowertrainParams

_NO_TRACE = np.zeros((0, 3))

TOTALS = 9
"""Columns of ``closed_loop``; those a batched drive does not fill stay 0."""


@lru_cache(maxsize=4)
def _machine(params: PowertrainParams) -> Machine:
    return machine_of(params)


def baseline_policy(
    name: str,
    params: PowertrainParams,
    settings: Mapping[str, Any],
    train: Sequence[str],
) -> Policy:
    """The policy behind a name and settings; stochastic DP is fitted to the ``train`` cycles.

    Raises:
        ConfigError, PolicyError: the settings are wrong.
    """
    if name not in TUNED_ONLY:
        return make_baseline(name, params, settings)
    chosen = sdp_settings(params, planned=name == "sdp", given=settings)
    return sdp_of_demand(params, [bus_demand_w(n, params.p_aux_w) for n in train], chosen)


def drive_all(
    policy: Policy, params: PowertrainParams, demands_w: Sequence[FloatArray], soc: float
) -> FloatArray:
    """Totals (cycles, :data:`TOTALS`) of a policy that starts at ``soc`` and should end there."""
    if isinstance(policy, AEcms):
        return _drive_ecms(policy, params, demands_w, soc)
    if isinstance(policy, SdpPolicy):
        return _drive_sdp(policy, params, demands_w, soc)
    return _drive_batched(policy, params, demands_w, soc)


def _left_s(params: PowertrainParams, demand_w: FloatArray) -> FloatArray:
    left: FloatArray = np.arange(len(demand_w), 0, -1.0) * params.dt_s
    return left


def _drive_ecms(
    policy: AEcms, params: PowertrainParams, demands_w: Sequence[FloatArray], soc: float
) -> FloatArray:
    machine, totals = _machine(params), np.zeros((len(demands_w), TOTALS))
    settings = np.array(
        [
            policy.equivalence / params.engine.fuel_lhv_j_per_kg,
            policy.soc_gain,
            policy.adapt,
            params.engine.start_fuel_kg / policy.write_off_s,
            0.0,
            policy.stiffen_s,
        ]
    )
    slow_w: Sequence[FloatArray] = demands_w
    if policy.decide_s > 0.0:
        smoothing = (DemandFilter("low_pass", policy.decide_s),)
        seen = features_of(smoothing, demands_w, params.dt_s)
        slow_w = [np.ascontiguousarray(columns[:, 1]) for columns in seen]
    for row, demand_w, decides_w in zip(totals, demands_w, slow_w, strict=True):
        closed_loop.drive_ecms(
            *batch_plant(params), machine.cell, machine.fuel_kg, machine.engine_max_w, demand_w,
            decides_w, _left_s(params, demand_w), soc, soc, settings, row, _NO_TRACE,
        )  # fmt: skip
    return totals


def _drive_sdp(
    policy: SdpPolicy, params: PowertrainParams, demands_w: Sequence[FloatArray], soc: float
) -> FloatArray:
    machine, totals = _machine(params), np.zeros((len(demands_w), TOTALS))
    features = features_of(policy.filters, demands_w, params.dt_s)
    for row, demand_w, seen in zip(totals, demands_w, features, strict=True):
        place = policy.number[cell_of(policy.edges, seen)]
        closed_loop.drive_table(
            *batch_plant(params), machine.cell, machine.fuel_kg, machine.engine_max_w, demand_w,
            place, _left_s(params, demand_w), soc, soc, policy.price_kg, policy.start_kg,
            policy.gamma, policy.times_s, policy.offset, policy.value_kg, row, _NO_TRACE,
        )  # fmt: skip
    return totals


def _drive_batched(
    policy: Policy, params: PowertrainParams, demands_w: Sequence[FloatArray], soc: float
) -> FloatArray:
    """All cycles at once, the shorter ones going on with their last demand and cut afterwards:
    for policies that see neither the future nor a planned end."""
    longest = max(map(len, demands_w))
    padded = np.stack([np.pad(d, (0, longest - len(d)), mode="edge") for d in demands_w])
    totals = np.zeros((len(demands_w), TOTALS))
    runs = drive(policy, params, padded, soc, soc)
    for row, run, demand_w in zip(totals, runs, demands_w, strict=True):
        steps = len(demand_w)
        on, socs = run.engine_on[:steps], np.append(run.soc, run.soc_final)[: steps + 1]
        row[closed_loop.FUEL] = run.fuel_kg[:steps].sum()
        row[closed_loop.STARTS] = np.count_nonzero(on & ~np.append(False, on[:-1]))
        row[closed_loop.SHORTFALL] = run.shortfall_j[:steps].sum()
        row[closed_loop.SOC_FINAL] = socs[-1]
        row[closed_loop.ON_STEPS] = np.count_nonzero(on)
        row[closed_loop.SOC_LOW], row[closed_loop.SOC_HIGH] = socs.min(), socs.max()
        row[closed_loop.ENGINE_J] = run.engine_power_w[:steps].sum() * params.dt_s
    return totals
