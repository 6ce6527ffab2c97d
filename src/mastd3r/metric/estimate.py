"""The factor and how sure it is: robust means, and the spread of what is left when blocks of the supports are left out.

Delete-a-block jackknife: Kuensch, "The jackknife and the bootstrap for general stationary observations", 1989. What a
trajectory's errors share over neighbouring frames (drift) stays within blocks, so that many frames are not taken for
many witnesses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from ..errors import InputError

Array = NDArray[Any]
BLOCKS = 10  # of consecutive supports, each left out once
MOST_ALIKE = 0.8  # correlation of neighbouring blocks; beyond, it cannot be told from so few
TUNING = 4.685  # of Tukey's biweight, in sigmas: 95 % as good as the mean where errors are normal
MOST_SIGMA_RATIO = 0.3  # a factor that is known no better is none
PART_1_SIGMA = 0.8413447460685429  # of a normal distribution below +1 sigma
LEAST_FACTOR, MOST_FACTOR = 1e-9, 1e9


@dataclass(frozen=True)
class Scale:
    """Metres a map unit."""

    metres_per_unit: float
    sigma_ratio: float | None  # 1 sigma, relative; None: whoever gave the factor did not say
    supports: int
    of: str  # what the supports are, in words

    @property
    def said(self) -> str:
        """In one line."""
        found = f"1 map unit is {self.metres_per_unit:.6g} m"
        if self.sigma_ratio is None:
            return f"{found}, as it was given"
        return f"{found} ± {100 * self.sigma_ratio:.2g} % (1 sigma), from {self.supports} {self.of}"


def scale_of(log_factor: float, sigma_ratio: float | None, supports: int, of: str, where: str) -> Scale:
    """What was found. Raises InputError for a factor that is none, or hardly known."""
    found = math.exp(log_factor) if abs(log_factor) < math.log(MOST_FACTOR) else math.inf
    if not (LEAST_FACTOR < found < MOST_FACTOR):
        raise InputError(f"{where}: expected lengths like those of the map, got a factor of exp({log_factor:g})")
    if sigma_ratio is not None and not sigma_ratio <= MOST_SIGMA_RATIO:
        raise InputError(
            f"{where}: expected a factor known to {MOST_SIGMA_RATIO:.0%} or better, got {found:.3g} m a map unit known "
            f"to {sigma_ratio:.0%} (1 sigma), from {supports} {of}"
        )
    return Scale(found, sigma_ratio, supports, of)


def biweight(values: Array) -> float:
    """Tukey's biweight of (n,) values, n >= 1: their mean, without what lies far from most of them."""
    at = float(np.median(values))
    sigma = 1.4826 * float(np.median(np.abs(values - at)))
    if sigma <= 0:
        return at
    for _ in range(20):
        weight = tukey((values - at) / sigma)
        step = float(weight @ values / weight.sum()) - at
        at += step
        if abs(step) < 1e-9 * sigma:
            break
    return at


def tukey(normalised: Array) -> Array:
    """(n,) weights 0..1 of residuals in sigmas."""
    return np.asarray(np.maximum(1 - (normalised / TUNING) ** 2, 0) ** 2)


def jackknifed(estimate: Callable[[Array], float], count: int) -> tuple[float, float]:
    """What ``estimate`` says of all of ``count`` rows, and its 1 sigma; it is asked with (k,) ascending rows.

    Where neighbouring blocks err alike, there are fewer witnesses than blocks. The sigma is widened, as Student's
    distribution says, for the few blocks that it is known from. Needs 2 rows.
    """
    rows = np.arange(count)
    blocks = min(BLOCKS, count)
    left_out = np.array([estimate(rows[rows * blocks // count != b]) for b in range(blocks)])
    spread = left_out - left_out.mean()
    total = float((spread**2).sum())
    variance = (blocks - 1) / blocks * total
    if blocks == BLOCKS and total > 0:
        alike = (float((spread[1:] * spread[:-1]).sum()) / total * blocks + 1) / (blocks - 3)  # without its bias
        alike = min(max(alike, 0.0), MOST_ALIKE)
        variance *= (1 + alike) / (1 - alike)
    return estimate(rows), float(np.sqrt(variance) * student.ppf(PART_1_SIGMA, blocks - 1))
