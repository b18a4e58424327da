"""Queries from photographs of any projection: full spheres by one network, all others by another."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lalaloc_core.bundle import Bundle, Manifest
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.localise.encode.encoders import Encoders
from lalaloc_core.localise.encode.features import at_height
from lalaloc_core.localise.encode.view_encoder import VIEW_OUTPUTS, LevelPatch, OnnxViewEncoder
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.photograph import PatchSize, Photograph


class PhotographEncoder:
    """Networks of one bundle for photographs; safe to share between threads.

    Attributes:
        networks: encoders of layouts and spheres, which searches need as well.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Load the networks.

        `threads` is the number of intra-op threads per session, 0 for one per core.

        Raises:
            BundleError: see `Encoders` and `OnnxViewEncoder`.
        """
        self.networks = Encoders(bundle, threads=threads)
        self._views = None if bundle.manifest.view is None else OnnxViewEncoder(bundle, threads=threads)

    def query(
        self,
        view: Photograph,
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
        others: Sequence[tuple[Photograph, float]] = (),
    ) -> Query:
        """Return the query of a photograph.

        Args:
            view: the decoded photograph, its sphere or patches of the sizes of `sphere_size` and `patch_size`.
            heading: azimuth of its centre (radians); None if unknown.
            camera_height: as in `Encoders.query`.
            heading_tolerance: as in `Encoders.query`.
            others: further photographs from the same place, none of them a sphere, each with its heading minus that of
                `view` (radians); all of them encoded if `view` is.

        Raises:
            InvalidPhotographError: the photograph is no sphere, and the bundle has no encoder of views.
        """
        if view.is_sphere:
            assert not others, "a sphere shows all that others could add"
            if view.encoded is not None:
                outputs = at_height(view.encoded, camera_height.height_m)
                return self.networks.query_of_outputs(
                    outputs, heading, camera_height, heading_tolerance=heading_tolerance
                )
            assert view.panorama is not None
            return self.networks.query(
                view.panorama.pixels, heading, camera_height, heading_tolerance=heading_tolerance
            )
        self.check(view)
        assert self._views is not None
        views = [(view, 0.0), *others]
        if view.encoded is not None:
            parts = [at_height(other.encoded, camera_height.height_m) for other, _ in views if other.encoded]
            outputs = {name: np.concatenate([part[name] for part in parts]) for name in VIEW_OUTPUTS}
            placed = [
                (azimuth + turn, other.tilt_sd(azimuth))
                for other, turn in views
                if other.encoded
                for azimuth in other.encoded.azimuths
            ]
            return self._views.query_of_outputs(
                outputs, placed, heading, camera_height, heading_tolerance=heading_tolerance
            )
        patches = [
            LevelPatch(patch.rgba, patch.azimuth_rad + turn, other.tilt_sd(patch.azimuth_rad))
            for other, turn in views
            for patch in other.patches
        ]
        return self._views.query(patches, heading, camera_height, heading_tolerance=heading_tolerance)

    def check(self, view: Photograph) -> None:
        """Refuse a photograph that the model cannot encode.

        Raises:
            InvalidPhotographError: the photograph is no sphere, and the bundle has no encoder of views.
        """
        manifest = self.networks.manifest
        if not view.is_sphere and manifest.view is None:
            raise InvalidPhotographError(
                f"the photograph is {view.projection}, and model '{manifest.name}' reads full 360° spheres only; send "
                "an equirectangular picture, twice as wide as high, or use a model with an encoder of views"
            )

    def warm_up(self) -> None:
        """Run each network once, because the first run allocates memory."""
        manifest, height = self.networks.manifest, CameraHeight(1.5)
        image = np.zeros((*sphere_size(manifest), 3), np.uint8)
        self.networks.query(image, None, height)
        self.networks.layouts(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
        if self._views is not None:
            size = patch_size(manifest)
            self._views.query([LevelPatch(np.zeros((size.height, size.width, 4), np.uint8), 0.0)], None, height)


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
