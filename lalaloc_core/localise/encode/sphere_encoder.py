"""Exported image encoder of spheres on onnxruntime: the network's outputs, and queries made of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from functools import partial

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.bundle import HEAD_ONNX, IMAGE_ONNX, Bundle, Manifest
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI, wrap_angle
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
from lalaloc_core.localise.query import CameraHeight, Query, rolled

# Outputs with a value for every azimuth column.
_BY_COLUMN = (*PROFILE_OUTPUTS, SHARE_OUTPUT, "opening_logits")
# Headings at which an architecture without a ring encodes the sphere, one pass each.
_HEADINGS_WITHOUT_RING = 32


class SphereEncoder:
    """Image encoder of spheres of one bundle, ready to run; safe to share between threads.

    Attributes:
        session: the network; None for a bundle without an image encoder, which serves layout queries only.
        predicts_profile: whether it predicts a wall profile.
        predicts_structure: whether it predicts openings, ceiling and room type.
        helper: returns threads that encode the mirror image of a sphere while the caller's encodes the sphere, or
            None if no core is idle.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0, outputs_only: bool = False) -> None:
        """Create the sessions; with `outputs_only` there are no queries, and no other file is read than the network."""
        self.helper: Callable[[], Executor | None] = lambda: None
        self._manifest = bundle.manifest
        image = bundle.read(IMAGE_ONNX) if IMAGE_ONNX in self._manifest.files else None
        self.session = None if image is None else open_session(image, threads)
        has_head = self._manifest.ring_sectors and not outputs_only
        self._head = open_session(bundle.read(HEAD_ONNX), threads) if has_head else None
        inputs = [] if self.session is None else self.session.get_inputs()
        self._takes_height = any(node.name == "camera_height_m" for node in inputs)
        outputs = {node.name for node in ([] if self.session is None else self.session.get_outputs())}
        self.predicts_profile = outputs.issuperset(PROFILE_OUTPUTS)
        self.predicts_structure = outputs.issuperset(STRUCTURE_OUTPUTS)
        known = (*PROFILE_OUTPUTS, SHARE_OUTPUT, *STRUCTURE_OUTPUTS)
        self._predictions = [name for name in known if name in outputs]
        if self.predicts_structure:
            _check_classes(self._manifest)

    def query(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
    ) -> Query:
        """Return the query of a sphere of the bundle's input size.

        The sphere is first rolled to undo the heading, if it is known. Each hypothesis then assumes a rotation from
        there by a number of sectors, of which a full turn has `ring_sectors`. The camera height gives the picture its
        metric scale. Without `heading`, the azimuth of the centre column (radians), there is one hypothesis per sector;
        if `heading_tolerance` (radians) is not 0, there are hypotheses for the sectors within it, and the heading is
        refined.
        """
        frame, roll, rest = (image, 0.0, None) if heading is None else _undo_heading(image, heading)
        if self._head is not None:
            # Rolling the ring rotates the camera, so the image is encoded once for all hypotheses.
            outputs = self.outputs(frame, camera_height.height_m)
            return self.query_of_outputs(
                outputs, heading, camera_height, heading_tolerance=heading_tolerance, roll=roll, rest=rest
            )
        count, width = _HEADINGS_WITHOUT_RING, image.shape[1]

        def hypotheses(shifts: Int[np.ndarray, "k"]) -> Query:
            frames = (np.roll(frame, int(shift) * width // count, axis=1) for shift in shifts)
            latents = [self.run(turned[None], camera_height.height_m, ["latent"])[0] for turned in frames]
            return Query(np.concatenate(latents), roll + shifts * (TWO_PI / count), 0.0, False, camera_height)

        return query_of_hypotheses(hypotheses, count, heading, heading_tolerance, rest)

    def query_of_outputs(
        self,
        outputs: Mapping[str, np.ndarray],
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
        roll: float = 0.0,
        rest: float | None = None,
    ) -> Query:
        """Return the query of a sphere by the outputs of the network, which are for the given camera height.

        The ring and the predictions are rolled to the right for each hypothesis. `roll` is the angle (radians) that the
        picture was rolled by, which left a `rest` of its heading; without, a heading is undone by whole sectors instead
        of pixels. The other arguments are as for `query`.
        """
        head, sectors = self._head, self._manifest.ring_sectors
        assert head is not None

        def hypotheses(shifts: Int[np.ndarray, "k"]) -> Query:
            ring = np.ascontiguousarray(rolled(outputs["ring"].T, shifts).transpose(0, 2, 1))
            latents = as_array(head.run(["latent"], {"ring": ring})[0])
            predictions = {}
            if self.predicts_profile:
                columns = shifts * (len(outputs["log_profile"]) // sectors)
                predictions = turned_predictions(outputs, columns, self._manifest)
            return Query(latents, roll + shifts * (TWO_PI / sectors), 0.0, False, camera_height, **predictions)

        return query_of_hypotheses(hypotheses, sectors, heading, heading_tolerance, rest)

    def profile(
        self, image: UInt8[np.ndarray, "h w 3"], heading: float, camera_height_m: float
    ) -> tuple[Float[np.ndarray, "columns"], float]:
        """Predict the wall profile (m) of a sphere of the bundle's input size.

        Returns:
            The profile with the heading undone by whole pixels, and the rest: the heading (radians) of the layouts to
            compare it with.
        """
        query = self.query(image, heading, CameraHeight(camera_height_m, 0.0))
        if query.profile is None:
            raise BundleError(
                f"model '{self._manifest.name}' (architecture '{self._manifest.architecture}') predicts no wall "
                f"profile: {IMAGE_ONNX} has no output '{PROFILE_OUTPUTS[0]}'"
            )
        return np.exp(query.profile.log_m[0]), query.frame_heading

    def outputs(self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float) -> dict[str, np.ndarray]:
        """Run the network on a sphere; return its ring (c, s) and all other outputs by name.

        All but the ring are averages over the sphere and its mirror image, which are more accurate.
        """
        if not self.predicts_profile:
            return {"ring": self.run(image[None], camera_height_m, ["ring"])[0][0]}
        ring, *outputs = self._run_with_mirrored(image, camera_height_m, ["ring", *self._predictions])
        averaged = {}
        for name, (value, mirrored) in zip(self._predictions, outputs, strict=True):
            averaged[name] = 0.5 * (value + (mirrored[::-1] if name in _BY_COLUMN else mirrored))
        return {"ring": ring[0], **averaged}

    def run(self, images: UInt8[np.ndarray, "b h w 3"], camera_height_m: float, outputs: list[str]) -> list[np.ndarray]:
        """Run the network on a batch; return some outputs.

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
        return [as_array(value) for value in self.session.run(outputs, inputs)]

    def _run_with_mirrored(
        self, image: UInt8[np.ndarray, "h w 3"], camera_height_m: float, outputs: list[str]
    ) -> list[np.ndarray]:
        """Run the network on a sphere and its mirror image, which takes less time than a batch; return some outputs."""
        run_mirrored, helper = partial(self.run, image[None, :, ::-1], camera_height_m, outputs), self.helper()
        mirrored = None if helper is None else helper.submit(run_mirrored)
        own = self.run(image[None], camera_height_m, outputs)
        other = run_mirrored() if mirrored is None else mirrored.result()
        return [np.concatenate(pair) for pair in zip(own, other, strict=True)]


def _undo_heading(image: UInt8[np.ndarray, "h w 3"], heading: float) -> tuple[UInt8[np.ndarray, "h w 3"], float, float]:
    """Roll a sphere by whole pixels so that its centre looks (almost) along azimuth 0."""
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
