"""Chamfer distance of layouts and accuracy of localisation; the distance works on numpy and torch arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Float

from lalaloc_core.conventions import Array


def chamfer_distance(first: Float[Array, "b n 3"], second: Float[Array, "b m 3"]) -> Float[Array, "b"]:
    """Return the symmetric Chamfer distance (m): the sum of both mean nearest-neighbour distances."""
    xp = array_namespace(first, second)
    square_first = xp.sum(first * first, axis=-1)[:, :, None]
    square_second = xp.sum(second * second, axis=-1)[:, None, :]
    product = xp.matmul(first, xp.matrix_transpose(second))
    squared = square_first + square_second - 2.0 * product
    forward = xp.sqrt(xp.clip(xp.min(squared, axis=2), 0.0))
    backward = xp.sqrt(xp.clip(xp.min(squared, axis=1), 0.0))
    return xp.mean(forward, axis=1) + xp.mean(backward, axis=1)


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Localisation accuracy over `n` queries; a query without an answer counts as a miss in every share."""

    n: int
    median_cm: float
    within_1cm: float
    within_5cm: float
    within_10cm: float
    within_1m: float

    @classmethod
    def from_errors(cls, error_m: Float[np.ndarray, "n"]) -> Accuracy:
        """Compute the accuracy of position errors (m); NaN marks a query without an answer."""
        error = np.where(np.isnan(error_m), np.inf, error_m)
        return cls(
            n=len(error),
            median_cm=float(np.median(error)) * 100.0,
            within_1cm=float(np.mean(error < 0.01)),
            within_5cm=float(np.mean(error < 0.05)),
            within_10cm=float(np.mean(error < 0.10)),
            within_1m=float(np.mean(error < 1.0)),
        )

    def to_dict(self) -> dict[str, int | float]:
        """Return the metrics by name."""
        return asdict(self)
