"""Evidence of the photographs of an album: the best states of each alone, and the unknowns that all share.

`AlbumMemory` keeps what is slow to find and does not depend on corrections. Fields of view, the camera's height, and
the scale of the plan are the same for many photographs.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import Manifest, MatchingWeights
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.room_types import room_types_from_name
from lalaloc_core.localise.album.comparison import BinnedGround, Comparison
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.pins import SharedCamera
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig, PlaceCost, PoseGrid, layouts_at
from lalaloc_core.localise.match.cost_terms import ceiling_costs, losses_of_rooms, room_type_losses
from lalaloc_core.localise.query import DEFAULT_STD_M, NO_HINTS, CameraHeight, PredictedRoomType, Query
from lalaloc_core.photograph import Photograph
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid

# Finer grid for plans of at most so many poses, and the distance (m) within which its best pose counts as exact:
# single photographs name the right room more often than with the grid of queries.
_FINE_STEP_M, _FINE_REACH_M, _MAX_FINE = 0.25, 0.08, 8000
# Logs of true over usual camera height that are tried, the height (m) that people hold cameras at, and that of the
# ceilings of other homes.
_OFFSETS = np.linspace(-0.36, 0.36, 9)
_USUAL_HEIGHT_M, _USUAL_LOG_SD, _USUAL_CEILING_M = 1.5, 0.15, 2.5
# States that are kept: of every room, at least so many, and of all.
_PER_ROOM, _MAX_STATES = 96, 8192
# Every so many of the poses of other homes are compared; poses at a time; version of stored evidence.
_EVERY, _PART, _VERSION = 4, 4096, 3
_CONFIG = MatchingConfig()
# Arrays of one photograph by name.
Arrays = dict[str, np.ndarray]
_DAMAGE = (ValueError, KeyError, NotImplementedError, OSError, EOFError, zipfile.BadZipFile, zlib.error)
# Standard deviation of the scale of a plan; of the log height from one photograph to the next; and of a median over
# that of a mean. Errors of fields of view by lines are alike, so the error of many is not less than `_LINES_SD`.
_SCALE_SD, _HAND_SD, _MEDIAN, _LINES_SD = 0.05, 0.05, 1.25, 0.03
# Log likelihoods of rooms of another type than a file's name tells, and of no type; share of names that tell a type of
# the folder.
_MISNAMED, _UNTYPED, _COMMON = math.log(0.05), math.log(0.3), 0.6
# Fields of view (radians) from which on pictures are not in perspective.
_WIDEST = 3.0


@dataclass(eq=False)
class AlbumMemory:
    """Evidence of single photographs and links between them, for one ground and model.

    Pass the same object to every `solve_album` of an album; it is filled there. Not safe to share between threads.

    Attributes:
        key: digest of ground and model; empty for a new memory.
        evidence: arrays of each photograph, by id.
        stored: evidence as `to_bytes` wrote it, by id, which the next solve uses.
        links: matches and turn by pair of ids; None for pairs that do not overlap.
        spent_s: CPU time of solves that were stopped since the last one that ended, which callers measure.
    """

    key: str = ""
    evidence: dict[str, Arrays] = field(default_factory=dict)
    stored: Mapping[str, bytes] = field(default_factory=dict)
    links: dict[tuple[str, str], tuple[int, float] | None] = field(default_factory=dict)
    spent_s: float = 0.0

    def use(self, ground: AlbumGround, manifest: Manifest) -> None:
        """Drop everything that is of another ground or model."""
        files = sorted(manifest.files.items())
        weights = manifest.evidence_for(view=False), manifest.evidence_for(view=True)
        key = hashlib.sha256(f"{_VERSION} {ground.digest} {files} {weights}".encode()).hexdigest()
        if key != self.key:
            # Links depend on the photographs alone.
            self.key, self.evidence = key, {}
        read = {id: _read_evidence(content, key) for id, content in self.stored.items()}
        self.evidence |= {id: arrays for id, arrays in read.items() if arrays}
        self.stored = {}

    def keep(self, ids: set[str]) -> None:
        """Drop what is about photographs that are no longer in the album."""
        self.evidence = {id: arrays for id, arrays in self.evidence.items() if id in ids}
        self.links = {pair: link for pair, link in self.links.items() if ids.issuperset(pair)}

    def to_bytes(self, id: str) -> bytes:
        """Return the evidence of a photograph as a file: an archive of arrays, as numpy writes them."""
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {"key": np.array(self.key), **self.evidence[id]}
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()


def _read_evidence(content: bytes, key: str) -> Arrays:
    """Read evidence that this service stored itself; nothing if it is damaged, or of another ground or model."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            if str(archive["key"]) == key:
                return {name: archive[name] for name in archive.files if name != "key"}
    except _DAMAGE:
        # The photograph is compared again.
        pass
    return {}


@dataclass(frozen=True, eq=False)
class SearchedPlan:
    """The plan of an album as photographs are compared with it; the best pose is within `reach_m` of the camera."""

    plan: FloorPlan
    poses: PoseSet
    reach_m: float
    binned: BinnedGround

    @classmethod
    def of(cls, plan: FloorPlan, grid: PoseGrid, columns: int) -> SearchedPlan:
        """Return the plan with a fine grid, or if it is too large with the given one."""
        if grid_size(plan, _FINE_STEP_M) > _MAX_FINE:
            reach_m = _CONFIG.grid_reach * grid.step_m
            return cls(plan, grid.poses, reach_m, BinnedGround.of(grid.layouts(plan)))
        poses = pose_grid(plan, _FINE_STEP_M)
        layouts = layouts_at(plan, poses, np.zeros(len(poses)), columns)
        return cls(plan, poses, _FINE_REACH_M, BinnedGround.of(layouts))


def single_evidence(searched: SearchedPlan, encoder: PhotographEncoder, photograph: Photograph) -> Arrays:
    """Compare a photograph with all poses.

    Likelihoods are ratios to the mean likelihood of poses of other homes: above 1 a place explains the photograph
    better than homes in general do, whatever can be told from it.

    Returns:
        `pose`, `position_m`, `room`, `hypothesis` and `log_likelihood` of the states that are kept;
        `rooms` (r,), the log mean likelihood of every room's poses under all headings;
        `room_types` (r,), the log likelihood of the type of every room by the encoder's own prediction;
        `heights` (j,), the log evidence of each height offset.
    """
    plan, poses = searched.plan, searched.poses
    weights = encoder.manifest.evidence_for(view=not photograph.is_sphere)
    query = encoder.query(photograph, None, CameraHeight(_USUAL_HEIGHT_M, 0.0))
    compared = Comparison.of(plan, query, searched.reach_m, weights, _OFFSETS)
    ceilings = _height_costs(plan.ceiling_heights_m, query, weights)
    best = np.empty((len(poses), len(query.roll)), np.float32)
    heights = np.full(len(_OFFSETS), -np.inf)
    trusts = plan.class_trusts[1][poses.room_index]
    for part, log in compared.log_likelihoods(searched.binned, trusts):
        log -= ceilings[poses.room_index[part], None, :]
        heights = np.logaddexp(heights, [_log_sum(log[:, :, number]) for number in range(len(_OFFSETS))])
        best[part] = log.max(axis=2)
    trust = int(trusts[best.max(axis=1).argmax()])
    others = _height_costs(np.array([_USUAL_CEILING_M]), query, weights)
    usual = _of_other_homes(encoder, compared, others, trust, best)
    places = PlaceCost.of(plan, query, NO_HINTS, 1.0, poses.position_m, poses.room_index)
    if places is not None:
        # How probable it is that the lines and fixtures that are seen are there, over the mean of the plan; by parts,
        # to bound the memory of large plans.
        total = -math.inf
        for first in range(0, len(best), _PART):
            cost = places.of_poses(np.arange(first, min(first + _PART, len(best))))
            best[first : first + _PART] -= cost
            total = np.logaddexp(total, _log_sum(-cost) + math.log(best.shape[1] / cost.shape[1]))
        usual += total - math.log(best.size)
    best -= usual
    kept = _kept(best, poses.room_index, len(plan.rooms))
    pose, hypothesis = np.divmod(kept, best.shape[1])
    return {
        "pose": pose.astype(np.int32),
        "position_m": poses.position_m[pose].astype(np.float32),
        "room": poses.room_index[pose].astype(np.int32),
        "hypothesis": hypothesis.astype(np.uint8),
        "log_likelihood": best.ravel()[kept].astype(np.float32),
        "rooms": _room_means(best, poses.room_index, len(plan.rooms)).astype(np.float32),
        "room_types": _by_type(plan, query.room_type, weights.room_type * weights.temperature),
        "heights": heights.astype(np.float32),
    }


def _of_other_homes(
    encoder: PhotographEncoder,
    compared: Comparison,
    costs: Float[np.ndarray, "1 j"],
    trust_number: int,
    own: Float[np.ndarray, "n k"],
) -> float:
    """Return the log mean likelihood of poses of other homes, under one trust; of `own` if the model has none."""
    cohort = encoder.layouts.cohort
    if cohort is None:
        return _log_sum(own) - math.log(own.size)
    layouts = cohort.layouts.rows(np.arange(0, len(cohort.layouts), _EVERY))
    ground, trusts = BinnedGround.of(layouts), np.full(len(layouts), trust_number)
    best = [(log - costs).max(axis=2) for _, log in compared.log_likelihoods(ground, trusts)]
    return _log_sum(np.concatenate(best)) - math.log(len(layouts) * own.shape[1])


def _room_means(log: Float[np.ndarray, "n k"], room_index: Int[np.ndarray, "n"], rooms: int) -> Float[np.ndarray, "r"]:
    """Return the log mean likelihood of every room; of the least likely one for rooms without poses."""
    highest, by_pose = log.max(axis=1), np.empty(len(log), np.float32)
    for first in range(0, len(log), _PART):
        part = slice(first, first + _PART)
        by_pose[part] = highest[part] + np.log(np.exp(log[part] - highest[part, None]).mean(axis=1))
    total, count = log_sums(by_pose, room_index, rooms), np.bincount(room_index, minlength=rooms)
    mean = total - np.log(np.maximum(count, 1))
    return np.where(count > 0, mean, mean[count > 0].min())


def log_sums(log: Float[np.ndarray, "m"], room: Int[np.ndarray, "m"], rooms: int) -> Float[np.ndarray, "r"]:
    """Return the log of the summed likelihood of each room, however unlikely it is; -inf for rooms without any."""
    highest = np.full(rooms, -np.inf)
    np.maximum.at(highest, room, log)
    total = np.bincount(room, np.exp(log - highest[room]), minlength=rooms)
    return np.where(total > 0.0, highest + np.log(np.maximum(total, 1.0)), -np.inf)


def _kept(best: Float[np.ndarray, "n k"], room_index: Int[np.ndarray, "n"], rooms: int) -> Int[np.ndarray, "m"]:
    """Return the row-major numbers of the best states of every room."""
    each = max(min(_PER_ROOM, _MAX_STATES // rooms), 1)
    parts = []
    for room in range(rooms):
        rows = np.flatnonzero(room_index == room)
        values = best[rows].ravel()
        top = np.argpartition(-values, min(each, len(values) - 1))[:each] if len(values) else np.zeros(0, int)
        place, hypothesis = np.divmod(top, best.shape[1])
        parts.append(rows[place] * best.shape[1] + hypothesis)
    return np.concatenate(parts)


def room_types(
    plan: FloorPlan, encoder: PhotographEncoder, photograph: Photograph, evidence: Arrays
) -> Float[np.ndarray, "r"]:
    """Return the log likelihood of every room's type, over that of a room of unknown type.

    As in the matching cost, recognised objects replace the encoder's own prediction, which `evidence` has.
    """
    objects = encoder.seen_objects([(photograph, 0.0)])
    return evidence["room_types"] if objects is None else _by_type(plan, objects.room_type, 1.0)


def types_by_names(plan: FloorPlan, photographs: Sequence[AlbumPhotograph]) -> Float[np.ndarray, "n r"]:
    """Return the log likelihood of every room by the type that each file's name tells, as "Kitchen_01.jpg" does.

    A type that most names tell is of the folder, such as that of a street, and tells nothing.
    """
    kinds = [set(room_types_from_name(PurePath(each.name).stem)) for each in photographs]
    often = {kind for kind in set[str]().union(*kinds) if sum(kind in each for each in kinds) > _COMMON * len(kinds)}
    log = np.zeros((len(kinds), len(plan.rooms)))
    for row, named in zip(log, kinds, strict=True):
        if own := named - often:
            row[:] = [
                0.0 if own.intersection(room.types) else _MISNAMED if room.types else _UNTYPED for room in plan.rooms
            ]
    return log


def _by_type(plan: FloorPlan, predicted: PredictedRoomType | None, weight: float) -> Float[np.ndarray, "r"]:
    if predicted is None:
        return np.zeros(len(plan.rooms), np.float32)
    loss = room_type_losses(predicted, _CONFIG.floor)
    return np.float32(weight) * (loss[0] - losses_of_rooms(loss, plan.type_shares)).astype(np.float32)


def _height_costs(
    ceiling_m: Float[np.ndarray, "r"], query: Query, weights: MatchingWeights
) -> Float[np.ndarray, "r j"]:
    """Return the negative log likelihood of each height offset, with that of each ceiling (m above the floor) then."""
    usual = 0.5 * np.square(_OFFSETS / _USUAL_LOG_SD)
    if query.ceiling is None:
        return np.tile(usual, (len(ceiling_m), 1)).astype(np.float32)
    clearance_m = ceiling_m[:, None] - _USUAL_HEIGHT_M * np.exp(_OFFSETS)
    cost = ceiling_costs(query.ceiling, clearance_m, _OFFSETS, weights.tail)
    return (usual + weights.ceiling * weights.temperature * cost).astype(np.float32)


def _log_sum(values: np.ndarray) -> float:
    highest = float(values.max())
    return highest + math.log(float(np.exp(values - highest).sum()))


def shared_cameras(photographs: Sequence[AlbumPhotograph]) -> tuple[SharedCamera, ...]:
    """Return the cameras of an album, with the field of view by all photographs of each."""
    groups: dict[tuple[str, str, int, int], list[AlbumPhotograph]] = {}
    for photograph in photographs:
        if not photograph.photograph.is_sphere:
            groups.setdefault(photograph.camera_key, []).append(photograph)
    found = []
    for (make, model, width, height), members in groups.items():
        stated = [each for each in members if each.photograph.has_stated_field]
        fields = np.array([each.photograph.hfov.value for each in stated or members])
        # Fisheye lenses and strips have no focal length in perspective, by which fields are compared.
        is_flat = fields.max() < _WIDEST
        log_size = np.log(np.tan(0.5 * fields) if is_flat else fields)
        middle = float(np.median(log_size))
        spread = float(np.median(np.abs(log_size - middle))) * 1.48
        hfov = 2.0 * math.atan(math.exp(middle)) if is_flat else math.exp(middle)
        sd = 0.0 if len(stated) == len(members) else math.hypot(_MEDIAN * spread / math.sqrt(len(fields)), _LINES_SD)
        found.append(
            SharedCamera(
                make=make,
                model=model,
                width=width,
                height=height,
                photographs=len(members),
                hfov=hfov,
                hfov_sd=sd * (math.sin(hfov) if is_flat else hfov),
            )
        )
    return tuple(found)


def camera_height(ground: AlbumGround, evidence: Sequence[Arrays]) -> tuple[float, float]:
    """Return the height of the cameras (m) and the scale of the plan.

    Photographs tell the height in units of the plan, so one factor is divided between both by what is known of each.
    """
    total = np.zeros(len(_OFFSETS))
    usual = -0.5 * np.square(_OFFSETS / _USUAL_LOG_SD)
    spread = np.exp(-0.5 * np.square((_OFFSETS[:, None] - _OFFSETS) / _HAND_SD))
    for arrays in evidence:
        alone = arrays["heights"] - usual
        total += np.log(spread @ np.exp(alone - alone.max()) + 1e-3)
    plan = ground.plan
    prior_m = plan.camera_height_m if plan.states_camera_height else _USUAL_HEIGHT_M
    stated_sd_m = DEFAULT_STD_M if plan.camera_height_std_m is None else plan.camera_height_std_m
    log_sd = max(stated_sd_m / prior_m, 1e-3) if plan.states_camera_height else _USUAL_LOG_SD
    prior = math.log(prior_m / _USUAL_HEIGHT_M)
    total -= 0.5 * np.square(_OFFSETS - prior) / (log_sd**2 + _SCALE_SD**2)
    share = np.exp(total - total.max())
    share /= share.sum()
    # A higher camera and a smaller plan look the same.
    part = _SCALE_SD**2 / (log_sd**2 + _SCALE_SD**2)
    moved = float(share @ _OFFSETS) - prior
    return prior_m * math.exp((1.0 - part) * moved), math.exp(-part * moved)
