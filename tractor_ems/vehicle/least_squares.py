"""Linear least squares with coefficients >= 0, and standard errors that admit to correlation.

Convex and monotone curves are sums of hinges with such coefficients. Active sets after Lawson and
Hanson, Solving Least Squares Problems (1974), chapter 23, on the triangular factor of the design,
so that the number of samples costs nothing but the factorisation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import FloatArray

MAX_CORRELATION = 0.999


@dataclass(frozen=True)
class Solution:
    """Coefficients of N samples over P columns.

    Attributes:
        coefficients: shape (P,), >= 0 where that was asked for.
        covariance: of the coefficients, shape (P, P); those that a bound holds at 0 have none.
        error: standard errors, shape (P,); of a coefficient at its bound that which it would have
            without bounds.
        residual: shape (N,); correlation: of each with the next, 0..1.
    """

    coefficients: FloatArray
    covariance: FloatArray
    error: FloatArray
    residual: FloatArray
    correlation: float

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def predict(self, design: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values and standard errors at rows of a design, each of shape (rows,)."""
        variance = np.einsum("ij,jk,ik->i", design, self.covariance, design)
        return design @ self.coefficients, np.sqrt(np.maximum(variance, 0.0))


def solve(
    design: FloatArray,
    target: FloatArray,
    free: NDArray[np.bool_] | None = None,
    resolution: float = 0.0,
) -> Solution:
    """Least squares with coefficients >= 0, apart from those that are ``free``.

    Args:
        design: shape (N, P), rows in order of time; N > P.
        target: shape (N,).
        free: shape (P,), columns without a bound; None: none of them.
        resolution: step in which the target was recorded; no error comes out below its share.
    """
    count, columns = design.shape
    unbounded = np.zeros(columns, dtype=bool) if free is None else free
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    q, r = np.linalg.qr(design / scale)
    passive, scaled = _active_set(r, q.T @ target, unbounded)
    residual = target - (design / scale) @ scaled
    spare = max(count - int(passive.sum()), 1)
    correlation = lag_one(residual)
    variance = max(float(residual @ residual) / spare, resolution**2 / 12.0)
    inflated = variance * (1.0 + correlation) / (1.0 - correlation)
    covariance = np.zeros((columns, columns))
    part = r[:, passive]
    covariance[np.ix_(passive, passive)] = np.linalg.pinv(part.T @ part) * inflated
    at_bound = np.sqrt(np.maximum(np.diag(np.linalg.pinv(r.T @ r)), 0.0) * inflated)
    error = np.where(passive, np.sqrt(np.maximum(np.diag(covariance), 0.0)), at_bound)
    return Solution(
        coefficients=scaled / scale,
        error=error / scale,
        covariance=covariance / np.outer(scale, scale),
        residual=residual,
        correlation=correlation,
    )


def hinges(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Columns max(x - knot, 0), shape (len(x), len(knots))."""
    columns: FloatArray = np.maximum(x[:, None] - knots[None, :], 0.0)
    return columns


def misfit_at(knots: FloatArray, x: FloatArray, residual: FloatArray) -> FloatArray:
    """Root mean square of the residuals in the cells that meet at each knot, shape (K,): what a
    straight line inside a cell cannot follow, which no standard error knows of."""
    edges = np.concatenate((knots[:1], knots, knots[-1:]))
    misfit = np.zeros(len(knots))
    for k in range(len(knots)):
        near = residual[(x >= edges[k]) & (x <= edges[k + 2])]
        misfit[k] = np.sqrt(np.mean(near**2)) if len(near) else 0.0
    return misfit


def knots_where_sampled(x: FloatArray, spacing: float, least: int = 5) -> FloatArray:
    """Knots from the least to the largest x, ``spacing`` apart or more: each cell holds at least
    ``least`` samples of which two differ. Shape (K,), K >= 1 for any samples at all."""
    ordered = np.sort(x)
    low, high = float(ordered[0]), float(ordered[-1])
    knots = [low]
    for edge in np.arange(low + spacing, high, spacing):
        inside = ordered[(ordered >= knots[-1]) & (ordered < edge)]
        if len(inside) >= least and inside[-1] - inside[0] > 0.1 * spacing:
            knots.append(float(edge))
    while len(knots) > 1 and np.sum(ordered >= knots[-1]) < least:
        knots.pop()
    return np.array([*knots, high] if high > low else knots)


def lag_one(residual: FloatArray) -> float:
    """Correlation of each residual with the next, 0 for none or less than none."""
    if len(residual) < 3:
        return 0.0
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if power <= 0.0:
        return 0.0
    return float(np.clip(centred[1:] @ centred[:-1] / power, 0.0, MAX_CORRELATION))


def _active_set(
    design: FloatArray, target: FloatArray, free: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which columns are not held at 0, and the coefficients."""
    columns = design.shape[1]
    passive, x = free.copy(), np.zeros(columns)
    if passive.any():
        x[passive] = np.linalg.lstsq(design[:, passive], target, rcond=None)[0]
    tolerance = 1e-10 * max(float(np.abs(design.T @ target).max()), 1e-300)
    for _ in range(5 * columns):
        gradient = design.T @ (target - design @ x)
        candidates = np.where(passive, -np.inf, gradient)
        enters = int(np.argmax(candidates))
        if candidates[enters] <= tolerance:
            break
        passive[enters] = True
        while True:
            trial = np.zeros(columns)
            trial[passive] = np.linalg.lstsq(design[:, passive], target, rcond=None)[0]
            wrong = passive & ~free & (trial <= 0.0)
            if not wrong.any():
                break
            share = np.min(x[wrong] / np.maximum(x[wrong] - trial[wrong], 1e-300))
            x = x + share * (trial - x)
            passive &= free | (x > 1e-14 * max(float(np.abs(x).max()), 1e-300))
        x = trial
    return passive, x
