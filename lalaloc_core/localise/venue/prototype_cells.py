"""Cells that prototypes are sorted into, so that of millions only those are compared that are like the panorama.

A cell is a mean of prototypes that look alike, walls and openings, *without* turning one against the other: k-means,
the coarse quantiser of an inverted file (Sivic and Zisserman, *Video Google*, 2003; Jégou et al., *Product quantization
for nearest neighbor search*, 2011). The cells come with the package, made of generated homes by
`scripts/make_prototype_cells.py`. They bear on speed and recall, never on what a prototype costs.

Plans that do not claim all kinds of openings are sorted by those that they do, into cells of their own: there is a
*family* of them for every set of kinds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, unpacked_openings

CELLS_FILE = Path(__file__).with_name("prototype_cells.npz")
# What log distances and classes count where prototypes are sorted: about as much as they cost at a usual precision.
_LOG_SCALE, _CLASS_SCALE = 0.95, 0.74
# Robust costs of log distances are looked up, between these (0.25 to 33 m) and so far apart.
_LOWEST, _HIGHEST, _BIN = -1.4, 3.5, 0.35
_BINS = round((_HIGHEST - _LOWEST) / _BIN) + 1
_CHUNK = 2048
# Sets of kinds of openings that a plan may claim, and as many families of cells.
FAMILIES = 1 << (len(OPENING_CLASSES) - 1)


@dataclass(frozen=True, eq=False)
class Cells:
    """The centres of the cells.

    Attributes:
        log_profile: (v, a) mean log wall profiles (m).
        share: (v, a, c) shares of the opening classes by azimuth.
        version: tells sorted prototypes of one set of cells from those of another.
    """

    log_profile: Float[np.ndarray, "v a"]
    share: Float[np.ndarray, "v a c"]
    version: int

    def __len__(self) -> int:
        """How many cells there are in all: these for plans that claim none of the kinds of openings, and so on."""
        return FAMILIES * len(self.log_profile)

    def sort(self, rows: np.ndarray) -> UInt16[np.ndarray, "n"]:
        """Return the cell of each prototype."""
        feature, centre = features(rows), _features(self.log_profile, self.share)
        family, cell = family_of(rows["claims"]), np.empty(len(rows), np.uint16)
        for number in np.unique(family).tolist():
            own, seen = family == number, _claimed_features(number)
            cell[own] = number * len(centre) + nearest(feature[np.ix_(own, seen)], centre[:, seen])
        return cell

    def costs(self, compared: PrototypeCosts, families: Iterable[int]) -> dict[int, Float[np.ndarray, "v k j"]]:
        """About what prototypes of some families cost by cell, under every hypothesis of the heading and the height."""
        (k, j), v = compared.shape, len(self.log_profile)
        position = _LOWEST + _BIN * np.arange(_BINS)
        centre = compared.centre[:, None] + compared.offsets[None, :, None].astype(np.float32)
        residual = (position - centre[..., None]) * compared.precision[:, None, :, None]
        by_bin = (np.log1p(np.square(residual)) / AZIMUTHS).astype(np.float32).reshape(k * j, -1)
        walls = (self._bins @ by_bin.T).reshape(v, k, j) + compared.penalty.astype(np.float32)
        if compared.opening_loss is None:
            return dict.fromkeys(families, walls)
        share = self.share.reshape(v, -1)
        told = {family: compared.opening_loss[claims_of(family)].reshape(k, -1) for family in families}
        return {family: walls + (share @ loss.T)[:, :, None] for family, loss in told.items()}

    @cached_property
    def _bins(self) -> Float[np.ndarray, "v b"]:
        return _soft_bins(self.log_profile)


@lru_cache(maxsize=1)
def shipped_cells() -> Cells:
    """Return the cells that come with the package."""
    with np.load(CELLS_FILE) as file:
        return Cells(
            file["log_profile"].astype(np.float32), file["share"].astype(np.float32) / 255.0, int(file["version"])
        )


def family_of(claims: UInt8[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
    """Return the family of cells that prototypes of plans are sorted into, by what these claim."""
    return claims >> (WALL_CODE + 1) & (FAMILIES - 1)


def claims_of(family: int) -> int:
    """Return the opening classes that the plans of a family of cells claim."""
    return family << (WALL_CODE + 1)


def _claimed_features(family: int) -> Int[np.ndarray, "f"]:
    """Return the columns of `features` that count for a family."""
    kinds = np.arange(1, len(OPENING_CLASSES))
    claimed = np.tile(claims_of(family) >> kinds & 1, AZIMUTHS).astype(bool)
    return np.concatenate([np.arange(AZIMUTHS), AZIMUTHS + np.flatnonzero(claimed)])


def features(rows: np.ndarray) -> Float[np.ndarray, "n f"]:
    """Return the features that prototypes are sorted by."""
    kind = unpacked_openings(rows["openings"])
    return _features(rows["log_profile"], (kind[:, :, None] == np.arange(len(OPENING_CLASSES))))


def _features(log_profile: np.ndarray, share: np.ndarray) -> Float[np.ndarray, "n f"]:
    n, others = len(log_profile), np.delete(share, WALL_CODE, axis=2).astype(np.float32)
    return np.concatenate([_LOG_SCALE * log_profile.astype(np.float32), _CLASS_SCALE * others.reshape(n, -1)], axis=1)


def nearest(feature: Float[np.ndarray, "n f"], centre: Float[np.ndarray, "v f"]) -> Int[np.ndarray, "n"]:
    """Return the nearest centre of each."""
    found, half = np.empty(len(feature), np.intp), 0.5 * np.square(centre).sum(axis=1)
    for begin in range(0, len(feature), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        found[part] = (half - feature[part] @ centre.T).argmin(axis=1)
    return found


def _soft_bins(log_profile: Float[np.ndarray, "v a"]) -> Float[np.ndarray, "v b"]:
    """Log distances as weights of the two bins that each lies between."""
    place = (np.clip(log_profile, _LOWEST, _HIGHEST - 1e-6) - _LOWEST) / _BIN
    lower = place.astype(np.intp)
    weight = np.zeros((*log_profile.shape, _BINS), np.float32)
    np.put_along_axis(weight, lower[..., None], (1.0 - (place - lower))[..., None], axis=2)
    np.put_along_axis(weight, lower[..., None] + 1, (place - lower)[..., None], axis=2)
    return weight.reshape(len(log_profile), -1)
