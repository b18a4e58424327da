"""Networks of a bundle; those for photographs are chosen here: full spheres by one, all others by another."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial

import numpy as np

from lalaloc_core.bundle import Bundle, Manifest
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.localise.encode.features import RING_HEIGHTS_M, at_height
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.encode.sphere_encoder import SphereEncoder
from lalaloc_core.localise.encode.view_encoder import (
    OBJECT_OUTPUTS,
    VIEW_OUTPUTS,
    ObjectEncoder,
    ViewEncoder,
    objects_of_views,
)
from lalaloc_core.localise.query import CameraHeight, Query, SeenObjects, WallDirection
from lalaloc_core.localise.query.query import Later
from lalaloc_core.photograph import Patch, PatchSize, Photograph, PhotographFeatures
from lalaloc_core.photograph.patches import joined_patches


class PhotographEncoder:
    """Networks of one bundle for photographs and for the layouts that they are compared with; safe to share."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        self.manifest = bundle.manifest
        self.layouts = LayoutEncoder(bundle, threads=threads)
        self.spheres = SphereEncoder(bundle, threads=threads)
        self._views = None if bundle.manifest.view is None else ViewEncoder(bundle, threads=threads)
        self._objects = None if bundle.manifest.objects is None else ObjectEncoder(bundle, threads=threads)

    @property
    def predicts_profile(self) -> bool:
        """True if spheres have a predicted wall profile; otherwise latents alone are compared."""
        return self.spheres.predicts_profile

    def query(
        self,
        photograph: Photograph,
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
        others: Sequence[tuple[Photograph, float]] = (),
    ) -> Query:
        """Return the query of a photograph; see `SphereEncoder.query` for heading, camera height and tolerance.

        `photograph` is decoded, its sphere or patches of the sizes of `sphere_size` and `patch_size`, or its features.
        `others` are further photographs from the same place, none of them a sphere, each with its heading minus that of
        `photograph` (radians); all of them are features if `photograph` is.

        Raises:
            InvalidPhotographError: the photograph is no sphere, and the bundle has no encoder of views.
        """
        height_m = camera_height.height_m
        if photograph.is_sphere:
            assert not others, "a sphere shows all that others could add"
            if photograph.features is None:
                assert photograph.sphere is not None
                return self.spheres.query(
                    photograph.sphere, heading, camera_height, heading_tolerance=heading_tolerance
                )
            outputs = at_height(photograph.features, height_m)
            return self.spheres.query_of_outputs(outputs, heading, camera_height, heading_tolerance=heading_tolerance)
        self.check(photograph)
        assert self._views is not None
        turned = [(photograph, 0.0), *others]
        views = [view for view, _ in turned]
        objects = self._objects_beside(views)
        if photograph.features is None:
            patches = self._patches(turned)
            outputs = self._views.outputs([patch.rgba for patch, _ in patches], height_m)
            placed = [(patch.azimuth_rad, tilt_sd) for patch, tilt_sd in patches]
        else:
            parts = [at_height(view.features, height_m) for view, _ in turned if view.features]
            outputs = {name: np.concatenate([part[name] for part in parts]) for name in VIEW_OUTPUTS}
            placed = [(angle + turn, view.tilt_sd(angle)) for view, turn in turned for angle in view.patch_azimuths]
        query = self._views.query_of_outputs(
            outputs, placed, heading, camera_height, heading_tolerance=heading_tolerance
        )
        directions = tuple(
            WallDirection(view.wall_direction.value + turn, view.wall_direction.sd)
            for view, turn in turned
            if view.wall_direction is not None
        )
        seen = self.seen_objects(turned, objects())
        if seen is not None and self._objects is not None:
            seen = replace(seen, lying=Later(partial(self._objects.lying, views)))
        several = {"objects": seen, "wall_directions": directions, "is_turn": bool(others)}
        later = query.searched
        searched = None if later is None else Later(lambda: replace(later.value, **several))
        return replace(query, **several, searched=searched)

    def with_features(self, photograph: Photograph) -> Photograph:
        """Return a decoded photograph with its features, as for albums: detected objects too, no ring of spheres.

        Raises:
            InvalidPhotographError: the model cannot encode the photograph.
        """
        if photograph.features is not None:
            return photograph
        self.check(photograph)
        if photograph.sphere is not None:
            outputs = self.spheres.outputs(photograph.sphere, 1.0)
            outputs["ring"] = np.zeros((len(RING_HEIGHTS_M), *outputs["ring"].shape), np.float32)
            return replace(photograph, features=PhotographFeatures(outputs))
        assert self._views is not None
        objects = self._objects_beside([photograph], detects=True)
        outputs = self._views.outputs([patch.rgba for patch in photograph.patches], 1.0) | objects()[0]
        warnings = (*photograph.warnings, *(() if self._objects is None else self._objects.lying([photograph])))
        features = PhotographFeatures(outputs, photograph.patch_azimuths)
        return replace(photograph, features=features, warnings=warnings)

    def _objects_beside(
        self, photographs: Sequence[Photograph], *, detects: bool = False
    ) -> Callable[[], list[dict[str, np.ndarray]]]:
        """Return a function that recognises the objects which an idle core, if any, has not begun; with all outputs."""
        helper = None if self._objects is None else self.spheres.helper()
        begun = [
            Future() if helper is None else helper.submit(self._object_outputs, photograph, detects=detects)
            for photograph in photographs
        ]

        def outputs() -> list[dict[str, np.ndarray]]:
            for number in reversed(range(len(begun))):
                if begun[number].cancel():
                    begun[number] = Future()
                    begun[number].set_result(self._object_outputs(photographs[number], detects=detects))
            return [future.result() for future in begun]

        return outputs

    def _object_outputs(self, photograph: Photograph, *, detects: bool = False) -> dict[str, np.ndarray]:
        if photograph.features is not None:
            return dict(photograph.features.outputs)
        return {} if self._objects is None else self._objects.outputs(photograph, detects=detects)

    def _patches(self, turned: Sequence[tuple[Photograph, float]]) -> list[tuple[Patch, float]]:
        """Return the patches of photographs of one spot, and the standard deviations (radians) of their tilt.

        Photographs once around are joined: the encoder reads a wall better with the room beside it in sight.
        """
        placed = [(patch, patch.azimuth_rad + turn) for view, turn in turned for patch in view.patches]
        joined = joined_patches(placed, patch_size(self.manifest)) if len(turned) > 1 else []
        if joined:
            return [(patch, _tilt_sd(turned, patch.azimuth_rad)) for patch in joined]
        tilts = [view.tilt_sd(patch.azimuth_rad) for view, _ in turned for patch in view.patches]
        return [
            (replace(patch, azimuth_rad=azimuth), tilt) for (patch, azimuth), tilt in zip(placed, tilts, strict=True)
        ]

    def seen_objects(
        self, turned: Sequence[tuple[Photograph, float]], outputs: Sequence[Mapping[str, np.ndarray]] = ()
    ) -> SeenObjects | None:
        """Return the objects in photographs of one spot; None if the model recognises none, or not all have some."""
        outputs = outputs or [self._object_outputs(view) for view, _ in turned]
        # Features of earlier versions have no objects.
        if self.manifest.objects is None or not all(each.keys() >= set(OBJECT_OUTPUTS) for each in outputs):
            return None
        views = [
            (each["object_probability"], each["object_azimuth"] + turn)
            for each, (_, turn) in zip(outputs, turned, strict=True)
        ]
        return objects_of_views(self.manifest.objects, views)

    def check(self, photograph: Photograph) -> None:
        """Refuse a photograph that the model cannot encode.

        Raises:
            InvalidPhotographError: the photograph is no sphere, and the bundle has no encoder of views.
        """
        if not photograph.is_sphere and self.manifest.view is None:
            raise InvalidPhotographError(
                f"the photograph is {photograph.projection}, and model '{self.manifest.name}' reads full 360° spheres "
                "only; send an equirectangular picture, twice as wide as high, or use a model with an encoder of views"
            )

    def use_helper(self, helper: Callable[[], Executor | None]) -> None:
        """Share the work of a query with a second thread whenever `helper` returns one."""
        self.spheres.helper = helper

    def warm_up(self) -> None:
        """Run each network once, because the first run allocates memory."""
        manifest, height = self.manifest, CameraHeight(1.5)
        self.spheres.query(np.zeros((*sphere_size(manifest), 3), np.uint8), None, height)
        self.layouts.latents(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
        if self._views is not None:
            size = patch_size(manifest)
            outputs = self._views.outputs([np.zeros((size.height, size.width, 4), np.uint8)], height.height_m)
            self._views.query_of_outputs(outputs, [(0.0, 0.0)], None, height)
        if self._objects is not None:
            self._objects.warm_up()


def _tilt_sd(turned: Sequence[tuple[Photograph, float]], azimuth: float) -> float:
    """Return the standard deviation (radians) of elevations along an azimuth by the photograph that shows it best."""
    view, turn = min(turned, key=lambda each: abs(float(wrap_angle(azimuth - each[1]))))
    return view.tilt_sd(azimuth - turn)


def sphere_size(manifest: Manifest) -> tuple[int, int]:
    """Return height and width (pixels) of spheres for a model."""
    return manifest.image_height, manifest.image_width


def patch_size(manifest: Manifest) -> PatchSize:
    """Return the size of patches for a model; the usual one for a model without an encoder of views."""
    view = manifest.view
    if view is None:
        return PatchSize()
    return PatchSize(
        height=view.image_height,
        width=view.image_width,
        hfov_deg=math.degrees(TWO_PI * view.sectors / manifest.ring_sectors),
        top_deg=view.top_deg,
        step_deg=360.0 / manifest.profile_columns,
    )
