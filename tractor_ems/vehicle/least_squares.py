"""Linear least squares with coefficients >= 0, and standard errors that trust no residual.

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
    columns = design.shape[1]
    unbounded = np.zeros(columns, dtype=bool) if free is None else free
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = design / scale
    q, r = np.linalg.qr(scaled)
    passive, x = _active_set(r, q.T @ target, unbounded)
    residual = target - scaled @ x
    correlation = lag_one(residual)
    inflation = (1.0 + correlation) / (1.0 - correlation)
    covariance = np.zeros((columns, columns))
    held = _covariance(q, r[:, passive], residual, resolution) * inflation
    covariance[np.ix_(passive, passive)] = held
    unheld = np.diag(_covariance(q, r, residual, resolution)) * inflation
    error = np.sqrt(np.maximum(np.where(passive, np.diag(covariance), unheld), 0.0))
    return Solution(
        coefficients=x / scale,
        error=error / scale,
        covariance=covariance / np.outer(scale, scale),
        residual=residual,
        correlation=correlation,
    )


def _covariance(
    q: FloatArray, r: FloatArray, residual: FloatArray, resolution: float
) -> FloatArray:
    """Covariance over the columns of q r, which does not take all residuals for equally large: a
    fuel meter is wrong by a share. HC3 of MacKinnon and White, J. Econometrics 29 (1985)."""
    turn, triangle = np.linalg.qr(r)
    basis = q @ turn
    leverage = np.minimum(np.sum(basis**2, axis=1), 1.0 - 1e-6)
    weight = (residual / (1.0 - leverage)) ** 2 + resolution**2 / 12.0
    inverse = np.linalg.pinv(triangle)
    covariance: FloatArray = inverse @ (basis.T @ (basis * weight[:, None])) @ inverse.T
    return covariance


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
    """Knots from the least to the largest x, ``spacing`` apart or more: between two of them lie
    at least ``least`` different values. Shape (K,), K >= 1 for any samples at all.

    Values closer than a tenth of ``spacing`` are not different: a power held for a minute says
    nothing about the slope around it.
    """
    values = np.unique(np.round(x / (0.1 * spacing))) * (0.1 * spacing)
    low, high = float(x.min()), float(x.max())
    knots = [low]
    for edge in np.arange(low + spacing, high, spacing):
        if np.sum((values >= knots[-1]) & (values < edge)) >= least:
            knots.append(float(edge))
    while len(knots) > 1 and np.sum(values >= knots[-1]) < least:
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
