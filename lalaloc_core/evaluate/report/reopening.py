"""Data set and model of a finished run, reopened to draw its queries; changed data is refused."""

from __future__ import annotations

import numpy as np

from lalaloc_core.errors import BundleError, DatasetError
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.runs.factories import require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.render.sampling import pose_grid

_SAME_PLACE_M = 1e-3


def open_model(info: RunInfo) -> PhotographEncoder:
    """Return the model of a run.

    Raises:
        BundleError: the model is missing or another one.
        InvalidInputError: the run has no model.
    """
    bundle = require_bundle(info)
    if info.model is not None and info.model.get("sha256") not in (None, bundle.sha256):
        raise BundleError(f"'{info.bundle}' holds another model than the run used: its SHA-256 is {bundle.sha256}")
    return PhotographEncoder(bundle)


def find_camera(dataset: Dataset, prediction: Prediction) -> tuple[Scene, Camera]:
    """Return the scene and the camera of a query.

    Raises:
        DatasetError: the camera is missing or has another position.
    """
    scene = dataset.load(prediction.scene, [])
    camera = next((item for item in scene.cameras if item.name == prediction.camera), None)
    if camera is None:
        raise DatasetError(f"camera '{prediction.camera}' is missing: the data set has changed", scene=scene.name)
    moved_m = float(np.hypot(*(camera.position_m - [prediction.truth.x_m, prediction.truth.y_m])))
    if moved_m > _SAME_PLACE_M or camera.room_index != prediction.truth.room_index:
        raise DatasetError(
            f"camera '{camera.name}' is {moved_m:.3f} m from its position in the run: the data set has changed",
            scene=scene.name,
        )
    return scene, camera


def repeat_question(info: RunInfo, scene: Scene, camera: Camera, appearance: Appearance) -> Question:
    """Return the query of a camera in a run.

    Raises:
        DatasetError: there is no such photograph.
    """
    return Question(
        plan=scene.plan,
        grid=pose_grid(scene.plan, info.grid_step_m),
        grid_step_m=info.grid_step_m,
        camera=camera,
        kind=info.kind,
        photograph=scene.photograph(camera, appearance) if info.kind == "panorama" else None,
        heading_known=info.heading_known,
    )
