"""Pose grid as one blob: a header, then its arrays in memory layout, so that reading copies nothing.

4 bytes "LLG1", then the numbers of poses, latent values and profile columns as little-endian uint32;
positions (float64, n·2), latents (float32, n·d), profiles (float32, n·w), room indices (int32, n). "LLG2" is the same
without latents, d = 0, and with profiles in half precision (float16).

Prototypes of a plan: "LLP3", the version of their cells, their number, and rows of `prototypes.ROW`. Prototypes of
earlier versions of the service are not read: "LLP1" lacks openings, "LLP2" has fewer poses.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.venue.prototype_cells import Cells, shipped_cells
from lalaloc_core.localise.venue.prototypes import ROW, prototypes_of
from lalaloc_core.render.sampling import PoseSet

_HEADER = struct.Struct("<4s3I")
_MAGIC, _MAGIC_WITHOUT_LATENTS = b"LLG1", b"LLG2"
_PROTOTYPES_HEADER = struct.Struct("<4s2I")
_PROTOTYPES_MAGIC = b"LLP3"
_POSE_BYTES, _LATENT_BYTES, _ROOM_BYTES = 16, 4, 4


@dataclass(frozen=True, eq=False)
class SortedPrototypes:
    """Prototypes of a plan, rows of `prototypes.ROW`, sorted into the cells of a version."""

    rows: np.ndarray
    version: int

    @classmethod
    def of(cls, rows: np.ndarray, cells: Cells) -> SortedPrototypes:
        """Sort prototypes into cells."""
        rows = rows.copy()
        rows["cell"] = cells.assign(rows)
        return cls(rows, cells.version)

    @classmethod
    def of_grid(cls, grid: PoseGrid, plan: FloorPlan) -> SortedPrototypes:
        """Make the prototypes of a plan's pose grid, sorted into the shipped cells."""
        return cls.of(prototypes_of(grid, plan), shipped_cells())

    @classmethod
    def of_grids(cls, grids: Sequence[PoseGrid], plans: Sequence[FloorPlan]) -> list[SortedPrototypes]:
        """Make the prototypes of several plans as `of_grid` does, sorted at once."""
        made = [prototypes_of(grid, plan) for grid, plan in zip(grids, plans, strict=True)]
        whole = cls.of(np.concatenate(made), shipped_cells())
        parts = np.split(whole.rows, np.cumsum([len(part) for part in made])[:-1])
        return [cls(rows, whole.version) for rows in parts]

    def in_shipped_cells(self) -> np.ndarray:
        """Return the rows, sorted into the shipped cells again if their version differs."""
        cells = shipped_cells()
        return self.rows if self.version == cells.version else self.of(self.rows, cells).rows


@dataclass(frozen=True)
class PackedGrid:
    """Grid as a blob, with its number of poses, the blob's digest, and optionally its prototypes as another blob."""

    poses: int
    content: bytes
    sha256: str
    prototypes: bytes | None


def pack(grid: PoseGrid, prototypes: SortedPrototypes | None = None) -> PackedGrid:
    """Return the blob of a grid."""
    count, columns = grid.profile_m.shape
    latents = np.empty((count, 0)) if grid.latents is None else grid.latents
    magic, profiles = (_MAGIC_WITHOUT_LATENTS, "<f2") if grid.latents is None else (_MAGIC, "<f4")
    header = _HEADER.pack(magic, count, latents.shape[1], columns)
    arrays = (
        grid.poses.position_m.astype("<f8", copy=False),
        *([] if grid.latents is None else [latents.astype("<f4", copy=False)]),
        grid.profile_m.astype(profiles, copy=False),
        grid.poses.room_index.astype("<i4", copy=False),
    )
    content = b"".join((header, *(np.ascontiguousarray(array).data.cast("B") for array in arrays)))
    return PackedGrid(count, content, digest_of(content), None if prototypes is None else pack_prototypes(prototypes))


def packed_bytes(poses: int, columns: int, latent_size: int) -> int:
    """Return the size of the blob of a grid; `latent_size` is 0 without latents."""
    profile_bytes = 4 if latent_size else 2
    return _HEADER.size + poses * (_POSE_BYTES + _LATENT_BYTES * latent_size + profile_bytes * columns + _ROOM_BYTES)


def pack_prototypes(prototypes: SortedPrototypes) -> bytes:
    """Return the blob of a plan's prototypes."""
    rows = prototypes.rows
    return _PROTOTYPES_HEADER.pack(_PROTOTYPES_MAGIC, prototypes.version, len(rows)) + rows.tobytes()


def unpack_prototypes(content: bytes) -> SortedPrototypes | None:
    """Return the prototypes in a blob, as read-only views; None if the blob is damaged or has non-finite values."""
    if len(content) < _PROTOTYPES_HEADER.size:
        return None
    magic, version, count = _PROTOTYPES_HEADER.unpack_from(content)
    if magic != _PROTOTYPES_MAGIC or len(content) != _PROTOTYPES_HEADER.size + count * ROW.itemsize or not count:
        return None
    rows = np.frombuffer(content, ROW, count, _PROTOTYPES_HEADER.size)
    if not all(np.isfinite(rows[name]).all() for name in ("log_profile", "log_area", "ceiling_m")):
        return None
    return SortedPrototypes(rows, version)


def digest_of(content: bytes | bytearray) -> str:
    """Return the SHA-256 of a blob in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def unpack(content: bytes | bytearray, *, step_m: float, camera_height_m: float) -> PoseGrid | None:
    """Return the grid in a blob, as read-only views of it; None if the blob is damaged or has non-finite values."""
    if len(content) < _HEADER.size:
        return None
    magic, count, latent_size, columns = _HEADER.unpack_from(content)
    if magic not in (_MAGIC, _MAGIC_WITHOUT_LATENTS) or count == 0 or (magic == _MAGIC) != (latent_size > 0):
        return None
    profiles = np.dtype("<f4" if magic == _MAGIC else "<f2")
    if len(content) != packed_bytes(count, columns, latent_size):
        return None
    view, offset = memoryview(content).toreadonly(), _HEADER.size

    def take(dtype: str | np.dtype, width: int) -> np.ndarray:
        nonlocal offset
        array = np.frombuffer(view, dtype, count * width, offset)
        offset += array.nbytes
        return array.reshape(count, width)

    position_m, latents, profile_m = take("<f8", 2), take("<f4", latent_size), take(profiles, columns)
    if not all(np.isfinite(array).all() for array in (position_m, latents, profile_m)):
        return None
    poses = PoseSet(position_m, take("<i4", 1)[:, 0])
    return PoseGrid(poses, latents if latent_size else None, profile_m, step_m, camera_height_m)
