"""Replay: transitions in a FIFO, seeded from bags with distinct transitions only.

Feasible sets are stored as two integers per transition, never as a mask of all actions.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.errors import ConfigError

_DTYPES: dict[str, Any] = {
    "action": np.int64,
    "reward": np.float32,
    "discount": np.float32,
    "first": np.int16,
    "last": np.int16,
    "next_first": np.int16,
    "next_last": np.int16,
}


@dataclass(frozen=True)
class Transitions:
    """N transitions, every column with a leading axis of N.

    Attributes:
        inputs, next_inputs: network inputs, shape (N, F), float32.
        action: grid index of the power that was applied.
        reward: in reward units, float32.
        discount: gamma, or 0 where the next state is terminal. The end of a cycle is a
            truncation: its last step has no successor and is not stored.
        first, last: feasible actions of the state, inclusive; next_first, next_last: of the next.
    """

    inputs: NDArray[np.float32]
    action: NDArray[np.int64]
    reward: NDArray[np.float32]
    discount: NDArray[np.float32]
    next_inputs: NDArray[np.float32]
    first: NDArray[np.int16]
    last: NDArray[np.int16]
    next_first: NDArray[np.int16]
    next_last: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.action)

    def take(self, index: NDArray[np.int64]) -> "Transitions":
        """The transitions at ``index``."""
        return Transitions(**{name: column[index] for name, column in columns(self).items()})


def columns(transitions: Transitions) -> dict[str, NDArray[Any]]:
    """Columns by name."""
    return {field.name: getattr(transitions, field.name) for field in fields(Transitions)}


def concatenate(parts: list[Transitions], inputs: int) -> Transitions:
    """One after the other; no part gives an empty set of ``inputs`` inputs."""
    joined = {}
    for field in fields(Transitions):
        wide = field.name.endswith("inputs")
        empty = np.zeros((0, inputs) if wide else 0, _DTYPES.get(field.name, np.float32))
        joined[field.name] = np.concatenate([empty, *(getattr(p, field.name) for p in parts)])
    return Transitions(**joined)


class Replay:
    """A FIFO of at most ``capacity`` transitions; the oldest are overwritten first."""

    def __init__(self, capacity: int, inputs: int) -> None:
        self.capacity, self.size, self.next = capacity, 0, 0
        shapes = {"inputs": (capacity, inputs), "next_inputs": (capacity, inputs)}
        self.columns = {
            field.name: np.zeros(
                shapes.get(field.name, (capacity,)), _DTYPES.get(field.name, np.float32)
            )
            for field in fields(Transitions)
        }

    def __len__(self) -> int:
        return self.size

    def add(self, transitions: Transitions) -> None:
        """Append; of more than ``capacity`` at once the last ones stay."""
        count = len(transitions)
        slots = (self.next + np.arange(count)) % self.capacity
        kept = slice(max(count - self.capacity, 0), count)
        for name, column in columns(transitions).items():
            self.columns[name][slots[kept]] = column[kept]
        self.next = (self.next + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, rng: np.random.Generator, batch: int) -> Transitions:
        """``batch`` transitions, uniformly with replacement.

        Raises:
            ConfigError: there is nothing to draw from.
        """
        if not self.size:
            raise ConfigError(
                "replay: empty; targets sampled needs bags with powertrain states, or interact > 0"
            )
        index = rng.integers(0, self.size, batch)
        return Transitions(**{name: column[index] for name, column in self.columns.items()})

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The filled part, for a checkpoint."""
        return {f"replay.{name}": column[: self.size] for name, column in self.columns.items()}

    def restore(self, tensors: dict[str, Any], size: int, following: int) -> None:
        """Inverse of :meth:`tensors`."""
        self.size, self.next = size, following
        for name, column in self.columns.items():
            column[:size] = tensors[f"replay.{name}"]


@dataclass(frozen=True)
class Seeding:
    """What the bags gave.

    Attributes:
        wanted: share of the capacity asked for, as a count.
        available: transitions the bags hold.
        distinct: how many of them differ from all others.
        seeded: how many went in: min(wanted, distinct).
        share: seeded over capacity.
    """

    wanted: int
    available: int
    distinct: int
    seeded: int
    share: float


def distinct_rows(transitions: Transitions) -> NDArray[np.int64]:
    """Indices of the first occurrence of every distinct transition, ascending.

    Two recordings of one run hold the same transitions; a buffer that repeats them would learn
    from fewer than it reports.
    """
    if not len(transitions):
        return np.zeros(0, dtype=np.int64)
    parts = [
        np.ascontiguousarray(column).reshape(len(transitions), -1).view(np.uint8)
        for column in columns(transitions).values()
    ]
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1))
    keys = rows.view(np.dtype((np.void, rows.shape[1]))).reshape(-1)
    _, index = np.unique(keys, return_index=True)
    return np.sort(index).astype(np.int64)


def draw_seeds(
    transitions: Transitions, share: float, capacity: int, rng: np.random.Generator
) -> tuple[Transitions, Seeding]:
    """Distinct transitions for ``share`` of a buffer, drawn without replacement.

    Fewer than that seed what there is; none is ever repeated.
    """
    wanted = round(share * capacity)
    distinct = distinct_rows(transitions)
    chosen = rng.permutation(distinct)[:wanted]
    return transitions.take(chosen), Seeding(
        wanted, len(transitions), len(distinct), len(chosen), len(chosen) / capacity
    )
