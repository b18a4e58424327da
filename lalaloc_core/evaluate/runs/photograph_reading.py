"""Predictions of a model on annotated photographs, per azimuth: walls and openings, and their errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError
from lalaloc_core.learn.data import CAMERA_HEIGHT_M, AnnotatedPhotograph, CachedSphere, ViewPhotograph
from lalaloc_core.learn.data.drawn_rooms import DrawnRoom
from lalaloc_core.learn.metrics import AzimuthMeasures, AzimuthSummary, measure_azimuths, summarise_azimuths
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.photograph import Photograph

# Errors (degrees) of the direction of walls within which views are counted.
_DIRECTION_LIMITS_DEG = (2.0, 4.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class ReadPhotograph:
    """Photograph with its predicted walls and openings.

    `class_scores` are predicted log likelihoods up to a constant; None if the model predicts none.
    """

    photograph: AnnotatedPhotograph
    profile_m: Float[np.ndarray, "w"]
    class_scores: Float[np.ndarray, "w c"] | None
    measures: AzimuthMeasures


@dataclass(frozen=True, kw_only=True)
class ReadViews:
    """Errors of views of one field, cut from photographs.

    Attributes:
        by_reader: summaries over all views by what reads them: "view" is the encoder of views. The others bound it:
            "sphere" is the encoder of spheres with the whole photograph in sight, "constant" the median annotated
            distance everywhere.
        walls_within: shares of the views whose lines tell the direction of the walls within some degrees.
        types: of views of rooms of a known type, the share whose objects tell it first, that of those with a recognised
            object, and the mean log probability of the type; empty without objects.
    """

    by_reader: dict[str, AzimuthSummary]
    walls_within: dict[str, float]
    types: dict[str, float]


def read_photographs(encoders: PhotographEncoder, photographs: Sequence[AnnotatedPhotograph]) -> list[ReadPhotograph]:
    """Predict walls and openings of each photograph and compare them with the annotation."""
    manifest = encoders.manifest
    read = []
    for photograph in photographs:
        image = photograph.photograph.image(manifest.image_height, manifest.image_width)
        log_m, log_scale, scores = read_azimuths(encoders, image, CAMERA_HEIGHT_M)
        measures = measure_azimuths(
            [photograph.profile_m(outline, len(log_m)) for outline in range(len(photograph.outlines))],
            log_m,
            log_scale,
            photograph.classes(len(log_m)),
            scores,
        )
        read.append(
            ReadPhotograph(photograph=photograph, profile_m=np.exp(log_m), class_scores=scores, measures=measures)
        )
    return read


def read_views(
    encoders: PhotographEncoder, read: Sequence[ReadPhotograph], field_deg: float, per_photograph: int
) -> ReadViews:
    """Compare level views of photographs, cut at equal angles, with their annotations, at the azimuths they show."""
    size = patch_size(encoders.manifest)
    annotated_m = [item.photograph.profile_m(0, len(item.profile_m)) for item in read]
    constant = np.log(np.median(np.concatenate(annotated_m)))
    measures: dict[str, list[AzimuthMeasures]] = {"view": [], "sphere": [], "constant": []}
    misaligned_deg: list[float] = []
    types: list[tuple[bool, bool, float]] = []
    for item in read:
        photograph, sphere = item.photograph, CachedSphere(item.photograph.photograph)
        width = len(item.profile_m)
        profiles_m = [photograph.profile_m(outline, width) for outline in range(len(photograph.outlines))]
        classes = photograph.classes(width)
        for number in range(per_photograph):
            azimuth = float(wrap_angle(TWO_PI * number / per_photograph))
            view = ViewPhotograph(
                sphere=sphere, azimuth=azimuth, field_deg=field_deg, pitch=0.0, roll=0.0, stated="tilt"
            )
            # With its azimuth as heading, a view is read in the frame of its sphere.
            opened = view.open(size)
            query = encoders.query(opened, azimuth, CameraHeight(CAMERA_HEIGHT_M, 0.0))
            misaligned_deg.append(_misaligned_deg(opened, azimuth, photograph.outlines[0]))
            kind = ROOM_TYPES.index(photograph.outlines[0].room_type)
            if query.objects is not None and kind:
                log = query.objects.room_type.log_probability
                types.append((int(log.argmax()) == kind, bool(query.objects.objects), float(log[kind])))
            log_m, log_scale, scores = _azimuths(query, encoders.manifest.name)
            seen = np.isfinite(log_scale)
            readings = {
                "view": (log_m, log_scale, scores),
                "sphere": (np.log(item.profile_m), item.measures.log_scale, item.class_scores),
                "constant": (np.full(width, constant), np.zeros(width), None),
            }
            for reader, (walls, scale, kinds) in readings.items():
                true_m = [profile_m[seen] for profile_m in profiles_m]
                kinds = None if kinds is None else kinds[seen]
                measures[reader].append(measure_azimuths(true_m, walls[seen], scale[seen], classes[seen], kinds))
    within = {f"{limit:g}": float(np.mean(np.array(misaligned_deg) < limit)) for limit in _DIRECTION_LIMITS_DEG}
    summaries = {reader: summarise_azimuths(of, OPENING_CLASSES) for reader, of in measures.items()}
    return ReadViews(by_reader=summaries, walls_within=within, types=_of_types(types))


def _of_types(views: Sequence[tuple[bool, bool, float]]) -> dict[str, float]:
    """Return the figures of views, each with whether the type is right and an object named, and its log probability."""
    if not views:
        return {}
    named = [is_right for is_right, is_named, _ in views if is_named]
    share, _, log = (float(np.mean(values)) for values in zip(*views, strict=True))
    return {"types": share, "types with an object": float(np.mean(named)) if named else 0.0, "types log": log}


def read_azimuths(
    encoders: PhotographEncoder, image: UInt8[np.ndarray, "height width 3"], camera_height_m: float
) -> tuple[Float[np.ndarray, "w"], Float[np.ndarray, "w"], Float[np.ndarray, "w c"] | None]:
    """Predict a sphere's log wall profile (m) in its own frame, its log scale, and `ReadPhotograph.class_scores`."""
    return _azimuths(encoders.spheres.query(image, 0.0, CameraHeight(camera_height_m, 0.0)), encoders.manifest.name)


def _misaligned_deg(view: Photograph, azimuth: float, room: DrawnRoom) -> float:
    """Return the error of the direction that lines tell, against that of most walls; infinite if they tell none."""
    if view.wall_direction is None:
        return math.inf
    along_m = room.walls_m[:, 2:] - room.walls_m[:, :2]
    along = np.arctan2(along_m[:, 0], along_m[:, 1])
    # Four times an angle that repeats by a quarter turn is an angle again.
    true = (np.hypot(*along_m.T) * np.exp(4j * along)).sum()
    error = np.exp(4j * (view.wall_direction.value + azimuth)) / true
    return abs(math.degrees(np.angle(error))) / 4.0


def _azimuths(
    query: Query, model: str
) -> tuple[Float[np.ndarray, "w"], Float[np.ndarray, "w"], Float[np.ndarray, "w c"] | None]:
    if query.profile is None:
        raise BundleError(f"model '{model}' predicts no wall profile; use another bundle")
    # Relative to the shares of the classes, as in the matching cost, so that every class counts alike.
    openings = query.openings
    scores = None if openings is None else openings.log_probability[0] - np.log(openings.prior)
    return query.profile.log_m[0], query.profile.log_scale[0], scores
