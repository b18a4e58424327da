"""The exported encoders on onnxruntime: layouts and panoramas to latents. Never imports torch."""

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

# Larger batches fall out of the cache and gain nothing.
_LAYOUT_BATCH = 256
# An architecture without a ring has to see the panorama turned, once per heading.
_HEADINGS_WITHOUT_RING = 32
_PROFILE_OUTPUTS = ["log_profile", "log_scale"]
_STRUCTURE_OUTPUTS = ["opening_logits", "log_ceiling", "log_ceiling_scale", "room_type_logits"]
# These have a value for every azimuth column.
_BY_COLUMN = ("log_profile", "log_scale", "opening_logits")


class Encoders:
    """Both branches of one bundle, ready to run; safe to share between threads."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Create the onnxruntime sessions.

        Args:
            threads: intra-op threads per session, 0 for one per core.

        Raises:
            BundleError: a file is missing or altered, or the model knows other classes of openings or types of rooms.
        """
        self.manifest = bundle.manifest
        self.cohort = Cohort.of_bundle(bundle)
        self._layout = _session(bundle.read(LAYOUT_ONNX), threads)
        # A bundle of the layout branch alone answers layout queries only.
        image = bundle.read(IMAGE_ONNX) if IMAGE_ONNX in self.manifest.files else None
        self._image = None if image is None else _session(image, threads)
        inputs = [] if self._image is None else self._image.get_inputs()
        self._image_takes_height = any(node.name == "camera_height_m" for node in inputs)
        outputs = [] if self._image is None else self._image.get_outputs()
        self.predicts_profile = {node.name for node in outputs}.issuperset(_PROFILE_OUTPUTS)
        self.predicts_structure = {node.name for node in outputs}.issuperset(_STRUCTURE_OUTPUTS)
        if self.predicts_structure:
            _check_classes(self.manifest)
        self._head = _session(bundle.read(HEAD_ONNX), threads) if self.manifest.ring_sectors else None

    def layouts(
        self,
        profile_m: Float[np.ndarray, "b c"],
        camera_height_m: Float[np.ndarray, "b"],
        ceiling_height_m: Float[np.ndarray, "b"],
    ) -> Float[np.ndarray, "b d"]:
        """Latents of layouts given by their wall profiles and heights (m)."""
        inputs = {
            "profile_m": np.ascontiguousarray(profile_m, dtype=np.float32),
            "camera_height_m": np.asarray(camera_height_m, dtype=np.float32),
            "ceiling_height_m": np.asarray(ceiling_height_m, dtype=np.float32),
        }
        parts = []
        for first in range(0, len(profile_m), _LAYOUT_BATCH):
            batch = {name: value[first : first + _LAYOUT_BATCH] for name, value in inputs.items()}
            parts.append(_array(self._layout.run(["latent"], batch)[0]))
        return np.concatenate(parts) if parts else np.empty((0, self.manifest.latent_size), np.float32)

    def poses(
        self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"], camera_height_m: float
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b c"]]:
        """Render the layout of every pose of a plan; latents and wall profiles (m)."""
        profile_m = self.profiles(plan, poses, heading)
        heights = np.full(len(poses), camera_height_m)
        return self.layouts(profile_m, heights, plan.ceiling_heights_m[poses.room_index]), profile_m

    def rendered(self, plan: FloorPlan, poses: PoseSet) -> Layouts:
        """The layouts of poses of a grid, at heading 0, as wide as the networks take them."""
        return layouts_at(plan, poses, np.zeros(len(poses)), self.manifest.profile_columns)

    def profiles(self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b c"]:
        """Wall profiles (m) of poses of a plan, as wide as the layout encoder takes them."""
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
        """Encode a panorama of the bundle's input size.

        Args:
            camera_height: gives the picture its metric scale.
            heading: azimuth of the centre column (radians); None when unknown, then there is one hypothesis per
                sector of the ring.
            heading_tolerance: how far (radians) the true heading may be from `heading`; with it there are hypotheses
                for the sectors within that, and the heading is refined.
        """
        turned, rolled_away, frame_heading = (image, 0.0, 0.0) if heading is None else _undo_heading(image, heading)
        steps = self.manifest.ring_sectors or _HEADINGS_WITHOUT_RING
        every = np.arange(steps)
        most = min(math.ceil(heading_tolerance / TWO_PI * steps), (steps - 1) // 2)
        shifts = every if heading is None else np.arange(-most, most + 1)
        exact = heading is not None and heading_tolerance == 0.0
        if self._head is None:
            latents = self._turned_latents(turned, camera_height.height_m, shifts, steps)
            roll = rolled_away + shifts * (TWO_PI / steps)
            return Query(latents, roll, frame_heading, exact, camera_height)
        # One forward of the image, then roll its ring: rolling a ring is turning the camera.
        seen = self._seen(turned, camera_height.height_m)
        query = self._hypotheses(seen, shifts, rolled_away, camera_height)
        searched = None
        if heading is not None and self.predicts_profile:
            searched = self._hypotheses(seen, every, rolled_away, camera_height)
        return replace(query, frame_heading=frame_heading, heading_known=exact, searched=searched)

    def profile(
        self, image: UInt8[np.ndarray, "h w 3"], heading: float, camera_height_m: float
    ) -> tuple[Float[np.ndarray, "columns"], float]:
        """The wall profile (m) that the image encoder predicts from a panorama of the bundle's input size.

        Returns:
            the profile with the heading undone by whole pixels, and what is left over: the heading (radians) at which
            layouts are to be rendered to compare with it.

        Raises:
            BundleError: the bundle's image encoder predicts no wall profile.
        """
        query = self.query(image, heading, CameraHeight(camera_height_m, 0.0))
        if query.profile is None:
            raise BundleError(
                f"model '{self.manifest.name}' (architecture '{self.manifest.architecture}') predicts no wall profile: "
                f"{IMAGE_ONNX} has no output '{_PROFILE_OUTPUTS[0]}'"
            )
        return np.exp(query.profile.log_m[0]), query.frame_heading

    def _turned_latents(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, shifts: Int[np.ndarray, "k"], steps: int
    ) -> Float[np.ndarray, "k d"]:
        """Latents of a panorama turned to the right by each of some numbers of `steps`, for want of a ring."""
        width = image.shape[1]
        turned = (np.roll(image, int(shift) * width // steps, axis=1) for shift in shifts)
        return np.concatenate([self._run_image(view[None], camera_height_m, ["latent"])[0] for view in turned])

    def _hypotheses(
        self, seen: dict[str, np.ndarray], shifts: Int[np.ndarray, "k"], rolled_away: float, camera_height: CameraHeight
    ) -> Query:
        """A query with an unknown heading for a panorama that is turned to the right by some numbers of sectors."""
        assert self._head is not None
        steps = seen["ring"].shape[1]
        ring = np.ascontiguousarray(rolled(seen["ring"].T, shifts).transpose(0, 2, 1))
        latents = _array(self._head.run(["latent"], {"ring": ring})[0])
        told = self._told(seen, shifts, steps) if self.predicts_profile else {}
        return Query(latents, rolled_away + shifts * (TWO_PI / steps), 0.0, False, camera_height, **told)

    def _seen(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> dict[str, np.ndarray]:
        """The outputs of the image encoder for a panorama: its ring (c, s), and everything else by its name.

        All but the ring are averaged with what is predicted of the mirrored panorama: two views of one room err less
        than one. What has azimuth columns is mirrored back.
        """
        if not self.predicts_profile:
            return {"ring": self._run_image(image[None], camera_height_m, ["ring"])[0][0]}
        names = [*_PROFILE_OUTPUTS, *(_STRUCTURE_OUTPUTS if self.predicts_structure else [])]
        ring, *others = self._run_image(np.stack([image, image[:, ::-1]]), camera_height_m, ["ring", *names])
        averaged = {}
        for name, (value, mirrored) in zip(names, others, strict=True):
            averaged[name] = 0.5 * (value + (mirrored[::-1] if name in _BY_COLUMN else mirrored))
        return {"ring": ring[0], **averaged}

    def _told(self, seen: dict[str, np.ndarray], shifts: Int[np.ndarray, "k"], steps: int) -> dict[str, Any]:
        """What a query says of the layout, for panoramas turned to the right by each of some numbers of `steps`."""
        columns = shifts * (len(seen["log_profile"]) // steps)
        told: dict[str, Any] = {"profile": PredictedProfile.rolled(seen["log_profile"], seen["log_scale"], columns)}
        if self.predicts_structure:
            openings = rolled(_log_softmax(seen["opening_logits"]), columns)
            told["openings"] = PredictedOpenings(openings, np.array(self.manifest.opening_prior))
            told["ceiling"] = PredictedCeiling(float(seen["log_ceiling"]), float(seen["log_ceiling_scale"]))
            types = _log_softmax(seen["room_type_logits"])
            told["room_type"] = PredictedRoomType(types, np.array(self.manifest.room_type_prior))
        return told

    def _run_image(
        self, images: UInt8[np.ndarray, "b h w 3"], camera_height_m: float, outputs: list[str]
    ) -> list[np.ndarray]:
        """Some outputs of the image encoder for a batch."""
        if self._image is None:
            raise BundleError(f"model '{self.manifest.name}' has no image encoder; it answers layout queries only")
        inputs = {"image": np.ascontiguousarray(images)}
        if self._image_takes_height:
            inputs["camera_height_m"] = np.full(len(images), camera_height_m, dtype=np.float32)
        return [_array(value) for value in self._image.run(outputs, inputs)]


def _undo_heading(image: UInt8[np.ndarray, "h w 3"], heading: float) -> tuple[UInt8[np.ndarray, "h w 3"], float, float]:
    """The panorama rolled so that its centre looks almost along azimuth 0, the angle rolled away, and what is left."""
    pixel = TWO_PI / image.shape[1]
    shift = round(heading / pixel)
    # Column j of the result is column j - shift of the input, which looks `shift` pixels more to the left.
    turned = np.roll(image, shift, axis=1)
    return turned, shift * pixel, float(wrap_angle(heading - shift * pixel))


def _check_classes(manifest: Manifest) -> None:
    """Codes mean the same everywhere, so a model must have been trained with them."""
    for name, mine in (("opening_classes", OPENING_CLASSES), ("room_types", ROOM_TYPES)):
        theirs = getattr(manifest, name)
        if theirs != list(mine):
            raise BundleError(f"model '{manifest.name}' has the {name} {theirs}, this code knows {list(mine)}")
    for name, classes in (("opening_prior", OPENING_CLASSES), ("room_type_prior", ROOM_TYPES)):
        if len(getattr(manifest, name)) != len(classes):
            raise BundleError(f"model '{manifest.name}': {name} has not one value for each of {list(classes)}")


def _log_softmax(logits: Float[np.ndarray, "*n c"]) -> Float[np.ndarray, "*n c"]:
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def _array(value: object) -> np.ndarray:
    """What a network returned; onnxruntime also knows outputs that are no arrays."""
    assert isinstance(value, np.ndarray)
    return value


def _session(model: bytes, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Idle threads that spin would steal the cores from the LPO workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
