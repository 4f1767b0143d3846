"""Where SOC can get to: compiled loops over the battery alone, on ``engine_kernel``'s model."""

from numba import njit

from tractor_ems.optimal.engine_kernel import (
    ROUNDING_W,
    Model,
    Numbers,
    limits_w,
    open_circuit_v,
    soc_after,
)
from tractor_msgs_py.trajectory import FloatArray


@njit(cache=True, error_model="numpy", forceinline=True)
def extremes_w(numbers: Numbers, soc: float, ocv_v: float, demand_w: float) -> tuple[float, float]:
    """Battery power with the engine at its maximum and standing still, as far as limits let."""
    charge, discharge = limits_w(numbers, soc, ocv_v)
    most = max(min(demand_w - numbers.engine_max_w, discharge), -charge)
    return most, max(min(demand_w, discharge), -charge)


@njit(cache=True, error_model="numpy")
def follow(model: Model, battery_w: FloatArray, soc: float) -> tuple[float, float]:
    """Drive battery powers (T,) from ``soc``: where they end, and the sum of what the battery
    could not give [W]; what it cannot take is dissipated."""
    numbers, ocv, short_w = model.numbers, model.ocv, 0.0
    for wanted_w in battery_w:
        ocv_v = open_circuit_v(ocv, soc)
        charge, discharge = limits_w(numbers, soc, ocv_v)
        if wanted_w > discharge + ROUNDING_W:
            short_w += wanted_w - discharge
        soc = soc_after(numbers, soc, ocv_v, max(min(wanted_w, discharge), -charge))
    return soc, short_w


@njit(cache=True, error_model="numpy")
def reachable(
    model: Model, demand_w: FloatArray, soc_initial: float, low: FloatArray, high: FloatArray
) -> None:
    """Fill (T + 1,) each with the lowest and highest SOC of all runs from ``soc_initial``."""
    numbers, ocv = model.numbers, model.ocv
    low[0] = high[0] = soc_initial
    for k in range(len(demand_w)):
        for row, most in ((low, False), (high, True)):
            ocv_v = open_circuit_v(ocv, row[k])
            charged, still = extremes_w(numbers, row[k], ocv_v, demand_w[k])
            row[k + 1] = soc_after(numbers, row[k], ocv_v, charged if most else still)


@njit(cache=True, error_model="numpy")
def of_use(model: Model, demand_w: FloatArray, low: FloatArray, high: FloatArray) -> None:
    """Fill rows 0..T-1 from row T: the lowest SOC from which ``low`` of the next step is reached
    with all of the demand met, the highest from which ``high`` is not overshot."""
    numbers, ocv = model.numbers, model.ocv
    for k in range(len(demand_w) - 1, -1, -1):
        for row, most in ((low, True), (high, False)):
            begin, end = numbers.soc_min, numbers.soc_max
            _, at_best = limits_w(numbers, end, open_circuit_v(ocv, end))
            avoidable = demand_w[k] - numbers.engine_max_w <= at_best + ROUNDING_W
            for _ in range(60):
                soc = 0.5 * (begin + end)
                ocv_v = open_circuit_v(ocv, soc)
                charged, still = extremes_w(numbers, soc, ocv_v, demand_w[k])
                after = soc_after(numbers, soc, ocv_v, charged if most else still)
                if most:
                    _, discharge = limits_w(numbers, soc, ocv_v)
                    short = demand_w[k] - numbers.engine_max_w > discharge + ROUNDING_W
                    low_soc = (short and avoidable) or after < row[k + 1]
                    begin, end = (soc, end) if low_soc else (begin, soc)
                else:
                    begin, end = (soc, end) if after <= row[k + 1] else (begin, soc)
            row[k] = end if most else begin
