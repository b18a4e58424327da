"""The panoramas that encoders are compared on, rendered once and kept in a folder.

Training homes and validation homes of the generator, each panorama in two sizes with its layout. The validation
panoramas come with the layouts and latents of their grids, which are the same for all image encoders.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, RenderedPhotograph
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.localise.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.nets import load_layout_encoder
from lalaloc_core.nets.layout_encoder import RingLayoutEncoder
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.render.sampling import pose_grid, random_poses

COLUMNS = 128
FULL_HEIGHT, FULL_WIDTH = 256, 512
HOMES_PER_SHARD, SHARDS, VALIDATION_HOMES, SHOTS_PER_HOME = 100, 10, 60, 4
OTHER_POSES = 24
GRID_STEP_M = 0.5
PROCESSES = 2
BUNDLE = Path(__file__).parents[1] / "models" / "default"


def teacher_of(bundle: Bundle) -> RingLayoutEncoder:
    """The bundle's layout encoder, frozen; its head is shared with the image encoders."""
    manifest = bundle.manifest
    encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
    assert isinstance(encoder, RingLayoutEncoder)
    return encoder.eval().requires_grad_(False)


def render_shard(task: tuple[int, Path, Path]) -> None:
    """Training homes of one shard: pictures in both sizes, their layouts, and layouts elsewhere in the same plan."""
    shard, folder, textures = task
    torch.set_num_threads(1)
    source = GeneratedSource(PRESETS["ring"], textures)
    images, rows = [], []
    for visit in range(shard * HOMES_PER_SHARD, (shard + 1) * HOMES_PER_SHARD):
        for view in source.samples(visit, FULL_HEIGHT, FULL_WIDTH):
            others = random_poses(view.plan, OTHER_POSES, source.rng(visit))
            room = np.append(view.room_index, others.room_index)
            position = np.concatenate([np.asarray(view.position_m)[None], others.position_m])
            profile = profiles_at(view.plan, position, room, np.full(len(room), view.heading), COLUMNS, np.float32)
            images.append(view.image)
            rows.append((profile, view.camera_height_m, view.plan.ceiling_heights_m[room]))
    profile, camera, ceiling = (np.stack(part).astype(np.float32) for part in zip(*rows, strict=True))
    _save(folder / f"train-{shard:02d}", np.stack(images), profile_m=profile, camera_m=camera, ceiling_m=ceiling)


def render_validation(task: tuple[Path, Path]) -> None:
    """Validation panoramas, the layouts and latents of their grids, and how far off each grid pose is."""
    folder, textures = task
    torch.set_num_threads(1)
    teacher = teacher_of(Bundle.open(BUNDLE)).fused()
    scenes = GeneratedScenes(homes=VALIDATION_HOMES, shots_per_home=SHOTS_PER_HOME, furniture=None, textures=textures)
    images, rows, grids, latents = [], [], [], []
    for name in scenes.scenes("validation"):
        scene = scenes.load(name)
        grid = pose_grid(scene.plan, GRID_STEP_M)
        for camera in scene.cameras:
            room = np.append(camera.room_index, grid.room_index)
            position = np.concatenate([np.asarray(camera.position_m)[None], grid.position_m])
            profile = profiles_at(scene.plan, position, room, np.full(len(room), camera.heading), COLUMNS, np.float32)
            ceiling = scene.plan.ceiling_heights_m[room].astype(np.float32)
            height = torch.full((len(grid),), camera.camera_height_m)
            latents.append(teacher(torch.from_numpy(profile[1:]), height, torch.from_numpy(ceiling[1:])).numpy())
            grids.append((profile[1:], np.linalg.norm(position[1:] - position[0], axis=1)))
            rows.append((profile[:1], camera.camera_height_m, ceiling[:1], len(grid)))
            (photograph,) = camera.photographs.values()
            assert isinstance(photograph, RenderedPhotograph)
            images.append(photograph.image(FULL_HEIGHT, FULL_WIDTH))
    profile, camera_m, ceiling, count = (np.stack(part).astype(np.float32) for part in zip(*rows, strict=True))
    grid_profile, grid_error = (np.concatenate(part).astype(np.float32) for part in zip(*grids, strict=True))
    grid = {"grid_count": count.astype(int), "grid_profile_m": grid_profile, "grid_error_m": grid_error}
    facts = {"profile_m": profile, "camera_m": camera_m, "ceiling_m": ceiling}
    _save(folder / "validation", np.stack(images), **facts, **grid, grid_latent=np.concatenate(latents))


def _save(path: Path, images: np.ndarray, **facts: np.ndarray) -> None:
    n, h, w, _ = images.shape
    half = images.reshape(n, h // 2, 2, w // 2, 2, 3).mean(axis=(2, 4), dtype=np.float32).round().astype(np.uint8)
    np.save(f"{path}-{h}.npy", images)
    np.save(f"{path}-{h // 2}.npy", half)
    np.savez(f"{path}.npz", allow_pickle=False, **facts)


def render_pool(folder: Path, textures: Path) -> None:
    """Render what is missing of the pool."""
    folder.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        jobs = []
        if not (folder / "validation.npz").exists():
            jobs.append(pool.apply_async(render_validation, ((folder, textures),)))
        for shard in range(SHARDS):
            if not (folder / f"train-{shard:02d}.npz").exists():
                jobs.append(pool.apply_async(render_shard, ((shard, folder, textures),)))
        for job in jobs:
            job.get()


@dataclass(frozen=True)
class Pool:
    """The training panoramas of one height; pictures stay on disk."""

    shards: list[np.ndarray]
    facts: dict[str, np.ndarray]

    @classmethod
    def open(cls, folder: Path, height: int) -> Pool:
        names = sorted(path.stem for path in folder.glob("train-*.npz"))
        facts = [np.load(folder / f"{name}.npz") for name in names]
        return cls(
            [np.load(folder / f"{name}-{height}.npy", mmap_mode="r") for name in names],
            {key: np.concatenate([part[key] for part in facts]) for key in facts[0].files},
        )

    def batches(self, size: int, seed: int) -> Iterator[dict[str, Tensor]]:
        """Endless shuffled epochs; pictures and profiles are rolled and mirrored exactly."""
        rng = np.random.default_rng(seed)
        place = [(shard, row) for shard, images in enumerate(self.shards) for row in range(len(images))]
        pixels = self.shards[0].shape[2] // COLUMNS
        while True:
            order = rng.permutation(len(place))
            for rows in order[: len(order) // size * size].reshape(-1, size):
                images, profiles = [], []
                for row, roll, flip in zip(rows, rng.integers(COLUMNS, size=size), rng.random(size) < 0.5, strict=True):
                    shard, index = place[row]
                    step = -1 if flip else 1
                    images.append(np.roll(self.shards[shard][index], roll * pixels, axis=1)[:, ::step])
                    profiles.append(np.roll(self.facts["profile_m"][row], roll, axis=-1)[..., ::step])
                profile = torch.from_numpy(np.stack(profiles))
                camera = torch.from_numpy(self.facts["camera_m"][rows])
                ceiling = torch.from_numpy(self.facts["ceiling_m"][rows])
                yield {
                    "image": torch.from_numpy(np.stack(images)),
                    "profile_m": profile[:, 0],
                    "camera_height_m": camera,
                    "ceiling_height_m": ceiling[:, 0],
                    "other_profile_m": profile[:, 1:],
                    "other_ceiling_height_m": ceiling[:, 1:],
                }
