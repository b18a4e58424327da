"""Sources of training scenes: visit number i uses one scene, the same in every run with the same seed.

`GeneratedSource` draws a new home for every visit; `SceneSource` visits a data set's training scenes in shuffled
epochs. Both are small enough to be sent to worker processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod
from jaxtyping import Float, Int

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene, collect_error, load_scenes
from lalaloc_core.learn.data.synthetic.generated import RendererCache
from lalaloc_core.learn.synth.homes.plans import TRAIN, home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer, Window
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import CEILING_CLEARANCE_M, Shot, sample_shots
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.deferred import DeferredScene
from lalaloc_core.render.sampling import PoseSet, TripletSampling, sample_neighbours, sample_triplets

# Minimum distance (m) of a camera below the ceiling of a neighbour's room.
_HEADROOM_M = 0.1
_MIN_CAMERA_M, _MAX_CAMERA_M = 1.0, 1.9
# Camera heights of spheres, including unusually low and high ones.
_CAMERA_HEIGHTS_M = (0.5, 2.2)
# Share of generated spheres on thresholds, beside walls, in corridors and closets.
_HARD_SHARE = 0.25
# Share of generated spheres at night.
_NIGHT_SHARE = 0.12
# Share of generated spheres with uneven ceilings, and with kitchens and closets as in real homes.
_FITTED_SHARE = 0.4
_SCENES_CACHED = 256
_PICTURE_BYTES_CACHED = 1 << 28
# Consecutive visits without a sample that indicate a fault of the generator.
_GENERATOR_PATIENCE = 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class Group:
    """Poses in the order anchor, positives, negatives, all at the anchor's camera height."""

    plan: FloorPlan
    position_m: Float[np.ndarray, "n 2"]
    room_index: Int[np.ndarray, "n"]
    camera_height_m: float


@dataclass(frozen=True, eq=False)
class SphereSample:
    """A sphere and its pose; `image` is (h, w, 3) RGB bytes, (h, w, 4) with walls, or a scene to be rendered later."""

    plan: FloorPlan
    camera: Camera | Shot
    image: np.ndarray | DeferredScene


@dataclass(eq=False)
class GeneratedSource:
    """Source of generated homes: a new one for every visit, with anchors and cameras anywhere on the floor.

    With `textures` None all materials are procedural. `deferred` spheres are scenes, to be rendered by `renderer` in
    another process. `window` is the part of the sphere that samples show, None for all of it.
    """

    config: TrainConfig
    textures: Path | None = None
    deferred: bool = False
    window: Window | None = None
    _renderers: RendererCache | None = field(default=None, init=False)
    # Maximum number of consecutive visits without a sample.
    patience = _GENERATOR_PATIENCE

    @property
    def data(self) -> dict[str, Any]:
        """Description for checkpoints and manifests."""
        return {"description": "homes generated while training"}

    @property
    def problems(self) -> list[DatasetError]:
        """Errors of skipped files since this list was last emptied; generated homes have none."""
        return []

    def rng(self, visit: int) -> np.random.Generator:
        """Return the random generator of a visit, for everything but the scene itself."""
        return np.random.default_rng([3, self.config.seed, visit])

    def groups(self, visit: int) -> list[Group]:
        """Return stage 1's anchors with their neighbours; empty if the scene cannot be used."""
        stage = self.config.layout
        home, rng = home_of(TRAIN, self.config.seed, visit)
        drawn = sample_triplets(home.plan, stage.anchors_per_home, stage.triplets, rng)
        if drawn is None:
            return []
        poses, rows = drawn
        groups = []
        for row in rows:
            lowest = float(home.plan.ceiling_heights_m[poses.room_index[row]].min())
            groups.append(
                Group(
                    plan=home.plan,
                    position_m=poses.position_m[row],
                    room_index=poses.room_index[row],
                    camera_height_m=float(rng.uniform(_MIN_CAMERA_M, min(_MAX_CAMERA_M, lowest - CEILING_CLEARANCE_M))),
                )
            )
        return groups

    def samples(self, visit: int, height: int, width: int) -> list[SphereSample]:
        """Return stage 2's spheres, `height` x `width`; empty if the scene cannot be used."""
        stage = self.config.image
        home, rng = home_of(TRAIN, self.config.seed, visit)
        shots = sample_shots(
            home,
            stage.shots_per_home,
            rng,
            by_room_share=stage.by_room_share,
            hard_share=_HARD_SHARE,
            unusual_heights_m=_CAMERA_HEIGHTS_M,
            night_share=_NIGHT_SHARE,
            fitted_share=_FITTED_SHARE,
        )
        # Created on first use, so that it is not sent to worker processes.
        self._renderers = self._renderers or self._renderers_on("cpu")
        scenes = [build_scene(shot, self._renderers.materials) for shot in shots]
        images: Sequence[np.ndarray | DeferredScene]
        if self.deferred:
            first = visit * stage.shots_per_home
            images = [DeferredScene(number=first + k, scene=scene) for k, scene in enumerate(scenes)]
        else:
            renderer = self._renderers.renderer(height, width, stage.supersample, self.window)
            images = list(renderer.render_scenes(scenes, walls=True).numpy())
        return [SphereSample(home.plan, shot, image) for shot, image in zip(shots, images, strict=True)]

    def renderer(self, device: torch.device, height: int, width: int) -> SphereRenderer:
        """Create the renderer of deferred spheres; its pixels are those of `samples`."""
        return self._renderers_on(device).renderer(height, width, self.config.image.supersample, self.window)

    def _renderers_on(self, device: torch.device | str) -> RendererCache:
        return RendererCache(MaterialLibrary.create(np.random.default_rng(self.config.seed), self.textures), device)


@dataclass(eq=False)
class SceneSource:
    """Source of a data set's training scenes in shuffled epochs; each visit draws some of a scene's cameras.

    Anchors of stage 1 are the poses of the spheres; stage 2 draws the appearance for each visit (paper, section 5).
    `skip_bad` skips files that cannot be used, and appends their errors to `problems`.
    """

    config: TrainConfig
    dataset: Dataset
    skip_bad: bool = False
    problems: list[DatasetError] = field(default_factory=list, init=False)
    deferred = False

    def __post_init__(self) -> None:
        self._names = tuple(self.dataset.scenes("train"))
        if not self._names:
            raise DatasetError(f"{self.dataset.description}: the data set has no training scenes")
        self._scenes: LRUCache[str, Scene | None] = LRUCache(_SCENES_CACHED)
        self._pictures: LRUCache[tuple[Any, ...], np.ndarray] = LRUCache(_PICTURE_BYTES_CACHED, attrgetter("nbytes"))
        self._orders: LRUCache[int, np.ndarray] = LRUCache(1)

    @property
    def data(self) -> dict[str, Any]:
        """Description for checkpoints and manifests."""
        return {"description": self.dataset.description, "scenes": len(self._names)}

    @property
    def patience(self) -> int:
        """Two epochs of visits."""
        return 2 * len(self._names)

    def rng(self, visit: int) -> np.random.Generator:
        """Return the random generator of a visit, for everything but the scene itself."""
        return np.random.default_rng([5, self.config.seed, visit])

    def groups(self, visit: int) -> list[Group]:
        """Return stage 1's anchors with their neighbours."""
        stage, rng = self.config.layout, np.random.default_rng([6, self.config.seed, visit])
        scene = self._scene(visit)
        groups: list[Group] = []
        if scene is not None:
            for index in rng.permutation(len(scene.cameras)):
                group = group_around(scene.cameras[index], scene.plan, stage.triplets, rng)
                groups += [group] if group is not None else []
                if len(groups) == stage.anchors_per_home:
                    break
        return groups

    def samples(self, visit: int, height: int, width: int) -> list[SphereSample]:
        """Return stage 2's spheres, `height` x `width`."""
        rng = np.random.default_rng([7, self.config.seed, visit])
        scene = self._scene(visit)
        if scene is None:
            return []
        samples = []
        for index in rng.permutation(len(scene.cameras))[: self.config.image.shots_per_home]:
            camera = scene.cameras[index]
            image = self._picture(scene, camera, rng, height, width)
            if image is not None:
                samples.append(SphereSample(scene.plan, camera, image))
        return samples

    def _scene(self, visit: int) -> Scene | None:
        epoch, place = divmod(visit, len(self._names))
        return self._load(self._names[self._shuffled(epoch)[place]])

    @cachedmethod(attrgetter("_orders"))
    def _shuffled(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([8, self.config.seed, epoch]).permutation(len(self._names))

    @cachedmethod(attrgetter("_scenes"))
    def _load(self, name: str) -> Scene | None:
        return next(load_scenes(self.dataset, [name], self.problems if self.skip_bad else None), None)

    def _picture(
        self, scene: Scene, camera: Camera, rng: np.random.Generator, height: int, width: int
    ) -> np.ndarray | None:
        looks = sorted(camera.photographs, key=str)
        if not looks:
            return None
        look = looks[rng.integers(len(looks))]
        with collect_error(self.problems if self.skip_bad else None):
            return self._read(scene, camera, look, height, width)
        return None

    @cachedmethod(attrgetter("_pictures"), key=lambda _, scene, camera, *how: (scene.name, camera.name, *how))
    def _read(self, scene: Scene, camera: Camera, look: Appearance, height: int, width: int) -> np.ndarray:
        return camera.photographs[look].image(height, width)


Source = GeneratedSource | SceneSource


def group_around(
    anchor: Camera | Shot, plan: FloorPlan, sampling: TripletSampling, rng: np.random.Generator
) -> Group | None:
    """Return a pose with sampled neighbours; None if the plan is too small for them."""
    pose = PoseSet(np.asarray(anchor.position_m)[None], np.array([anchor.room_index]))
    near = sample_neighbours(plan, pose, sampling, rng, anchor.camera_height_m + _HEADROOM_M)
    if near is None:
        return None
    return Group(
        plan=plan,
        position_m=np.concatenate([pose.position_m, near.position_m]),
        room_index=np.concatenate([pose.room_index, near.room_index]),
        camera_height_m=anchor.camera_height_m,
    )
