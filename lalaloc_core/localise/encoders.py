"""The exported encoders on onnxruntime: layouts and panoramas to latents. Never imports torch."""

from __future__ import annotations

import numpy as np
import onnxruntime
from jaxtyping import Float, UInt8

from lalaloc_core.bundle import HEAD_ONNX, IMAGE_ONNX, LAYOUT_ONNX, Bundle
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.poses import Query
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.sampling import PoseSet

# Larger batches fall out of the cache and gain nothing.
_LAYOUT_BATCH = 256
# An architecture without a ring has to see the panorama turned, once per heading.
_HEADINGS_WITHOUT_RING = 32
_PROFILE_OUTPUT = "log_profile"


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
        self._head = _session(bundle.read(HEAD_ONNX), threads) if self.manifest.ring_sectors else None
        # A ring (1, c, s) where the architecture has one, else the latent (1, d).
        self._encoding = "ring" if self._head is not None else "latent"

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
    ) -> Float[np.ndarray, "b d"]:
        """Render the layout of every pose of a plan and embed it."""
        profile = wall_profile(
            poses.position_m.astype(np.float32),
            heading.astype(np.float32),
            plan.walls_m[poses.room_index].astype(np.float32),
            self.manifest.profile_columns,
        )
        return self.layouts(profile, np.full(len(poses), camera_height_m), plan.ceiling_heights_m[poses.room_index])

    def query(self, image: UInt8[np.ndarray, "h w 3"], heading: float | None, camera_height_m: float) -> Query:
        """Encode a panorama of the bundle's input size.

        Args:
            camera_height_m: gives the picture its metric scale.
            heading: azimuth of the centre column (radians); None when unknown, then there is one hypothesis per
                sector of the ring.
        """
        if heading is not None:
            return self._query_turned(image, heading, camera_height_m)
        if self._head is not None:
            return self._query_any_heading(image, camera_height_m)
        return self._query_by_turning(image, camera_height_m)

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
        if not any(node.name == _PROFILE_OUTPUT for node in self._require_image().get_outputs()):
            raise BundleError(
                f"model '{self.manifest.name}' (architecture '{self.manifest.architecture}') predicts no wall profile: "
                f"{IMAGE_ONNX} has no output '{_PROFILE_OUTPUT}'"
            )
        turned, _, frame_heading = _undo_heading(image, heading)
        return np.exp(self._run_image(turned, camera_height_m, _PROFILE_OUTPUT)[0]), frame_heading

    def _query_turned(self, image: UInt8[np.ndarray, "h w 3"], heading: float, camera_height_m: float) -> Query:
        """Undo a known heading; what whole pixels leave over stays as the frame's heading."""
        turned, rolled, frame_heading = _undo_heading(image, heading)
        encoded = self._run_image(turned, camera_height_m, self._encoding)
        latents = encoded if self._head is None else self._run_head(encoded)
        return Query(latents, np.array([rolled]), frame_heading, heading_known=True)

    def _query_any_heading(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> Query:
        """One forward of the image, then roll its ring: rolling a ring is turning the camera."""
        ring = self._run_image(image, camera_height_m, self._encoding)
        sectors = ring.shape[-1]
        shifts = np.arange(sectors)
        source = (np.arange(sectors)[None, :] - shifts[:, None]) % sectors
        rolled = np.ascontiguousarray(np.moveaxis(ring[0][:, source], 0, 1))
        return Query(self._run_head(rolled), shifts * (TWO_PI / sectors), 0.0, heading_known=False)

    def _query_by_turning(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> Query:
        width = image.shape[1]
        shifts = np.arange(_HEADINGS_WITHOUT_RING) * width // _HEADINGS_WITHOUT_RING
        turned = (np.roll(image, int(shift), axis=1) for shift in shifts)
        latents = np.concatenate([self._run_image(view, camera_height_m, self._encoding) for view in turned])
        return Query(latents, shifts * (TWO_PI / width), 0.0, heading_known=False)

    def _run_image(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, output: str) -> np.ndarray:
        """One output of the image encoder, as a batch of one."""
        inputs = {"image": np.ascontiguousarray(image[None])}
        if self._image_takes_height:
            inputs["camera_height_m"] = np.array([camera_height_m], dtype=np.float32)
        return _array(self._require_image().run([output], inputs)[0])

    def _require_image(self) -> onnxruntime.InferenceSession:
        if self._image is None:
            raise BundleError(f"model '{self.manifest.name}' has no image encoder; it answers layout queries only")
        return self._image

    def _run_head(self, ring: Float[np.ndarray, "b c s"]) -> Float[np.ndarray, "b d"]:
        assert self._head is not None
        return _array(self._head.run(["latent"], {"ring": ring})[0])


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
