"""The outdoors behind windows: a graded sky with the sun, ground, and silhouettes of hills, trees and houses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Sky:
    """The outdoors of one photograph; colours are linear RGB.

    Attributes:
        sunlight: light on a face turned to the sun; zero under clouds or at night.
        waves: (k, 3) frequency, phase and height of the hills' outline.
        blocks: random numbers of the houses' outline.
    """

    zenith: Float[np.ndarray, "3"]
    horizon: Float[np.ndarray, "3"]
    ground: Float[np.ndarray, "3"]
    sun: Float[np.ndarray, "3"]
    sunlight: Float[np.ndarray, "3"]
    waves: Float[np.ndarray, "k 3"]
    blocks: Float[np.ndarray, "m"]

    @classmethod
    def sample(cls, rng: np.random.Generator) -> Sky:
        """Draw a sky: mostly day, clear or covered; sometimes dusk or night."""
        weather = rng.choice(["clear", "covered", "dusk", "night"], p=[0.45, 0.35, 0.1, 0.1])
        height, around = np.radians(rng.uniform(8, 60)), rng.uniform(0, 2 * np.pi)
        sun = np.array([np.cos(height) * np.sin(around), np.cos(height) * np.cos(around), np.sin(height)])
        zenith, horizon, sunlight = {
            "clear": ([0.9, 1.6, 3.2], [2.6, 3.0, 3.4], np.array([14.0, 12.5, 10.0]) * rng.uniform(0.5, 1.2)),
            "covered": ([2.0, 2.1, 2.2], [2.4, 2.4, 2.4], np.zeros(3)),
            "dusk": ([0.25, 0.3, 0.6], [1.6, 0.8, 0.4], np.zeros(3)),
            "night": ([0.01, 0.01, 0.02], [0.05, 0.045, 0.05], np.zeros(3)),
        }[str(weather)]
        bright = rng.uniform(0.5, 1.4)
        waves = np.stack([rng.integers(1, 12, 5), rng.uniform(0, 6.28, 5), rng.uniform(0.005, 0.05, 5)], axis=1)
        ground = np.array(horizon) * rng.uniform(0.1, 0.4) * rng.choice([[0.4, 0.6, 0.25], [0.55, 0.5, 0.45]])
        return cls(
            zenith=np.array(zenith) * bright,
            horizon=np.array(horizon) * bright,
            ground=ground * bright,
            sun=sun,
            sunlight=np.asarray(sunlight),
            waves=waves,
            blocks=rng.random(48),
        )

    def colour(self, direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the radiance along each direction."""
        up = direction[:, 2:]
        azimuth = np.arctan2(direction[:, 0], direction[:, 1])
        sky = self.horizon + (self.zenith - self.horizon) * np.clip(up, 0, 1) ** 0.5
        hills = 0.04 + (self.waves[:, 2] * np.sin(azimuth[:, None] * self.waves[:, 0] + self.waves[:, 1])).sum(axis=1)
        cell = (azimuth / (2 * np.pi) + 0.5) * len(self.blocks)
        house = self.blocks[cell.astype(int) % len(self.blocks)]
        houses = np.where(house > 0.45, 0.25 * (house - 0.35), -1.0)
        colour = np.where(up < np.maximum(hills, 0.01)[:, None], 0.45 * self.ground + 0.3 * self.horizon, sky)
        colour = np.where(
            ((up[:, 0] < houses) & (cell % 1 > 0.15))[:, None], 0.4 * self.horizon * (0.3 + house[:, None]), colour
        )
        return np.where(up < 0.0, self.ground * (1.0 - 0.5 * np.clip(-up, 0, 1)), colour)

    def mean(self) -> Float[np.ndarray, "3"]:
        """Return the mean radiance of a window."""
        return 0.45 * self.horizon + 0.3 * self.zenith + 0.25 * self.ground
