"""Whether two Monte Carlo estimates are of the same: the Z-test of `mitsuba.testing`, for pixels and for sums over all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

SIGNIFICANCE, SUCCESS = 0.01, 0.975  # of the Z-test: of all pixels together, and the part of them that must pass
GLOBAL = 4.5  # standard errors by which the sums over all pixels may differ


@dataclass
class Estimate:
    """The ``mean`` [pixels, 3] of a number of independent ``batches``, and the ``variance`` [pixels, 3] of the mean."""

    mean: np.ndarray
    variance: np.ndarray
    batches: int

    @classmethod
    def of(cls, batches: np.ndarray | Sequence[np.ndarray]) -> "Estimate":
        """Make an estimate of independent batches, [batches, pixels, 3]."""
        return cls(np.mean(batches, 0), np.var(batches, 0, ddof=1) / len(batches), len(batches))


@dataclass
class Difference:
    """The difference of two estimates, ``one`` less the ``other``."""

    one: Estimate
    other: Estimate

    @property
    def z(self) -> np.ndarray:
        """The difference in standard errors, [pixels, 3]."""
        return (self.one.mean - self.other.mean) / np.sqrt(self._variance())

    @property
    def equal(self) -> bool:
        """Whether pixels and sums both pass."""
        return self.passed >= SUCCESS and self.global_z <= GLOBAL

    @property
    def passed(self) -> float:
        """The part of all pixels and channels whose difference is no surprise among so many (Sidak's correction)."""
        alpha = 1 - (1 - SIGNIFICANCE) ** (1 / len(self.one.mean))
        return float(np.mean(2 * stats.t.sf(np.abs(self.z), self.one.batches + self.other.batches - 2) > alpha))

    @property
    def global_z(self) -> float:
        """The largest difference of sums over all pixels, of three channels, in standard errors."""
        difference = (self.one.mean - self.other.mean).sum(0)
        return float(np.abs(difference / np.sqrt(self._variance().sum(0))).max())

    def _variance(self):
        # a pixel whose batches are all equal has no spread to judge by; rounding has
        return self.one.variance + self.other.variance + (1e-5 * np.abs(self.other.mean) + 1e-6) ** 2
