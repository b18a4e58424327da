"""Finding a run's queries and its model again, to draw them: what has changed since is refused."""

from __future__ import annotations

import numpy as np

from lalaloc_core.errors import BundleError, DatasetError
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.runs.factories import require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.render.sampling import pose_grid

_SAME_PLACE_M = 1e-3


def open_model(info: RunInfo) -> Encoders:
    """The run's own model.

    Raises:
        BundleError: it is gone, or another one stands in its place.
        InvalidInputError: the run had none.
    """
    bundle = require_bundle(info)
    if info.model is not None and info.model.get("sha256") not in (None, bundle.sha256):
        raise BundleError(f"'{info.bundle}' holds another model now, with SHA-256 {bundle.sha256}")
    return Encoders(bundle)


def find_camera(dataset: Dataset, prediction: Prediction) -> tuple[Scene, Camera]:
    """The scene and the camera of a query.

    Raises:
        DatasetError: they are gone, or the camera stands elsewhere now.
    """
    scene = dataset.load(prediction.scene, [])
    camera = next((one for one in scene.cameras if one.name == prediction.camera), None)
    if camera is None:
        raise DatasetError(f"no camera '{prediction.camera}' any more", scene=scene.name)
    moved_m = float(np.hypot(*(camera.position_m - [prediction.truth.x_m, prediction.truth.y_m])))
    if moved_m > _SAME_PLACE_M or camera.room_index != prediction.truth.room_index:
        raise DatasetError(
            f"camera '{camera.name}' stands {moved_m:.3f} m from where the run saw it: the data set has changed",
            scene=scene.name,
        )
    return scene, camera


def ask_again(info: RunInfo, scene: Scene, camera: Camera, appearance: Appearance) -> Question:
    """The query as the run asked it.

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
