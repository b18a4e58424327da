"""Exported encoders on onnxruntime: latents of layouts, latents and predictions of panoramas. Never imports torch."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import onnxruntime
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import HEAD_ONNX, IMAGE_ONNX, LAYOUT_ONNX, Bundle, Manifest
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.cohort import Cohort
from lalaloc_core.localise.layouts import Layouts, layouts_at
from lalaloc_core.localise.poses import (
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
PROFILE_OUTPUTS = ["log_profile", "log_scale"]
STRUCTURE_OUTPUTS = ["opening_logits", "log_ceiling", "log_ceiling_scale", "room_type_logits"]
# Outputs with a value for every azimuth column.
_BY_COLUMN = ("log_profile", "log_scale", "opening_logits")


class Encoders:
    """Both encoders of one bundle, ready to run; safe to share between threads.

    Attributes:
        cohort: poses of other homes; None if the bundle has none.
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
        # A bundle without an image encoder serves layout queries only.
        image = bundle.read(IMAGE_ONNX) if IMAGE_ONNX in self.manifest.files else None
        self._image = None if image is None else session(image, threads)
        inputs = [] if self._image is None else self._image.get_inputs()
        self._image_takes_height = any(node.name == "camera_height_m" for node in inputs)
        outputs = [] if self._image is None else self._image.get_outputs()
        self.predicts_profile = {node.name for node in outputs}.issuperset(PROFILE_OUTPUTS)
        self.predicts_structure = {node.name for node in outputs}.issuperset(STRUCTURE_OUTPUTS)
        if self.predicts_structure:
            _check_classes(self.manifest)
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
        sectors = self.manifest.ring_sectors or _HEADINGS_WITHOUT_RING
        all_shifts = np.arange(sectors)
        max_shift = min(math.ceil(heading_tolerance / TWO_PI * sectors), (sectors - 1) // 2)
        shifts = all_shifts if heading is None else np.arange(-max_shift, max_shift + 1)
        heading_known = heading is not None and heading_tolerance == 0.0
        if self._head is None:
            latents = self._latents_of_rolled_images(frame, camera_height.height_m, shifts, sectors)
            roll = frame_roll + shifts * (TWO_PI / sectors)
            return Query(latents, roll, frame_heading, heading_known, camera_height)
        # Rolling the ring rotates the camera, so the image is encoded once for all hypotheses.
        outputs = self._outputs(frame, camera_height.height_m)
        query = self._query_from_ring(outputs, shifts, frame_roll, camera_height)
        searched = None
        if heading is not None and self.predicts_profile:
            searched = self._query_from_ring(outputs, all_shifts, frame_roll, camera_height)
        return replace(query, frame_heading=frame_heading, heading_known=heading_known, searched=searched)

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
        return np.concatenate([self._run_image(frame[None], camera_height_m, ["latent"])[0] for frame in frames])

    def _query_from_ring(
        self,
        outputs: dict[str, np.ndarray],
        shifts: Int[np.ndarray, "k"],
        frame_roll: float,
        camera_height: CameraHeight,
    ) -> Query:
        """Return a query with one hypothesis for each shift, its heading unknown.

        The ring and the predictions in `outputs` (see `_outputs`) are rolled to the right by `shifts` sectors; the
        image was rolled by `frame_roll` (radians) before it was encoded.
        """
        assert self._head is not None
        sectors = outputs["ring"].shape[1]
        ring = np.ascontiguousarray(rolled(outputs["ring"].T, shifts).transpose(0, 2, 1))
        latents = array(self._head.run(["latent"], {"ring": ring})[0])
        predictions = self._predictions(outputs, shifts, sectors) if self.predicts_profile else {}
        return Query(latents, frame_roll + shifts * (TWO_PI / sectors), 0.0, False, camera_height, **predictions)

    def _outputs(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> dict[str, np.ndarray]:
        """Run the image encoder on a panorama; return its ring (c, s) and all other outputs by name.

        All but the ring are averages over the panorama and its mirror image, which are more accurate.
        """
        if not self.predicts_profile:
            return {"ring": self._run_image(image[None], camera_height_m, ["ring"])[0][0]}
        names = [*PROFILE_OUTPUTS, *(STRUCTURE_OUTPUTS if self.predicts_structure else [])]
        ring, *outputs = self._run_image(np.stack([image, image[:, ::-1]]), camera_height_m, ["ring", *names])
        averaged = {}
        for name, (value, mirrored) in zip(names, outputs, strict=True):
            averaged[name] = 0.5 * (value + (mirrored[::-1] if name in _BY_COLUMN else mirrored))
        return {"ring": ring[0], **averaged}

    def _predictions(
        self, outputs: dict[str, np.ndarray], shifts: Int[np.ndarray, "k"], sectors: int
    ) -> dict[str, Any]:
        """Return the predictions of a query, rolled to the right by numbers of sectors."""
        columns = shifts * (len(outputs["log_profile"]) // sectors)
        profile = PredictedProfile(outputs["log_profile"][None], outputs["log_scale"][None])
        predictions: dict[str, Any] = {"profile": profile.moved(columns)}
        if self.predicts_structure:
            openings = rolled(log_softmax(outputs["opening_logits"]), columns)
            predictions["openings"] = PredictedOpenings(openings, np.array(self.manifest.opening_prior))
            ceiling = float(outputs["log_ceiling"]), float(outputs["log_ceiling_scale"])
            predictions["ceiling"] = PredictedCeiling(*ceiling)
            types = log_softmax(outputs["room_type_logits"])
            predictions["room_type"] = PredictedRoomType(types, np.array(self.manifest.room_type_prior))
        return predictions

    def _run_image(
        self, images: UInt8[np.ndarray, "b h w 3"], camera_height_m: float, outputs: list[str]
    ) -> list[np.ndarray]:
        """Run the image encoder on a batch; return some outputs."""
        if self._image is None:
            raise BundleError(
                f"model '{self.manifest.name}' has no image encoder ({IMAGE_ONNX}); it serves layout queries only"
            )
        inputs = {"image": np.ascontiguousarray(images)}
        if self._image_takes_height:
            inputs["camera_height_m"] = np.full(len(images), camera_height_m, dtype=np.float32)
        return [array(value) for value in self._image.run(outputs, inputs)]


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


def _check_classes(manifest: Manifest) -> None:
    """Check that the model was trained with the class codes of this version."""
    for name, expected in (("opening_classes", OPENING_CLASSES), ("room_types", ROOM_TYPES)):
        stated = getattr(manifest, name)
        if stated != list(expected):
            raise BundleError(f"model '{manifest.name}' has the {name} {stated}; this version needs {list(expected)}")
    for name, classes in (("opening_prior", OPENING_CLASSES), ("room_type_prior", ROOM_TYPES)):
        if len(getattr(manifest, name)) != len(classes):
            raise BundleError(f"model '{manifest.name}': {name} needs one value for each of {list(classes)}")


def log_softmax(logits: Float[np.ndarray, "*n c"]) -> Float[np.ndarray, "*n c"]:
    """Return the logs of the probabilities of classes."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def array(value: object) -> np.ndarray:
    """Return a network's output, which onnxruntime types as any object, as an array."""
    assert isinstance(value, np.ndarray)
    return value


def session(model: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Create a session with a number of intra-op threads, 0 for one per core."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Spinning idle threads would take the cores of the LPO workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
