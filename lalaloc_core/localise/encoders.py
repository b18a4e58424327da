"""The exported encoders on onnxruntime: layouts and panoramas to latents. Never imports torch."""

from __future__ import annotations

import math

import numpy as np
import onnxruntime
from jaxtyping import Float, Int, UInt8

from lalaloc_core.bundle import HEAD_ONNX, IMAGE_ONNX, LAYOUT_ONNX, Bundle
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.poses import PredictedProfile, Query
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.sampling import PoseSet

# Larger batches fall out of the cache and gain nothing.
_LAYOUT_BATCH = 256
# An architecture without a ring has to see the panorama turned, once per heading.
_HEADINGS_WITHOUT_RING = 32
_PROFILE_OUTPUTS = ["log_profile", "log_scale"]


class Encoders:
    """Both branches of one bundle, ready to run; safe to share between threads."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Create the onnxruntime sessions.

        Args:
            threads: intra-op threads per session, 0 for one per core.

        Raises:
            BundleError: a file is missing or altered.
        """
        self.manifest = bundle.manifest
        self._layout = _session(bundle.read(LAYOUT_ONNX), threads)
        # A bundle of the layout branch alone answers layout queries only.
        image = bundle.read(IMAGE_ONNX) if IMAGE_ONNX in self.manifest.files else None
        self._image = None if image is None else _session(image, threads)
        inputs = [] if self._image is None else self._image.get_inputs()
        self._image_takes_height = any(node.name == "camera_height_m" for node in inputs)
        outputs = [] if self._image is None else self._image.get_outputs()
        self.predicts_profile = {node.name for node in outputs}.issuperset(_PROFILE_OUTPUTS)
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

    def profiles(self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b c"]:
        """Wall profiles (m) of poses of a plan, as wide as the layout encoder takes them."""
        columns = self.manifest.profile_columns
        return profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)

    def query(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        heading: float | None,
        camera_height_m: float,
        *,
        heading_tolerance: float = 0.0,
    ) -> Query:
        """Encode a panorama of the bundle's input size.

        Args:
            camera_height_m: gives the picture its metric scale.
            heading: azimuth of the centre column (radians); None when unknown, then there is one hypothesis per
                sector of the ring.
            heading_tolerance: how far (radians) the true heading may be from `heading`; with it there are hypotheses
                for the sectors within that, and the heading is refined.
        """
        turned, rolled, frame_heading = (image, 0.0, 0.0) if heading is None else _undo_heading(image, heading)
        steps = self.manifest.ring_sectors or _HEADINGS_WITHOUT_RING
        if heading is None:
            shifts = np.arange(steps)
        else:
            most = min(math.ceil(heading_tolerance / TWO_PI * steps), (steps - 1) // 2)
            shifts = np.arange(-most, most + 1)
        exact = heading is not None and heading_tolerance == 0.0
        latents, profile = self._hypotheses(turned, camera_height_m, shifts, steps)
        return Query(latents, rolled + shifts * (TWO_PI / steps), frame_heading, heading_known=exact, profile=profile)

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
        query = self.query(image, heading, camera_height_m)
        if query.profile is None:
            raise BundleError(
                f"model '{self.manifest.name}' (architecture '{self.manifest.architecture}') predicts no wall profile: "
                f"{IMAGE_ONNX} has no output '{_PROFILE_OUTPUTS[0]}'"
            )
        return np.exp(query.profile.log_m[0]), query.frame_heading

    def _hypotheses(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, shifts: Int[np.ndarray, "k"], steps: int
    ) -> tuple[Float[np.ndarray, "k d"], PredictedProfile | None]:
        """Latents and wall profiles of a panorama turned to the right by each of some numbers of `steps`."""
        if self._head is None:
            width = image.shape[1]
            turned = (np.roll(image, int(shift) * width // steps, axis=1) for shift in shifts)
            latents = [self._run_image(view[None], camera_height_m, ["latent"])[0] for view in turned]
            return np.concatenate(latents), None
        # One forward of the image, then roll its ring: rolling a ring is turning the camera.
        ring, profile = self._ring(image, camera_height_m)
        source = (np.arange(steps)[None, :] - shifts[:, None]) % steps
        rolled = np.ascontiguousarray(np.moveaxis(ring[:, source], 0, 1))
        if profile is not None:
            log_m, log_scale = profile
            profile = PredictedProfile.rolled(log_m, log_scale, shifts * (len(log_m) // steps))
        return _array(self._head.run(["latent"], {"ring": rolled})[0]), profile

    def _ring(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float
    ) -> tuple[Float[np.ndarray, "c s"], tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]] | None]:
        """The ring of a panorama, and the log wall profile and log scale where the network predicts them.

        They are averaged with what it predicts of the mirrored panorama: two views of one room err less than one.
        """
        if not self.predicts_profile:
            return self._run_image(image[None], camera_height_m, ["ring"])[0][0], None
        views = np.stack([image, image[:, ::-1]])
        ring, log_m, log_scale = self._run_image(views, camera_height_m, ["ring", *_PROFILE_OUTPUTS])
        return ring[0], (0.5 * (log_m[0] + log_m[1, ::-1]), 0.5 * (log_scale[0] + log_scale[1, ::-1]))

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
