"""The score of a run: fuel of the optimum that ends where the run ended, over the run's fuel."""

import math

from tractor_ems.optimal.certificate import certify
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams


def dp_ratio(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_final: float,
    run_fuel_kg: float,
    *,
    shortfall_j: float = 0.0,
    soc_points: int = 201,
    actions: int = 101,
) -> float | None:
    """The matched-SOC DP ratio of one run, at most 1 up to grid error.

    Solves for the run's own start and final SOC on a grid that a certificate chooses; nothing is
    interpolated over final SOC, and no linear SOC correction is made. With engine state the
    reference is the lower bound, which no run of the plant can beat; the bracket, which says how
    much too hard that may be, is not part of it.

    Args:
        power_demand_w: (T,), demand at the bus that the run drove, auxiliaries included [W].
        soc_initial, soc_final: of the run.
        run_fuel_kg: what it burnt; a run that burnt nothing cannot be beaten and scores 1.
        shortfall_j: demand it left unmet.
        soc_points, actions: the coarsest grid the certificate may choose; a plant with engine
            state has grids of its own.

    Returns:
        The ratio, or None where the run had shortfall: undelivered work must not score.

    Raises:
        ConfigError: a SOC is out of range or cannot be reached on this cycle, or the fuel is not
            a finite number >= 0.
        TractorEmsError: no grid within reach could be certified.
    """
    if not (math.isfinite(run_fuel_kg) and run_fuel_kg >= 0.0):
        raise ConfigError(f"run_fuel_kg: {run_fuel_kg}, allowed finite and >= 0")
    if shortfall_j > 0.0:
        return None
    if run_fuel_kg == 0.0:
        return 1.0
    certificate = certify(
        params,
        power_demand_w,
        soc_initial,
        soc_final,
        soc_points=soc_points,
        actions=actions,
        bracket=False,
    )
    if not certificate.ok:
        raise TractorEmsError(
            f"dp_ratio: not certified with {certificate.soc_points} SOC points: halving changes "
            f"the fuel by {certificate.grid_halving_change:.2%}, the roll-out is "
            f"{certificate.rollout_gap:.2%} off, the residual is {certificate.residual:.2%}"
        )
    return certificate.fuel_kg / run_fuel_kg
