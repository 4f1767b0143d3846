"""A learned policy for engines that start slowly: a network says whether the engine should run or
stand and what SOC is worth; the known plant gives the power of a running engine.

numpy only. Training: ``learning.run_or_stand``.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.mlp import Float32Array, Mlp, forward
from tractor_ems.policies.one_step import (
    Held,
    cheapest,
    command_of,
    hold,
    not_held,
    running_range_w,
)
from tractor_ems.policies.q_policy import Normalisation, demand_inputs, soc_input
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import Command, PowertrainParams

SLOPE_STEP = 0.01
"""Half the SOC over which the slope of the value is taken."""


@dataclass(frozen=True)
class RunOrStand:
    """Runs or stands by the sign of the mean G of its networks; see ``learning.run_or_stand``.

    Attributes:
        params: the powertrain it was made for.
        spec: demand filters that it sees.
        nets: networks of (demand inputs, SOC error) with outputs V and G [units]; more than one
            are averaged.
        scaling: input normalisation.
        price_kg: of one unit of SOC; start_kg: of a start; unit_kg: cost that networks see as 1.

    Raises PolicyError where a network does not fit the spec.
    """

    params: PowertrainParams
    spec: ObservationSpec
    nets: tuple[Mlp, ...]
    scaling: Normalisation
    price_kg: float
    start_kg: float
    unit_kg: float = 0.010
    name: str = "ddqn_run_or_stand"

    def __post_init__(self) -> None:
        wanted = (2 + len(self.spec.filters), 2)
        for net in self.nets:
            if (net.inputs, net.outputs) != wanted:
                raise PolicyError(
                    f"network maps {net.inputs} inputs to {net.outputs} outputs, {self.name} with "
                    f"this observation needs {wanted[0]} to {wanted[1]}"
                )
        if not self.nets:
            raise PolicyError(f"{self.name}: no network")

    def init(self, batch: int) -> Held:
        """No demand seen."""
        return not_held(batch)

    def act(self, observation: Observation, state: Held) -> tuple[Command, Held]:
        """Run at the cheapest power, or stand."""
        params, demand_w = self.params, observation.power_demand_w
        demand = demand_inputs(self.scaling, demand_w, observation.features)
        v, g = self._values(demand, observation.soc, observation.soc_target)
        value = np.minimum(v, v - g) * self.unit_kg
        slope = (value[:, 2] - value[:, 0]) / (2.0 * SLOPE_STEP)
        per_soc = (self.price_kg - slope)[:, None]

        def after(battery_w: FloatArray) -> FloatArray:
            soc = np.broadcast_to(observation.soc[:, None], battery_w.shape)
            cost: FloatArray = per_soc * (
                soc - soc_after(params.battery, soc, battery_w, params.dt_s)
            )
            return cost

        least_w, most_w, may_run, may_be_off = running_range_w(params, observation)
        engine_w, _ = cheapest(params, demand_w, least_w, most_w, after)
        kept, held = hold(params, observation, state)
        wants = g[:, 1] < np.where(observation.engine_on, 0.0, -self.start_kg / self.unit_kg)
        run = (wants | kept | ~may_be_off) & may_run
        return command_of(demand_w, engine_w, run), held

    def _values(
        self, demand: Float32Array, soc: FloatArray, soc_target: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean V and G at SOC - step, SOC, SOC + step, (B, 3) each [units]."""
        steps = SLOPE_STEP * np.array([-1.0, 0.0, 1.0])
        error = soc_input(self.scaling, soc[:, None] + steps, soc_target[:, None])
        rows = np.concatenate((np.repeat(demand, 3, axis=0), error.reshape(-1, 1)), axis=1)
        outputs = [forward(net, rows).reshape(len(soc), 3, 2) for net in self.nets]
        mean: FloatArray = np.mean(np.stack(outputs), axis=0, dtype=np.float64)
        return mean[..., 0], mean[..., 1]
