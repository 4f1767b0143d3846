"""What the ground does along a field: soil patches that come back on the next pass, and slope."""

import numpy as np

from tractor_msgs_py.trajectory import FloatArray


def patches(
    rng: np.random.Generator,
    passes: int,
    cells: int,
    *,
    cell_m: float,
    length_m: float,
    spacing_m: float,
) -> FloatArray:
    """A smooth random field of mean 0 and sd 1 over (pass, place), shape (passes, cells).

    Places are field coordinates, not time: pass j and j + 1 meet the same patch. Correlation is
    Gaussian along the pass and exp(-spacing / length) across.
    """
    reach = max(1, int(np.ceil(2.5 * length_m / cell_m)))
    kernel = np.exp(-2.0 * (np.arange(-reach, reach + 1) * cell_m / length_m) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    white = rng.standard_normal((passes, cells + 2 * reach))
    size = 1 << int(np.ceil(np.log2(white.shape[1] + len(kernel))))
    spectrum = np.fft.rfft(white, size, axis=1) * np.fft.rfft(kernel, size)
    field: FloatArray = np.fft.irfft(spectrum, size, axis=1)[:, 2 * reach : 2 * reach + cells]
    across = np.exp(-spacing_m / length_m)
    for j in range(1, passes):
        field[j] = across * field[j - 1] + np.sqrt(1.0 - across**2) * field[j]
    return field


def grades(
    rng: np.random.Generator, place_m: FloatArray, grade_max: float, waves_m: tuple[float, float]
) -> FloatArray:
    """Rise over run along a line: an even tilt and five waves, within +-grade_max, shape (N,).

    Args:
        rng: draws tilt, wavelengths within ``waves_m`` and phases.
        place_m: where, shape (N,) [m].
        grade_max: largest grade [-].
        waves_m: shortest and longest wave [m].
    """
    shares = np.array([0.30, 0.18, 0.16, 0.14, 0.12, 0.10])
    tilt = rng.uniform(-1.0, 1.0)
    lengths = waves_m[0] * (waves_m[1] / waves_m[0]) ** rng.random(5)
    phases = rng.uniform(0.0, 2.0 * np.pi, 5)
    waves = np.sin(2.0 * np.pi * place_m[:, None] / lengths + phases)
    grade: FloatArray = grade_max * (shares[0] * tilt + waves @ shares[1:])
    return grade


def flip_alternate(field: FloatArray, sign: float = 1.0) -> FloatArray:
    """Field coordinates to driving order: every second pass runs the other way."""
    driven = field.copy()
    driven[1::2] = sign * field[1::2, ::-1]
    return driven
