"""Exported layout encoder on onnxruntime: layouts of poses and their latents, which searches compare with queries."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import LAYOUT_ONNX, Bundle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.exported_network import as_array, open_session
from lalaloc_core.localise.match import Cohort, Layouts, PoseGrid, layouts_at
from lalaloc_core.render.sampling import PoseSet, pose_grid
from lalaloc_core.render.sweep import profiles_at

# Larger batches do not fit the cache, and are no faster.
_BATCH = 256


class LayoutEncoder:
    """Layout encoder of one bundle, and what else searches need of it; safe to share between threads.

    Attributes:
        cohort: poses of other homes; None if the bundle has none.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        self.manifest = bundle.manifest
        self.cohort = Cohort.of_bundle(bundle)
        self._session = open_session(bundle.read(LAYOUT_ONNX), threads)

    def latents(
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
        for first in range(0, len(profile_m), _BATCH):
            batch = {name: value[first : first + _BATCH] for name, value in inputs.items()}
            parts.append(as_array(self._session.run(["latent"], batch)[0]))
        return np.concatenate(parts) if parts else np.empty((0, self.manifest.latent_size), np.float32)

    def poses(
        self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"], camera_height_m: float
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b c"]]:
        """Render and encode the layout of every pose of a plan; return latents and wall profiles (m)."""
        profile_m = self.profiles(plan, poses, heading)
        heights = np.full(len(poses), camera_height_m)
        return self.latents(profile_m, heights, plan.ceiling_heights_m[poses.room_index]), profile_m

    def rendered(self, plan: FloorPlan, poses: PoseSet) -> Layouts:
        """Render the layouts of grid poses at heading 0, with the networks' number of columns."""
        return layouts_at(plan, poses, np.zeros(len(poses)), self.manifest.profile_columns)

    def profiles(self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b c"]:
        """Render wall profiles (m) of poses of a plan, with the layout encoder's number of columns."""
        columns = self.manifest.profile_columns
        return profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)


def build_grid(
    plan: FloorPlan, encoder: LayoutEncoder, *, step_m: float, camera_height_m: float, latents: bool = True
) -> PoseGrid:
    """Return the plan's pose grid with every layout rendered and, with `latents`, encoded, which is slow."""
    poses = pose_grid(plan, step_m)
    if not latents:
        return PoseGrid.without_latents(poses, encoder.rendered(plan, poses), step_m, camera_height_m)
    embedded, profile_m = encoder.poses(plan, poses, np.zeros(len(poses)), camera_height_m)
    return PoseGrid(poses, embedded, profile_m, step_m, camera_height_m)
