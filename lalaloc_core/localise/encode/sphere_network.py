"""Image encoder of spheres on onnxruntime, by itself: all that a device needs to encode a panorama."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
import onnxruntime
from jaxtyping import UInt8

from lalaloc_core.bundle import IMAGE_ONNX, Bundle, Manifest
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import BundleError

PROFILE_OUTPUTS = ["log_profile", "log_scale"]
# Further output of networks that predict walls as mixtures; the others then have a value for each mode.
SHARE_OUTPUT = "log_share"
STRUCTURE_OUTPUTS = ["opening_logits", "log_ceiling", "log_ceiling_scale", "room_type_logits"]
# Outputs with a value for every azimuth column.
_BY_COLUMN = (*PROFILE_OUTPUTS, SHARE_OUTPUT, "opening_logits")


class SphereNetwork:
    """Image encoder of spheres of one bundle, ready to run; safe to share between threads.

    Attributes:
        session: the network; None for a bundle without an image encoder, which serves layout queries only.
        predicts_profile: whether it predicts a wall profile.
        predicts_structure: whether it predicts openings, ceiling and room type.
        helper: returns threads that encode the mirror image of a panorama while the caller's encodes the panorama, or
            None if no core is idle: one after the other, as a batch, they take less processor time.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Create the onnxruntime session, with `threads` intra-op threads, 0 for one per core.

        Raises:
            BundleError: the file is missing or altered, or the model has other opening classes or room types.
        """
        self.helper: Callable[[], Executor | None] = lambda: None
        self._manifest = bundle.manifest
        image = bundle.read(IMAGE_ONNX) if IMAGE_ONNX in self._manifest.files else None
        self.session = None if image is None else session(image, threads)
        inputs = [] if self.session is None else self.session.get_inputs()
        self._takes_height = any(node.name == "camera_height_m" for node in inputs)
        outputs = {node.name for node in ([] if self.session is None else self.session.get_outputs())}
        self.predicts_profile = outputs.issuperset(PROFILE_OUTPUTS)
        self.predicts_structure = outputs.issuperset(STRUCTURE_OUTPUTS)
        known = (*PROFILE_OUTPUTS, SHARE_OUTPUT, *STRUCTURE_OUTPUTS)
        self._predictions = [name for name in known if name in outputs]
        if self.predicts_structure:
            _check_classes(self._manifest)

    def outputs(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> dict[str, np.ndarray]:
        """Run the image encoder on a panorama; return its ring (c, s) and all other outputs by name.

        All but the ring are averages over the panorama and its mirror image, which are more accurate.

        Raises:
            BundleError: the bundle has no image encoder.
        """
        if not self.predicts_profile:
            return {"ring": self.run(image[None], camera_height_m, ["ring"])[0][0]}
        ring, *outputs = self._run_with_mirrored(image, camera_height_m, ["ring", *self._predictions])
        averaged = {}
        for name, (value, mirrored) in zip(self._predictions, outputs, strict=True):
            averaged[name] = 0.5 * (value + (mirrored[::-1] if name in _BY_COLUMN else mirrored))
        return {"ring": ring[0], **averaged}

    def _run_with_mirrored(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, outputs: list[str]
    ) -> list[np.ndarray]:
        """Run the image encoder on a batch of a panorama and its mirror image; return some outputs."""
        both, helper = np.stack([image, image[:, ::-1]]), self.helper()
        if helper is None:
            return self.run(both, camera_height_m, outputs)
        mirrored = helper.submit(self.run, both[1:], camera_height_m, outputs)
        own = self.run(both[:1], camera_height_m, outputs)
        return [np.concatenate(pair) for pair in zip(own, mirrored.result(), strict=True)]

    def run(self, images: UInt8[np.ndarray, "b h w 3"], camera_height_m: float, outputs: list[str]) -> list[np.ndarray]:
        """Run the image encoder on a batch; return some outputs.

        Raises:
            BundleError: the bundle has no image encoder.
        """
        if self.session is None:
            raise BundleError(
                f"model '{self._manifest.name}' has no image encoder ({IMAGE_ONNX}); it serves layout queries only"
            )
        inputs = {"image": np.ascontiguousarray(images)}
        if self._takes_height:
            inputs["camera_height_m"] = np.full(len(images), camera_height_m, dtype=np.float32)
        return [array(value) for value in self.session.run(outputs, inputs)]


def _check_classes(manifest: Manifest) -> None:
    """Check that the model was trained with the class codes of this version."""
    for name, expected in (("opening_classes", OPENING_CLASSES), ("room_types", ROOM_TYPES)):
        stated = getattr(manifest, name)
        if stated != list(expected):
            raise BundleError(f"model '{manifest.name}' has the {name} {stated}; this version needs {list(expected)}")
    for name, classes in (("opening_prior", OPENING_CLASSES), ("room_type_prior", ROOM_TYPES)):
        if len(getattr(manifest, name)) != len(classes):
            raise BundleError(f"model '{manifest.name}': {name} needs one value for each of {list(classes)}")


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
