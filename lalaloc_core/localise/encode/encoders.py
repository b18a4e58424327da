"""Exported encoders on onnxruntime: latents of layouts, latents and predictions of panoramas. Never imports torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.bundle import HEAD_ONNX, IMAGE_ONNX, LAYOUT_ONNX, Bundle
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.sphere_network import PROFILE_OUTPUTS, SphereNetwork, array, session
from lalaloc_core.localise.match import Cohort, Layouts, layouts_at
from lalaloc_core.localise.query import (
    CameraHeight,
    PredictedCeiling,
    PredictedOpenings,
    PredictedProfile,
    PredictedRoomType,
    Query,
    rolled,
)
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at

# Larger batches do not fit the cache, and are no faster.
_LAYOUT_BATCH = 256
# Headings at which an architecture without a ring encodes the panorama, one pass each.
_HEADINGS_WITHOUT_RING = 32


class Encoders:
    """Both encoders of one bundle, ready to run; safe to share between threads.

    Attributes:
        cohort: poses of other homes; None if the bundle has none.
        images: image encoder of spheres.
        predicts_profile: whether the image encoder predicts a wall profile.
        predicts_structure: whether it predicts openings, ceiling and room type.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Create the onnxruntime sessions.

        `threads` is the number of intra-op threads per session, 0 for one per core.

        Raises:
            BundleError: a file is missing or altered, or the model has other opening classes or room types.
        """
        self.manifest = bundle.manifest
        self.cohort = Cohort.of_bundle(bundle)
        self._layout = session(bundle.read(LAYOUT_ONNX), threads)
        self.images = SphereNetwork(bundle, threads=threads)
        self.predicts_profile = self.images.predicts_profile
        self.predicts_structure = self.images.predicts_structure
        self._head = session(bundle.read(HEAD_ONNX), threads) if self.manifest.ring_sectors else None

    def layouts(
        self,
        profile_m: Float[np.ndarray, "b c"],
        camera_height_m: Float[np.ndarray, "b"],
        ceiling_height_m: Float[np.ndarray, "b"],
    ) -> Float[np.ndarray, "b d"]:
        """Encode layouts, given by their wall profiles and heights (m)."""
        inputs = {
            "profile_m": np.ascontiguousarray(profile_m, dtype=np.float32),
            "camera_height_m": np.asarray(camera_height_m, dtype=np.float32),
            "ceiling_height_m": np.asarray(ceiling_height_m, dtype=np.float32),
        }
        parts = []
        for first in range(0, len(profile_m), _LAYOUT_BATCH):
            batch = {name: value[first : first + _LAYOUT_BATCH] for name, value in inputs.items()}
            parts.append(array(self._layout.run(["latent"], batch)[0]))
        return np.concatenate(parts) if parts else np.empty((0, self.manifest.latent_size), np.float32)

    def poses(
        self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"], camera_height_m: float
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b c"]]:
        """Render and encode the layout of every pose of a plan; return latents and wall profiles (m)."""
        profile_m = self.profiles(plan, poses, heading)
        heights = np.full(len(poses), camera_height_m)
        return self.layouts(profile_m, heights, plan.ceiling_heights_m[poses.room_index]), profile_m

    def rendered(self, plan: FloorPlan, poses: PoseSet) -> Layouts:
        """Render the layouts of grid poses at heading 0, with the networks' number of columns."""
        return layouts_at(plan, poses, np.zeros(len(poses)), self.manifest.profile_columns)

    def profiles(self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b c"]:
        """Render wall profiles (m) of poses of a plan, with the layout encoder's number of columns."""
        columns = self.manifest.profile_columns
        return profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)

    def query(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
    ) -> Query:
        """Return the query of a panorama of the bundle's input size.

        The panorama is first rolled to undo the heading, if it is known. Each hypothesis then assumes a rotation from
        there by a number of sectors, of which a full turn has `ring_sectors`. The camera height gives the picture its
        metric scale. Without `heading`, the azimuth of the centre column (radians), there is one hypothesis per sector;
        if `heading_tolerance` (radians) is not 0, there are hypotheses for the sectors within it, and the heading is
        refined.
        """
        frame, frame_roll, frame_heading = (image, 0.0, 0.0) if heading is None else _undo_heading(image, heading)
        if self._head is None:
            sectors = _HEADINGS_WITHOUT_RING
            shifts = _shifts(heading, heading_tolerance, sectors)
            latents = self._latents_of_rolled_images(frame, camera_height.height_m, shifts, sectors)
            roll = frame_roll + shifts * (TWO_PI / sectors)
            known = heading is not None and heading_tolerance == 0.0
            return Query(latents, roll, frame_heading, known, camera_height)
        # Rolling the ring rotates the camera, so the image is encoded once for all hypotheses.
        outputs = self.images.outputs(frame, camera_height.height_m)
        turned = _Frame(heading, heading_tolerance, frame_roll, frame_heading)
        return self._query_in_frame(outputs, turned, camera_height)

    def query_of_outputs(
        self,
        outputs: Mapping[str, np.ndarray],
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
    ) -> Query:
        """Return the query of a panorama that was encoded without a heading, by the outputs of its image encoder.

        `outputs` are for the given camera height. The other arguments are as for `query`. A heading is undone by whole
        sectors instead of pixels.
        """
        sector = TWO_PI / self.manifest.ring_sectors
        shift = 0 if heading is None else round(heading / sector)
        frame_heading = 0.0 if heading is None else float(wrap_angle(heading - shift * sector))
        turned = _Frame(heading, heading_tolerance, 0.0, frame_heading, shift)
        return self._query_in_frame(outputs, turned, camera_height)

    def profile(
        self, image: UInt8[np.ndarray, "h w 3"], heading: float, camera_height_m: float
    ) -> tuple[Float[np.ndarray, "columns"], float]:
        """Predict the wall profile (m) of a panorama of the bundle's input size.

        Returns:
            The profile with the heading undone by whole pixels, and the rest: the heading (radians) of the layouts to
            compare it with.

        Raises:
            BundleError: the bundle's image encoder predicts no wall profile.
        """
        query = self.query(image, heading, CameraHeight(camera_height_m, 0.0))
        if query.profile is None:
            raise BundleError(
                f"model '{self.manifest.name}' (architecture '{self.manifest.architecture}') predicts no wall profile: "
                f"{IMAGE_ONNX} has no output '{PROFILE_OUTPUTS[0]}'"
            )
        return np.exp(query.profile.log_m[0]), query.frame_heading

    def _latents_of_rolled_images(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, shifts: Int[np.ndarray, "k"], sectors: int
    ) -> Float[np.ndarray, "k d"]:
        """Encode an image once for each number of sectors to the right, for architectures without a ring."""
        width = image.shape[1]
        frames = (np.roll(image, int(shift) * width // sectors, axis=1) for shift in shifts)
        return np.concatenate([self.images.run(frame[None], camera_height_m, ["latent"])[0] for frame in frames])

    def _query_in_frame(self, outputs: Mapping[str, np.ndarray], frame: _Frame, camera_height: CameraHeight) -> Query:
        """Return the query of a panorama by the outputs of its image encoder."""
        sectors = self.manifest.ring_sectors
        shifts = frame.shift + _shifts(frame.heading, frame.tolerance, sectors)
        query = self._query_from_ring(outputs, shifts, frame.roll, camera_height)
        searched = None
        if frame.heading is not None and self.predicts_profile:
            searched = self._query_from_ring(outputs, np.arange(sectors), frame.roll, camera_height)
        known = frame.heading is not None and frame.tolerance == 0.0
        return replace(query, frame_heading=frame.rest, heading_known=known, searched=searched)

    def _query_from_ring(
        self,
        outputs: Mapping[str, np.ndarray],
        shifts: Int[np.ndarray, "k"],
        frame_roll: float,
        camera_height: CameraHeight,
    ) -> Query:
        """Return a query with one hypothesis for each shift, its heading unknown.

        The ring and the predictions in `outputs`, see `SphereNetwork.outputs`, are rolled to the right by `shifts`
        sectors; the image was rolled by `frame_roll` (radians) before it was encoded.
        """
        assert self._head is not None
        sectors = outputs["ring"].shape[1]
        ring = np.ascontiguousarray(rolled(outputs["ring"].T, shifts).transpose(0, 2, 1))
        latents = array(self._head.run(["latent"], {"ring": ring})[0])
        predictions = self._predictions(outputs, shifts, sectors) if self.predicts_profile else {}
        return Query(latents, frame_roll + shifts * (TWO_PI / sectors), 0.0, False, camera_height, **predictions)

    def _predictions(
        self, outputs: Mapping[str, np.ndarray], shifts: Int[np.ndarray, "k"], sectors: int
    ) -> dict[str, Any]:
        """Return the predictions of a query, rolled to the right by numbers of sectors."""
        columns = shifts * (len(outputs["log_profile"]) // sectors)
        predictions: dict[str, Any] = {"profile": PredictedProfile.of_outputs(outputs).moved(columns)}
        if self.predicts_structure:
            openings = rolled(log_softmax(outputs["opening_logits"]), columns)
            predictions["openings"] = PredictedOpenings(openings, np.array(self.manifest.opening_prior))
            ceiling = float(outputs["log_ceiling"]), float(outputs["log_ceiling_scale"])
            predictions["ceiling"] = PredictedCeiling(*ceiling)
            types = log_softmax(outputs["room_type_logits"])
            predictions["room_type"] = PredictedRoomType(types, np.array(self.manifest.room_type_prior))
        return predictions


class _Frame(NamedTuple):
    """Frame of an encoded panorama.

    Attributes:
        heading, tolerance: azimuth of the centre and its largest error (radians); None if it is unknown.
        roll: angle (radians) by which the image was rolled before it was encoded.
        rest: part of the heading (radians) that rolling leaves.
        shift: sectors by which the outputs are rolled to undo the heading.
    """

    heading: float | None
    tolerance: float
    roll: float
    rest: float
    shift: int = 0


def _shifts(heading: float | None, tolerance: float, sectors: int) -> Int[np.ndarray, "k"]:
    """Return the hypotheses of the heading, as numbers of sectors."""
    if heading is None:
        return np.arange(sectors)
    largest = min(math.ceil(tolerance / TWO_PI * sectors), (sectors - 1) // 2)
    return np.arange(-largest, largest + 1)


def _undo_heading(image: UInt8[np.ndarray, "h w 3"], heading: float) -> tuple[UInt8[np.ndarray, "h w 3"], float, float]:
    """Roll a panorama by whole pixels so that its centre looks (almost) along azimuth 0.

    Returns:
        The rolled panorama, the angle (radians) that was rolled away, and the rest of the heading (radians).
    """
    pixel = TWO_PI / image.shape[1]
    shift = round(heading / pixel)
    # Column j of the result is column j - shift of the input, which looks `shift` pixels more to the left.
    frame = np.roll(image, shift, axis=1)
    return frame, shift * pixel, float(wrap_angle(heading - shift * pixel))


def log_softmax(logits: Float[np.ndarray, "*n c"]) -> Float[np.ndarray, "*n c"]:
    """Return the logs of the probabilities of classes."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
