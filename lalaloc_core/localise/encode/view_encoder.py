"""Exported networks of photographs that show a part of the horizon: the encoder of views, and those of objects."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from onnxruntime import InferenceSession

from lalaloc_core.bundle import DETECTOR_ONNX, OBJECTS_ONNX, VIEW_ONNX, Bundle, ObjectsManifest
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import BundleError
from lalaloc_core.localise.encode.exported_network import (
    PROFILE_OUTPUTS,
    SHARE_OUTPUT,
    STRUCTURE_OUTPUTS,
    as_array,
    open_session,
    query_of_hypotheses,
    turned_predictions,
)
from lalaloc_core.localise.query import CameraHeight, PredictedRoomType, Query, SeenObject, SeenObjects
from lalaloc_core.photograph import Photograph

# Standard deviation (radians) of errors of levelling that the network was trained with.
_TRAINED_TILT_SD = math.radians(0.7)
# Patches that the network reads at once, to bound memory: a query can have a hundred.
_BATCH = 4
# Smallest share of an azimuth column that must be seen to count.
MIN_SEEN = 0.25
VIEW_OUTPUTS = [*PROFILE_OUTPUTS, SHARE_OUTPUT, "seen", *STRUCTURE_OUTPUTS]
OBJECT_OUTPUTS = ("object_probability", "object_azimuth")
# Least probability of objects that are named, a probability whose log is finite, and the largest one that a photograph
# shows any object.
_LEAST, _NEVER, _MOST_SEEN = 0.1, 1e-9, 0.98
# Probability of all objects together, which are those of households, and the log likelihood ratio of outside to inside:
# of 32 real photographs outside (12 of streets, façades and woods), and of 122 real and 220 rendered views of rooms.
_HOUSEHOLD, _OUTSIDE = (0.02, 0.035, 0.05, 0.07, 0.09, 0.12, 0.2), (5.0, 4.2, 3.0, 1.5, 0.5, -1.5, -3.0)
# Weights of recognised objects in the log odds of a picture that is upright. Probabilities that are added before the
# log of one object and of all, the weight of each of several photographs, and the probability that is warned about.
_UPRIGHT = tomllib.loads(Path(__file__).with_name("upright.toml").read_text(encoding="utf-8"))
_RARE, _ANY, _SEVERAL, _TURNED = 0.003, 0.01, 0.5, 0.95
# Photographs of a spot that are checked.
_CHECKED = 4
# Where a picture lies that one to three quarter turns to the left make upright, and how to turn it.
_LIES = (("on its side", "90° to the left"), ("upside down", "180°"), ("on its side", "90° to the right"))


class ViewEncoder:
    """Encoder of views of one bundle, ready to run; safe to share between threads."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        self._manifest = bundle.manifest
        if self._manifest.view is None:
            raise BundleError(f"model '{self._manifest.name}' has no encoder of views ({VIEW_ONNX}); it needs spheres")
        self._view = self._manifest.view
        self._session = open_session(bundle.read(VIEW_ONNX), threads)

    def query_of_outputs(
        self,
        outputs: Mapping[str, np.ndarray],
        placed: Sequence[tuple[float, float]],
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
    ) -> Query:
        """Return the query of a photograph that shows a part of the horizon, by the outputs for its patches.

        `placed` has the azimuth (radians) of each patch's centre relative to the photograph's, and the standard
        deviation (radians) of the error of levelling there; where patches overlap, the nearer centre counts. An unknown
        heading has a hypothesis for each column; see `SphereEncoder.query` for the other arguments.
        """
        columns = self._manifest.profile_columns
        circle = self._on_circle(outputs, placed, camera_height.height_m)

        def hypotheses(shifts: Int[np.ndarray, "k"]) -> Query:
            latents = np.zeros((len(shifts), self._manifest.latent_size), np.float32)
            predictions = turned_predictions(circle, shifts, self._view)
            roll = shifts * (TWO_PI / columns)
            return Query(latents, roll, 0.0, False, camera_height, **predictions, is_view=True)

        return query_of_hypotheses(hypotheses, columns, heading, heading_tolerance)

    def outputs(self, images: Sequence[UInt8[np.ndarray, "h w 4"]], camera_height_m: float) -> dict[str, np.ndarray]:
        """Run the network on level patches (`Patch.rgba`); return its outputs by patch."""
        parts: list[list[np.ndarray]] = []
        for first in range(0, len(images), _BATCH):
            batch = images[first : first + _BATCH]
            inputs = {"image": np.stack(batch), "camera_height_m": np.full(len(batch), camera_height_m, np.float32)}
            parts.append([as_array(value) for value in self._session.run(VIEW_OUTPUTS, inputs)])
        columns = zip(*parts, strict=True)
        return {name: np.concatenate(values) for name, values in zip(VIEW_OUTPUTS, columns, strict=True)}

    def _on_circle(
        self, outputs: Mapping[str, np.ndarray], placed: Sequence[tuple[float, float]], camera_height_m: float
    ) -> dict[str, np.ndarray]:
        """Return the predictions of patches by azimuth column of the full circle."""
        columns, prior = self._manifest.profile_columns, np.array(self._view.opening_prior)
        tilt_sd = np.array([sd for _, sd in placed])[:, None, None]
        widened = _widened(outputs["log_profile"], outputs["log_scale"], tilt_sd, camera_height_m)
        predicted = {**outputs, "log_scale": widened}
        modes = predicted["log_profile"].shape[2]
        circle = {
            "log_profile": np.zeros((columns, modes), np.float32),
            "log_scale": np.full((columns, modes), np.inf, np.float32),
            "log_share": np.full((columns, modes), -math.log(modes), np.float32),
            "opening_logits": np.tile(np.log(prior).astype(np.float32), (columns, 1)),
        }
        width = predicted["seen"].shape[1]
        offset = np.arange(width) - width // 2
        distance = np.full(columns, np.inf)
        for row, (azimuth, _) in enumerate(placed):
            place = (columns // 2 + round(azimuth / TWO_PI * columns) + offset) % columns
            nearer = (predicted["seen"][row] >= MIN_SEEN) & (np.abs(offset + 0.5) < distance[place])
            distance[place[nearer]] = np.abs(offset + 0.5)[nearer]
            for name, values in circle.items():
                values[place[nearer]] = predicted[name][row][nearer]
        for name in STRUCTURE_OUTPUTS[1:]:
            circle[name] = predicted[name].mean(axis=0)
        return circle


def _widened(
    log_m: Float[np.ndarray, "*n"],
    log_scale: Float[np.ndarray, "*n"],
    tilt_sd: Float[np.ndarray, "*#n"],
    camera_height_m: float,
) -> Float[np.ndarray, "*n"]:
    """Return the log scales of walls whose floor edges are seen at an uncertain elevation.

    An edge at the elevation -e is at the distance h / tan e, so an error of e changes the log distance by 1 / (sin e
    cos e) times as much. The variance of a Laplace distribution is twice its squared scale.
    """
    slope = camera_height_m * np.exp(-log_m)
    untrained = np.sqrt(np.maximum(np.square(tilt_sd) - _TRAINED_TILT_SD**2, 0.0))
    error = untrained * (1.0 + np.square(slope)) / slope
    return np.log(np.hypot(np.exp(log_scale), error / math.sqrt(2.0)))


class ObjectEncoder:
    """Classifier and detector of objects of one bundle; safe to share between threads."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        assert bundle.manifest.objects is not None
        self._bundle, self._threads, self._manifest = bundle, threads, bundle.manifest.objects
        self._session = open_session(bundle.read(OBJECTS_ONNX), threads)

    @cached_property
    def _detector(self) -> InferenceSession:
        # Loaded by the first album, because others do without.
        return open_session(self._bundle.read(DETECTOR_ONNX), self._threads)

    def outputs(self, photograph: Photograph, *, detects: bool = False) -> dict[str, Float[np.ndarray, "n"]]:
        """Return the probability of each object, and its azimuth (radians) relative to the photograph's centre.

        The photograph has a thumbnail, a camera and axes. The detector takes three times as long as the classifier, so
        it runs only if asked for; without it, its objects have the probability 0.
        """
        thumbnail = photograph.thumbnail
        assert thumbnail is not None
        inputs = {"image": thumbnail[None]}
        probability, by_column = map(as_array, self._session.run(["probability", "by_column"], inputs))
        score = np.zeros((1, self._manifest.detected, by_column.shape[2]), np.float32)
        if detects and self._manifest.detected:
            score = as_array(self._detector.run(["by_column"], inputs)[0])
        excess = np.maximum(score[0].max(axis=1) - self._manifest.detected_floor, 0.0)
        detected = self._manifest.detected_weight / (1.0 - self._manifest.detected_floor) * excess
        column = np.concatenate([by_column[0].argmax(axis=1), score[0].argmax(axis=1)])
        return {
            "object_probability": np.concatenate([probability[0], detected]).astype(np.float32),
            "object_azimuth": _column_azimuths(photograph, by_column.shape[2])[column],
        }

    def lying(self, photographs: Sequence[Photograph]) -> tuple[str, ...]:
        """Return a warning if photographs of one spot lie on their side or upside down, by the objects in some of them.

        Each takes four times as long as recognising its objects.
        """
        unknown = [each.thumbnail for each in photographs if not each.is_upright and each.thumbnail is not None]
        checked = unknown[:: max(1, -(-len(unknown) // _CHECKED))]
        if not checked:
            return ()
        log = (1.0 if len(checked) == 1 else _SEVERAL) * np.sum([self._upright(each) for each in checked], axis=0)
        turns = int(log.argmax())
        if not turns or log[turns] - np.logaddexp.reduce(log) < math.log(_TURNED):
            return ()
        (place, turn), named = (
            _LIES[turns - 1],
            "the photograph" if len(photographs) == 1 else "each photograph or frame",
        )
        return (
            f"{named} may lie {place}: turned by {turn}, the objects in sight are upright; turn it, and send it again",
        )

    def _upright(self, thumbnail: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "4"]:
        """Return the log odds that a picture is upright as it is, and turned to the left by one to three quarters."""
        turned = (np.ascontiguousarray(np.rot90(thumbnail, turns))[None] for turns in range(4))
        rows = np.concatenate([as_array(self._session.run(["probability"], {"image": each})[0]) for each in turned])
        weights = np.array([_UPRIGHT.get(name, 0.0) for name in self._manifest.names[: rows.shape[1]]])
        return np.log(rows + _RARE) @ weights + _UPRIGHT["all objects"] * np.log(rows.sum(axis=1) + _ANY)

    def warm_up(self) -> None:
        """Run the network once, because the first run allocates memory."""
        image: UInt8[np.ndarray, "1 h w 3"] = np.zeros((1, 256, 320, 3), np.uint8)
        self._session.run(["probability"], {"image": image})


def objects_of_views(
    manifest: ObjectsManifest, views: Sequence[tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
) -> SeenObjects:
    """Return what the photographs of one spot show.

    `views` are the probabilities of the objects in each photograph, and their azimuths (radians) relative to the centre
    of the first one. The likelihood of a type is a mixture: by each object that can be there, and 1 if none is, so that
    a blank wall tells no type. Classifier and detector each have a mixture.
    """
    probability, shares = np.stack([share for share, _ in views]), np.array(manifest.shares)
    mean, types, recognised = probability.mean(axis=0), shares.shape[1] - 1, len(shares) - manifest.detected
    present = np.maximum(mean[:recognised] - manifest.floor, 0.0)
    likelihood = _mixture(present, shares[:recognised]) * _mixture(mean[recognised:], shares[recognised:])
    # Objects are never those of the unknown type.
    likelihood[0] = _NEVER
    room_type = PredictedRoomType(np.log(likelihood / likelihood.sum()), np.full(types + 1, 1.0 / types))
    best = probability.argmax(axis=0)
    named = [number for number in np.argsort(-probability.max(axis=0)) if probability[best[number], number] >= _LEAST]
    objects = tuple(
        SeenObject(
            manifest.names[number], float(probability[best[number], number]), float(views[best[number]][1][number])
        )
        for number in named
    )
    return SeenObjects(room_type, objects, min(outside_odds(share[:recognised]) for share in probability))


def _mixture(present: Float[np.ndarray, "n"], shares: Float[np.ndarray, "n t"]) -> Float[np.ndarray, "t"]:
    """Return the likelihood of every type by objects that are each present with a probability."""
    present = present * min(1.0, _MOST_SEEN / max(float(present.sum()), _NEVER))
    return 1.0 - present.sum() + (shares.shape[1] - 1) * present @ shares


def outside_odds(probability: Float[np.ndarray, "n"]) -> float:
    """Return the log likelihood ratio of a photograph taken outside to one of a room, by the objects recognised."""
    return float(np.interp(probability.sum(), _HOUSEHOLD, _OUTSIDE))


def _column_azimuths(photograph: Photograph, columns: int) -> Float[np.ndarray, "columns"]:
    """Return the azimuth (radians) of the middle of each column of the photograph, relative to its centre."""
    camera, axes = photograph.camera, photograph.axes
    assert camera is not None
    assert axes is not None
    x = (np.arange(columns) + 0.5) / columns * camera.width
    rays = camera.rays(np.stack([x, np.full(columns, 0.5 * camera.height)], axis=1)) @ axes
    return np.arctan2(rays[:, 0], rays[:, 1])
