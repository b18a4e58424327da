"""Streams of spheres: replay, camera height errors, photometric changes and deferred rendering."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.cli import main
from lalaloc_core.learn.synth.augmentation import jittered
from lalaloc_core.learn.training.batch_streams import ReplayBuffer, SphereBatches
from lalaloc_core.learn.training.batches import Batch, Rotation, load_batches
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS, TrainConfig
from lalaloc_core.learn.training.deferred import DeferredRenderer, rotate_images
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import build_layout_encoder, sphere_batches
from tests.strategies import seeds

TINY = PRESETS["tiny"]
CPU = torch.device("cpu")


def used(uses: int, limit: int, count: int) -> list[int]:
    replay: ReplayBuffer[int] = ReplayBuffer(uses, limit)
    rng = np.random.default_rng(0)
    drawn: list[int] = []
    for new in range(count):
        drawn += replay.add_and_sample(new, rng)
        assert len(replay) <= limit
    return drawn


class TestReplayBuffer:
    @given(uses=st.integers(1, 6), limit=st.integers(1, 40))
    def test_items_are_used_the_configured_number_of_times(self, uses: int, limit: int) -> None:
        counts = Counter(used(uses, limit, 300))
        assert max(counts.values()) <= uses
        assert set(counts) == set(range(300))
        unfinished = sum(count < uses for count in counts.values())
        assert unfinished <= (limit if uses > 1 else 0)

    def test_each_new_item_comes_with_repeats(self) -> None:
        replay: ReplayBuffer[int] = ReplayBuffer(4, 300)
        rng = np.random.default_rng(0)
        together = [len(replay.add_and_sample(new, rng)) for new in range(3000)]
        assert together[0] == 1
        assert np.mean(together[1000:]) == pytest.approx(4.0, rel=0.02)
        assert 250 < len(replay) <= 300

    def test_uses_of_an_item_are_far_apart(self) -> None:
        last: dict[int, int] = {}
        gaps: dict[int, list[int]] = defaultdict(list)
        for place, thing in enumerate(used(4, 400, 4000)):
            if thing in last:
                gaps[thing].append(place - last[thing])
            last[thing] = place
        assert np.median([gap for found in gaps.values() for gap in found]) > 200


def batches(**image: Any) -> list[Batch]:
    config = TINY.with_settings({f"image.{name}": value for name, value in image.items()})
    return list(itertools.islice(load_batches(SphereBatches(config, GeneratedSource(config)), 0), 6))


def colours(found: list[Batch]) -> Counter[tuple[int, ...]]:
    """Count spheres by the sorted pixels of a row, which rotation and mirroring preserve."""
    rows = torch.cat([batch["image"] for batch in found])[:, 16, :, 0]
    return Counter(tuple(row.tolist()) for row in rows.sort(dim=1).values)


class TestStream:
    def test_repeated_spheres_are_rotated_with_their_layouts(self) -> None:
        found = batches(uses_per_sphere=3, replay_spheres=6)
        counts = colours(found)
        assert 2 <= max(counts.values()) <= 3
        most = max(counts, key=lambda key: counts[key])
        images, profiles = (torch.cat([batch[key] for batch in found]) for key in ("image", "profile_m"))
        same = [k for k, row in enumerate(images[:, 16, :, 0]) if tuple(row.sort().values.tolist()) == most]
        first, second = images[same[0]], images[same[1]]
        fitting = [
            (shift, flip)
            for shift in range(first.shape[1])
            for flip in (False, True)
            if torch.equal((first.flip(1) if flip else first).roll(shift, dims=1), second)
        ]
        assert len(fitting) == 1
        shift, flip = fitting[0]
        profile = profiles[same[0]].flip(0) if flip else profiles[same[0]]
        # Profiles of `tiny` have half as many columns as pictures, so the error is at most half a column.
        rolled = [profile.roll(k) for k in (shift // 2, -(-shift // 2))]
        assert (sum(rolled) / 2 - profiles[same[1]]).abs().median() < 0.05

    @pytest.mark.slow
    def test_seed_determines_the_stream(self) -> None:
        first, again = (batches(uses_per_sphere=3, replay_spheres=6) for _ in range(2))
        assert all(torch.equal(a[key], b[key]) for a, b in zip(first, again, strict=True) for key in a)

    @pytest.mark.slow
    def test_resumed_stage_uses_new_homes(self) -> None:
        config = TINY.with_settings({"image.uses_per_sphere": 3, "image.replay_spheres": 6})
        stage = ImageStage(config, GeneratedSource(config), build_layout_encoder(config))
        seen = colours(list(itertools.islice(stage.batches(0, 0), 6)))
        resumed = colours(list(itertools.islice(stage.batches(6, 0), 6)))
        assert not set(seen) & set(resumed)

    @pytest.mark.slow
    def test_camera_height_error_has_the_configured_spread(self) -> None:
        exact, off = batches(), batches(camera_height_error_m=0.05)
        # The error is drawn after the rotation, so only the first picture of a home is the same.
        assert torch.equal(exact[0]["image"][0], off[0]["image"][0])
        assert torch.equal(exact[0]["profile_m"][0], off[0]["profile_m"][0])
        assert exact[0]["camera_height_m"][0] != off[0]["camera_height_m"][0]
        true, given_m = (torch.cat([batch["camera_height_m"] for batch in found]) for found in (exact, off))
        error = given_m - true
        assert 0.025 < error.std() < 0.1
        assert error.abs().max() <= 0.15 + 1e-6


class TestPhotometric:
    @given(seed=seeds())
    def test_jitter_keeps_range_and_content(self, seed: int) -> None:
        image = torch.randint(0, 256, (4, 8, 16, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))
        shown = jittered(image, 1.0, torch.Generator().manual_seed(seed))
        again = jittered(image, 1.0, torch.Generator().manual_seed(seed))
        assert torch.equal(shown, again)
        assert shown.min() >= 0.0
        assert shown.max() <= 255.0
        for before, after in zip(image.float(), shown, strict=True):
            assert torch.corrcoef(torch.stack([before.flatten(), after.flatten()]))[0, 1] > 0.9

    def test_jitter_strength_and_variety(self) -> None:
        image = torch.full((3, 4, 8, 3), 100, dtype=torch.uint8)
        generator = torch.Generator().manual_seed(0)
        torch.testing.assert_close(jittered(image, 0.0, generator), image.float())
        brightness = jittered(image, 1.0, generator).mean(dim=(1, 2, 3))
        assert len({round(float(value), 1) for value in brightness}) == 3


def config_of(uses: int) -> TrainConfig:
    return TINY.with_settings(
        {"image.batch": 6, "image.shots_per_home": 2, "image.uses_per_sphere": uses, "image.replay_spheres": 6}
    )


def deferrable_batches(
    uses: int, *, deferred: bool, neighbours: bool = False, workers: int = 0, textures: Path | None = None
) -> list[Batch]:
    source = GeneratedSource(config_of(uses), textures, deferred)
    found = sphere_batches(source.config, source, neighbours=neighbours, first_step=1, workers=workers, device=CPU)
    return list(itertools.islice(found, 6))


@pytest.mark.parametrize(("uses", "neighbours", "workers"), [(1, False, 0), (3, False, 1), (3, True, 0)])
@pytest.mark.slow
def test_deferred_batches_equal_rendered_ones(uses: int, neighbours: bool, workers: int) -> None:
    rendered = deferrable_batches(uses, deferred=False, neighbours=neighbours, workers=workers)
    deferred = deferrable_batches(uses, deferred=True, neighbours=neighbours, workers=workers)
    for a, b in zip(rendered, deferred, strict=True):
        assert a.keys() == b.keys()
        for key in a.keys() - {"image"}:
            assert torch.equal(a[key], b[key])
        # Batch sizes affect rounding.
        assert (a["image"].int() - b["image"].int()).abs().max() <= 1


@pytest.mark.slow
def test_scenes_are_rendered_once_and_evicted() -> None:
    config = config_of(3)
    source = GeneratedSource(config, deferred=True)
    renderer, shown, seen = DeferredRenderer(source.renderer(CPU, *config.image_size)), set(), 0
    deferred = list(itertools.islice(load_batches(SphereBatches(source.config, source), 0), 40))
    for batch, _ in zip(deferred, renderer.render_batches(deferred), strict=True):
        assert not shown & batch.scenes.keys()
        shown |= batch.scenes.keys()
        seen += len(batch.number)
        # Scenes waiting for their next use, and scenes of the unfinished next batch.
        assert len(renderer) <= source.config.image.replay_spheres + source.config.image.batch
    assert len(shown) < seen / 2


@given(shift=st.integers(-40, 40), mirrored=st.booleans())
def test_batches_rotate_like_single_pictures(shift: int, mirrored: bool) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 3, 16, 3), dtype=np.uint8)
    found = rotate_images(torch.from_numpy(images), torch.tensor([shift, 1]), torch.tensor([mirrored, True]))
    expected = [
        Rotation(shift=shift, heading=0.0, mirrored=mirrored).picture(images[0]),
        Rotation(shift=1, heading=0.0, mirrored=True).picture(images[1]),
    ]
    assert np.array_equal(found.numpy(), np.stack(expected))


@pytest.mark.slow
def test_training_does_not_depend_on_the_rendering_place(tmp_path: Path) -> None:
    common = ["--preset", "tiny", "--workers", "0", "--steps", "3", "--validation-homes", "1"]
    weights = []
    for place in ("workers", "device"):
        out = tmp_path / place
        assert main(["lab", "train", "layout", "--out", str(out), *common]) == 0
        assert main(["lab", "train", "image", "--out", str(out), *common, "--render", place, "--device", "cpu"]) == 0
        weights.append(Checkpoint.load(out / "image.pt").inference_weights["image_encoder"])
    for name, value in weights[0].items():
        assert torch.allclose(value.float(), weights[1][name].float(), atol=1e-3), name
