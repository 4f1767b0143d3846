"""A day in half an hour: road, yard, light and heavy field work and waiting, in random order."""

from collections.abc import Callable

import numpy as np

from tractor_sim.duty_cycle.field_work.params import Mixed
from tractor_sim.duty_cycle.field_work.timeline import Steps

Drive = Callable[[float], Steps]


def draw_mixed(
    rng: np.random.Generator,
    work: Mixed,
    duration_s: int,
    draw: Callable[[np.random.Generator, str, int], Drive],
) -> list[tuple[str, int, Drive]]:
    """The parts in driving order: operation, seconds, and its drive under a cap.

    Args:
        rng: draws shares, order and one operation per part.
        work: the parts; one without operations is waiting.
        duration_s: shared out among the parts.
        draw: (rng, operation, seconds) to a drive.
    """
    shares = np.array([rng.uniform(*part.share) for part in work.parts])
    order = rng.permutation(len(work.parts))
    ends = np.round(np.cumsum(shares[order]) / shares.sum() * duration_s).astype(int)
    seconds = np.diff(np.concatenate([[0], ends]))
    parts: list[tuple[str, int, Drive]] = []
    for index, part_s in zip(order.tolist(), seconds.tolist(), strict=True):
        if part_s == 0:
            continue
        names = work.parts[index].operations
        name = str(rng.choice(names)) if names else "waiting"
        drive = draw(rng, name, part_s) if names else _waiting(work.idle_w, part_s)
        parts.append((name, part_s, drive))
    return parts


def _waiting(idle_w: float, seconds: int) -> Drive:
    def drive(cap_w: float) -> Steps:
        power = np.full(seconds, min(idle_w, cap_w))
        return Steps(power, np.zeros(seconds), np.ones(seconds), 0.0)

    return drive


def joined(parts: list[tuple[str, int, Drive]], cap_w: float) -> Steps:
    """All parts under one cap, one after another."""
    driven = [drive(cap_w) for _, _, drive in parts]
    return Steps(
        np.concatenate([steps.power_w for steps in driven]),
        np.concatenate([steps.working for steps in driven]),
        np.concatenate([steps.standing for steps in driven]),
        sum(steps.distance_m for steps in driven),
    )
