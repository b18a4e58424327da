"""Deferred rendering: the training device renders the same panoramas as the workers and evicts them."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.cli import main
from lalaloc_core.learn.training.batch_streams import PanoramaBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.deferred import DeferredRenderer, rotate_images
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.rotation import Rotation
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import panorama_batches

CPU = torch.device("cpu")


def config(uses: int) -> TrainConfig:
    return PRESETS["tiny"].with_settings(
        {
            "image.batch": 6,
            "image.shots_per_home": 2,
            "image.uses_per_panorama": uses,
            "image.replay_panoramas": 6,
        }
    )


def batches(
    uses: int, *, deferred: bool, neighbours: bool = False, workers: int = 0, textures: Path | None = None
) -> list[Batch]:
    source = GeneratedSource(config(uses), textures, deferred)
    found = panorama_batches(source.config, source, neighbours=neighbours, first_step=1, workers=workers, device=CPU)
    return list(itertools.islice(found, 6))


@pytest.mark.parametrize(("uses", "neighbours", "workers"), [(1, False, 0), (3, False, 1), (3, True, 0)])
def test_deferred_batches_equal_rendered_ones(uses: int, neighbours: bool, workers: int) -> None:
    rendered = batches(uses, deferred=False, neighbours=neighbours, workers=workers)
    deferred = batches(uses, deferred=True, neighbours=neighbours, workers=workers)
    for a, b in zip(rendered, deferred, strict=True):
        assert a.keys() == b.keys()
        for key in a.keys() - {"image"}:
            assert torch.equal(a[key], b[key])
        # Batch sizes affect rounding.
        assert (a["image"].int() - b["image"].int()).abs().max() <= 1


def test_scenes_are_rendered_once_and_evicted() -> None:
    source = GeneratedSource(config(3), deferred=True)
    renderer, shown, seen = DeferredRenderer(source.renderer(CPU)), set(), 0
    deferred = list(itertools.islice(load_batches(PanoramaBatches(source.config, source), 0), 40))
    for batch, _ in zip(deferred, renderer.render_batches(deferred), strict=True):
        assert not shown & batch.scenes.keys()
        shown |= batch.scenes.keys()
        seen += len(batch.number)
        # Scenes waiting for their next use, and scenes of the unfinished next batch.
        assert len(renderer) <= source.config.image.replay_panoramas + source.config.image.batch
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


def test_training_does_not_depend_on_the_rendering_place(tmp_path: Path) -> None:
    common = ["--preset", "tiny", "--workers", "0", "--steps", "3", "--validation-homes", "1"]
    weights = []
    for place in ("workers", "device"):
        out = tmp_path / place
        assert main(["train", "layout", "--out", str(out), *common]) == 0
        assert main(["train", "image", "--out", str(out), *common, "--render", place, "--device", "cpu"]) == 0
        weights.append(Checkpoint.load(out / "image.pt").inference_weights["image_encoder"])
    for name, value in weights[0].items():
        assert torch.allclose(value.float(), weights[1][name].float(), atol=1e-3), name


def test_render_option_needs_generated_homes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "image", "--out", str(tmp_path), "--data", "somewhere", "--render", "device"]) != 0
    assert "--render is for generated homes" in capsys.readouterr().err
