"""Data set and model of a finished run, reopened to draw its queries; changed data is refused."""

from __future__ import annotations

import numpy as np

from lalaloc_core.errors import BundleError, DatasetError
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.runs.factories import build_dataset, choose_appearance, require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.learn.data.dataset import Camera, DatasetPhotograph, Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.render.sampling import pose_grid

_SAME_PLACE_M = 1e-3


class ReopenedRun:
    """Data set and model of a run."""

    def __init__(self, info: RunInfo) -> None:
        self.info = info
        self._dataset = build_dataset(info)
        self._appearance = choose_appearance(self._dataset, info.furniture, info.lighting)

    def open_model(self) -> PhotographEncoder:
        """Return the model.

        Raises:
            BundleError: the model is missing or another one.
            InvalidInputError: the run has no model.
        """
        bundle, model = require_bundle(self.info), self.info.model
        if model is not None and model.get("sha256") not in (None, bundle.sha256):
            raise BundleError(
                f"'{self.info.bundle}' holds another model than the run used: its SHA-256 is {bundle.sha256}"
            )
        return PhotographEncoder(bundle)

    def find_camera(self, prediction: Prediction) -> tuple[Scene, Camera]:
        """Return the scene and the camera of a query."""
        scene, truth = self._dataset.load(prediction.scene, []), prediction.truth
        camera = next((item for item in scene.cameras if item.name == prediction.camera), None)
        if camera is None:
            raise DatasetError(f"camera '{prediction.camera}' is missing: the data set has changed", scene=scene.name)
        moved_m = float(np.hypot(*(camera.position_m - truth.position_m)))
        if moved_m > _SAME_PLACE_M or camera.room_index != truth.room_index:
            raise DatasetError(
                f"camera '{camera.name}' is {moved_m:.3f} m from its position in the run: the data set has changed",
                scene=scene.name,
            )
        return scene, camera

    def photograph(self, scene: Scene, camera: Camera) -> DatasetPhotograph:
        """Return the photograph of a camera.

        Raises:
            DatasetError: there is no such photograph.
        """
        return scene.photograph(camera, self._appearance)

    def question(self, scene: Scene, camera: Camera) -> Question:
        """Return the query of a camera.

        Raises:
            DatasetError: there is no such photograph.
        """
        info = self.info
        return Question(
            plan=scene.plan,
            grid=pose_grid(scene.plan, info.grid_step_m),
            grid_step_m=info.grid_step_m,
            camera=camera,
            kind=info.kind,
            photograph=self.photograph(scene, camera) if info.kind == "photograph" else None,
            heading_known=info.heading_known,
        )
