"""Replay of panoramas, camera height errors, photometric changes and single settings."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.synth.augmentation.photometric import jittered
from lalaloc_core.learn.training.batch_streams import PanoramaBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.replay_buffer import ReplayBuffer
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import build_layout_encoder
from tests.strategies import seeds

TINY = PRESETS["tiny"]


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
    return list(itertools.islice(load_batches(PanoramaBatches(config, GeneratedSource(config)), 0), 6))


def colours(found: list[Batch]) -> Counter[tuple[int, ...]]:
    """Count panoramas by the sorted pixels of a row, which rotation and mirroring preserve."""
    rows = torch.cat([batch["image"] for batch in found])[:, 16, :, 0]
    return Counter(tuple(row.tolist()) for row in rows.sort(dim=1).values)


class TestStream:
    def test_repeated_panoramas_are_rotated_with_their_layouts(self) -> None:
        found = batches(uses_per_panorama=3, replay_panoramas=6)
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

    def test_seed_determines_the_stream(self) -> None:
        first, again = (batches(uses_per_panorama=3, replay_panoramas=6) for _ in range(2))
        assert all(torch.equal(a[key], b[key]) for a, b in zip(first, again, strict=True) for key in a)

    def test_resumed_stage_uses_new_homes(self) -> None:
        config = TINY.with_settings({"image.uses_per_panorama": 3, "image.replay_panoramas": 6})
        stage = ImageStage(config, GeneratedSource(config), build_layout_encoder(config))
        seen = colours(list(itertools.islice(stage.batches(0, 0), 6)))
        resumed = colours(list(itertools.islice(stage.batches(6, 0), 6)))
        assert not set(seen) & set(resumed)

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


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("image.uses_per_panorama", 0, "uses_per_panorama is 0"),
        ("image.replay_panoramas", 0, "replay_panoramas is 0"),
        ("image.photometric", 1.5, "photometric is 1.5"),
        ("image.camera_height_error_m", -0.1, "camera_height_error_m is -0.1"),
        ("image.supersample", [2], "supersample"),
        ("image.supersample", [0, 2], "supersample"),
        ("image.optimiser.decay", 1.0, "decay is 1"),
        ("image.uses", 2, "no key 'uses'"),
        ("pictures.uses", 2, "no part 'pictures'"),
        ("image.batch", "many", "batch is 'many'"),
    ],
)
def test_invalid_settings_are_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        TINY.with_settings({setting: value})


def test_single_settings_are_replaced() -> None:
    changed_config = TINY.with_settings({"image.supersample": [2, 1], "image.optimiser.learning_rate": 1})
    assert changed_config.image.supersample == (2, 1)
    assert changed_config.image.optimiser.learning_rate == 1.0
    assert TrainConfig.from_dict(changed_config.to_dict()) == changed_config
