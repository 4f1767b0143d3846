"""Pieces of work with a duration and a power, turned into equal steps of 1 s; noise on them."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray


@dataclass(frozen=True)
class Steps:
    """A drive at equal steps of 1 s.

    Attributes:
        power_w: mean over each step, shape (T,) [W].
        working: share of the step with the implement at work, shape (T,) 0..1.
        standing: share of the step at a stop, shape (T,) 0..1.
        distance_m: worked over the whole drive [m].
    """

    power_w: FloatArray
    working: FloatArray
    standing: FloatArray
    distance_m: float


def to_steps(
    duration_s: int,
    piece_s: FloatArray,
    piece_w: FloatArray,
    piece_m: FloatArray,
    working: FloatArray,
    standing: FloatArray,
) -> Steps:
    """Pieces in driving order, each shape (N,), averaged over steps: energy is conserved.

    Args:
        duration_s: T; the pieces must last at least as long [s].
        piece_s, piece_w, piece_m: duration, power and worked distance of each piece.
        working, standing: 0 or 1 for each piece.
    """
    ends = np.concatenate([[0.0], np.cumsum(piece_s)])
    if ends[-1] < duration_s:
        raise ValueError(f"pieces last {ends[-1]:.1f} s, {duration_s} s are needed")
    ticks = np.arange(duration_s + 1.0)

    def per_step(rate: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(rate * piece_s)])
        return np.diff(np.interp(ticks, ends, total))

    worked_m = np.concatenate([[0.0], np.cumsum(piece_m)])
    return Steps(
        per_step(piece_w),
        np.clip(per_step(working), 0.0, 1.0),
        np.clip(per_step(standing), 0.0, 1.0),
        float(np.interp(duration_s, ends, worked_m)),
    )


def autoregressive(rng: np.random.Generator, steps: int, coefficient: float) -> FloatArray:
    """AR(1) noise of mean 0 and sd 1, shape (steps,); 0 <= coefficient <= 0.98."""
    if coefficient <= 0.0:
        return rng.standard_normal(steps)
    reach = int(np.ceil(np.log(1e-4) / np.log(coefficient)))
    kernel = coefficient ** np.arange(reach + 1.0)
    white = rng.standard_normal(steps + reach)
    noise: FloatArray = np.convolve(white, kernel, mode="valid") * np.sqrt(1 - coefficient**2)
    return noise


def speed_profile(
    limit_m_per_s: FloatArray,
    cell_m: float,
    start_m_per_s: float,
    speed_up_m_per_s2: float,
    slow_down_m_per_s2: float,
) -> tuple[FloatArray, FloatArray]:
    """Fastest speed below a limit with bounded acceleration, along the last axis.

    v^2 grows by at most 2 a dx from cell to cell; both passes are running minima.

    Args:
        limit_m_per_s: per cell, shape (..., N) [m/s].
        cell_m: length of a cell [m].
        start_m_per_s: speed ahead of the first cell [m/s].
        speed_up_m_per_s2, slow_down_m_per_s2: bounds, > 0.

    Returns:
        Mean speed of each cell and acceleration in it, shape (..., N) each.
    """
    n = limit_m_per_s.shape[-1]
    square = np.asarray(limit_m_per_s) ** 2
    up = 2.0 * speed_up_m_per_s2 * cell_m * np.arange(1, n + 1)
    down = 2.0 * slow_down_m_per_s2 * cell_m * np.arange(n, 0, -1)
    forward = np.minimum.accumulate(square - up, axis=-1)
    forward = np.minimum(forward, start_m_per_s**2) + up
    backward = np.minimum.accumulate((forward - down)[..., ::-1], axis=-1)[..., ::-1] + down
    before = np.concatenate(
        [np.full((*square.shape[:-1], 1), start_m_per_s**2), backward[..., :-1]], axis=-1
    )
    acceleration = (backward - before) / (2.0 * cell_m)
    return (np.sqrt(backward) + np.sqrt(before)) / 2.0, acceleration
