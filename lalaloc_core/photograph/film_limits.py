"""Limits of films."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FilmLimits:
    """Limits of films.

    Attributes:
        max_bytes: size of the file.
        max_s: duration.
        max_pixels: width times height.
        max_cpu_s: CPU time of decoding.
    """

    max_bytes: int = 100 * 2**20
    max_s: float = 60.0
    max_pixels: int = 4096 * 2304
    max_cpu_s: float = 20.0
