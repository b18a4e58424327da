"""Values that the stages of localisation exchange, in plain numpy so that they can cross process borders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import ROOM_TYPES

# Types of rooms that are less probable are not named.
_MIN_PROBABILITY = 0.05


@dataclass(frozen=True, eq=False)
class RivalWall:
    """Second mode of a predicted wall profile, such as the wall behind a passage, or at an edge that is hidden.

    Attributes:
        log_m: (k, w) centres.
        log_scale: (k, w) logs of the scales.
        odds: (k, w) height of this mode's density at its centre over that of the first mode.
    """

    log_m: Float[np.ndarray, "k w"]
    log_scale: Float[np.ndarray, "k w"]
    odds: Float[np.ndarray, "k w"]


@dataclass(frozen=True, eq=False)
class PredictedProfile:
    """Laplace distributions of the log wall profile (m), for every hypothesis of the heading.

    Attributes:
        log_m: (k, w) centres.
        log_scale: (k, w) logs of the scales; infinite at azimuths that the photograph does not show.
        rival: second modes; None if the model predicts one only.
    """

    log_m: Float[np.ndarray, "k w"]
    log_scale: Float[np.ndarray, "k w"]
    rival: RivalWall | None = None

    @classmethod
    def of_outputs(cls, outputs: Mapping[str, np.ndarray]) -> PredictedProfile:
        """Return the profile of one hypothesis by the outputs of an image encoder, the mode with most density first.

        `log_profile` and `log_scale` are (w,), or with `log_share` (w, 2).
        """
        log_m, log_scale = outputs["log_profile"], outputs["log_scale"]
        if log_m.ndim == 1:
            return cls(log_m[None], log_scale[None])
        density = outputs["log_share"] - log_scale
        order = np.argsort(-density, axis=1, kind="stable")
        log_m, log_scale, density = (np.take_along_axis(value, order, axis=1) for value in (log_m, log_scale, density))
        # Azimuths that the photograph does not show have infinite scales.
        with np.errstate(invalid="ignore"):
            odds = np.nan_to_num(np.exp(density[:, 1] - density[:, 0]))
        rival = RivalWall(log_m[None, :, 1], log_scale[None, :, 1], odds[None])
        return cls(log_m[None, :, 0], log_scale[None, :, 0], rival)

    def moved(self, shifts: Int[np.ndarray, "j"]) -> PredictedProfile:
        """Return a profile of one hypothesis, moved to the right by a number of columns for each of several."""
        rival = self.rival
        return PredictedProfile(
            rolled(self.log_m[0], shifts),
            rolled(self.log_scale[0], shifts),
            None if rival is None else RivalWall(*(rolled(values[0], shifts) for values in vars(rival).values())),
        )

    def scaled(self, offset: float) -> PredictedProfile:
        """Return the profile if the camera stood higher by the factor `exp(offset)`."""
        rival = None if self.rival is None else replace(self.rival, log_m=self.rival.log_m + offset)
        return replace(self, log_m=self.log_m + offset, rival=rival)

    @property
    def seen(self) -> Bool[np.ndarray, "k w"]:
        """Azimuths that the photograph shows."""
        return np.isfinite(self.log_scale)


def rolled(values: Float[np.ndarray, "w *c"], shifts: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k w *c"]:
    """Return values by azimuth column, moved to the right by a number of columns for each hypothesis."""
    columns = len(values)
    return values[(np.arange(columns)[None, :] - shifts[:, None]) % columns]


@dataclass(frozen=True, eq=False)
class PredictedOpenings:
    """Opening class at each azimuth at eye height, for every hypothesis of the heading.

    Attributes:
        log_probability: (k, w, c) by class, in the order of `conventions.OPENING_CLASSES`.
        prior: (c,) frequencies of the classes that the probabilities presume; probabilities over these are likelihoods
            up to a factor.
    """

    log_probability: Float[np.ndarray, "k w c"]
    prior: Float[np.ndarray, "c"]


@dataclass(frozen=True)
class PredictedCeiling:
    """Laplace distribution of the log of the ceiling's height (m) above the camera: centre and log scale."""

    log_m: float
    log_scale: float


@dataclass(frozen=True, eq=False)
class PredictedRoomType:
    """Log probability by type, as in `conventions.ROOM_TYPES`, and the frequencies that it presumes."""

    log_probability: Float[np.ndarray, "t"]
    prior: Float[np.ndarray, "t"]

    def shares(self) -> dict[str, float]:
        """Return the probabilities of the types that are not negligible, the most probable first."""
        share = np.exp(self.log_probability)
        return {ROOM_TYPES[k]: float(share[k]) for k in np.argsort(-share) if share[k] >= _MIN_PROBABILITY}


@dataclass(frozen=True)
class SeenObject:
    """Object in a photograph: its name, probability, and azimuth (radians) relative to the photograph's centre."""

    name: str
    probability: float
    azimuth: float


@dataclass(frozen=True)
class WallDirection:
    """Azimuth of walls relative to the photograph's centre, known up to quarter turns, and its deviation (radians)."""

    azimuth: float
    sd: float


@dataclass(frozen=True, eq=False)
class SeenObjects:
    """Objects that a photograph, or several of one spot, show, and the type of room that they suggest.

    Attributes:
        room_type: its probabilities presume that all types are equally frequent.
        objects: the most probable first.
        outside: log likelihood ratio of a photograph taken outside to one of a room.
    """

    room_type: PredictedRoomType
    objects: tuple[SeenObject, ...]
    outside: float = 0.0
