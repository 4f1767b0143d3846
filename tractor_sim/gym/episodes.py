"""The duty cycles that episodes drive, loaded when first drawn, in one array for look-ups."""

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.duty_cycle.library import generate_cycle, load_cycle
from tractor_sim.gym.settings import Settings, episode_names
from tractor_sim.powertrain import PowertrainParams


class Episodes:
    """Cycles by row.

    Attributes:
        names: of the cycles loaded so far, by row.
        power_demand_w: (rows, longest), at the bus with the plant's auxiliaries; beyond a cycle's
            last step its last demand goes on [W].
        steps: length of each row.
    """

    def __init__(self, settings: Settings, params: PowertrainParams) -> None:
        self._names_by_operation = episode_names(settings)
        self._generated = set(settings.operations or ())
        self._params = params
        self._row: dict[str, int] = {}
        self.names: list[str] = []
        self.power_demand_w: FloatArray = np.zeros((0, 0))
        self.steps: IntArray = np.zeros(0, dtype=np.int64)

    def draw(self, rng: np.random.Generator) -> int:
        """Row of a drawn cycle: an operation, each as likely, and then a cycle of it."""
        operations = list(self._names_by_operation)
        operation = operations[int(rng.integers(len(operations)))]
        names = self._names_by_operation[operation]
        return self.row(names[int(rng.integers(len(names)))])

    def row(self, name: str) -> int:
        """Row of a cycle by name.

        Raises:
            CycleError: no such cycle.
            ConfigError: its step length is not the powertrain's.
        """
        if name not in self._row:
            self._add(name, self._load(name))
        return self._row[name]

    def _load(self, name: str) -> DutyCycle:
        operation, _, seed = name.rpartition("_")
        if operation in self._generated:
            return generate_cycle(operation, int(seed))
        return load_cycle(name)

    def _add(self, name: str, cycle: DutyCycle) -> None:
        if abs(cycle.dt_s - self._params.dt_s) > 1e-9:
            raise ConfigError(
                f"SeriesHybrid: cycle {name} has dt_s {cycle.dt_s}, powertrain "
                f"{self._params.name} allows {self._params.dt_s}"
            )
        row, steps = len(self.names), len(cycle)
        rows, longest = self.power_demand_w.shape
        if row == rows or steps > longest:
            grown = np.zeros((max(2 * rows, row + 1), max(longest, steps)))
            grown[:rows, :longest] = self.power_demand_w
            if longest:
                grown[:rows, longest:] = self.power_demand_w[:, -1:]
            self.power_demand_w = grown
            self.steps = np.concatenate((self.steps, np.zeros(len(grown) - rows, dtype=np.int64)))
        demand_w = cycle.power_demand_w + self._params.p_aux_w
        self.power_demand_w[row, :steps] = demand_w
        self.power_demand_w[row, steps:] = demand_w[-1]
        self.steps[row] = steps
        self.names.append(name)
        self._row[name] = row
