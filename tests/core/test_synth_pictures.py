"""Camera of synthetic photographs: supersampling, lenses, patches, compression."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.synth.camera.develop import develop, lens_gain, tilt
from lalaloc_core.learn.synth.camera.exposure import Exposure, sample_exposure, sample_staged_exposure
from lalaloc_core.learn.synth.camera.jpeg import compress
from lalaloc_core.learn.synth.camera.patches import cover_poles
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer, sample_shots
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary

ROWS, COLUMNS = 64, 128
seeds = st.integers(0, 2**32 - 1)


def camera(**settings: float) -> Exposure:
    """Return one row of a neutral exposure."""
    return Exposure(torch.from_numpy(Exposure.row(**settings))[None])


def noise_picture(seed: int = 0) -> torch.Tensor:
    """Smooth random colours in 0..1."""
    picture = torch.rand(1, 3, 8, 16, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    larger = torch.nn.functional.interpolate(picture, (ROWS, COLUMNS), mode="bilinear", align_corners=False)
    return larger.permute(0, 2, 3, 1)


# Lenses


@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_level_camera_with_one_lens_keeps_the_picture(seed: int) -> None:
    picture = noise_picture(seed)
    assert torch.allclose(tilt(picture, camera(seam=seed % 6)), picture, atol=1e-9)
    assert torch.equal(lens_gain(camera(seam=seed % 6), ROWS, COLUMNS), torch.ones(1, ROWS, COLUMNS).double())


@pytest.mark.parametrize(("axis", "column"), [("pitch", 64), ("roll", 96)])
def test_tilt_raises_one_side_and_lowers_the_other(axis: str, column: int) -> None:
    elevation = ((0.5 - (torch.arange(ROWS) + 0.5) / ROWS) * math.pi).double()
    picture = elevation[None, :, None, None].expand(1, ROWS, COLUMNS, 3).clone()
    angle = math.radians(2.0)
    # Each pixel holds the elevation that it shows.
    shown = tilt(picture, camera(**{axis: angle}))[0, ROWS // 2 - 4 : ROWS // 2 + 4, :, 0]
    change = (shown - picture[0, ROWS // 2 - 4 : ROWS // 2 + 4, :, 0]).mean(dim=0)
    opposite = (column + COLUMNS // 2) % COLUMNS
    assert abs(abs(float(change[column])) - angle) < 0.05 * angle
    assert abs(float(change[column] + change[opposite])) < 0.05 * angle
    assert abs(float(change[(column + COLUMNS // 4) % COLUMNS])) < 0.05 * angle


def test_seam_turns_with_the_picture() -> None:
    straight = lens_gain(camera(seam_step=0.2, vignette=0.3), ROWS, COLUMNS)
    turned = lens_gain(camera(seam_step=0.2, vignette=0.3, seam=math.pi / 2.0), ROWS, COLUMNS)
    assert torch.allclose(straight.roll(COLUMNS // 4, dims=2), turned, atol=1e-6)
    assert float(straight.max() / straight.min()) > 1.2


# Patches


@pytest.mark.parametrize("kind", range(6))
@pytest.mark.parametrize("radius_deg", [12.0, 30.0])
def test_patch_stays_within_its_radius(kind: int, radius_deg: float) -> None:
    picture = noise_picture()
    stand = camera(nadir=math.radians(radius_deg), nadir_kind=kind, nadir_tone=0.05, nadir_turn=1.0)
    covered = cover_poles(picture.clone(), stand)
    below = round(radius_deg / 180.0 * ROWS)
    assert torch.equal(covered[:, : ROWS - below - 1], picture[:, : ROWS - below - 1])
    assert not torch.equal(covered[:, -2:], picture[:, -2:])


def test_no_patch_covers_nothing() -> None:
    picture = noise_picture()
    assert torch.equal(cover_poles(picture.clone(), camera()), picture)


# Compression


@pytest.mark.parametrize("quality", [50, 80, 95])
@pytest.mark.parametrize("rows", [ROWS, ROWS - 6])
def test_compression_error_matches_jpeg_files(quality: int, rows: int) -> None:
    picture = noise_picture(3)[:, :rows]
    picture = (picture + 0.05 * torch.rand(picture.shape, generator=torch.Generator().manual_seed(1)).double()).clamp(
        0, 1
    )
    pixels = (picture[0] * 255.0).round().to(torch.uint8).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    expected = np.asarray(Image.open(file), dtype=float) / 255.0
    ours = compress(torch.from_numpy(pixels)[None] / 255.0, torch.tensor([float(quality)]))[0].numpy()
    loss, difference = np.abs(expected - pixels / 255.0).mean(), np.abs(expected - ours).mean()
    assert difference < 0.35 * loss + 0.002


# Exposure


@given(seed=seeds)
@settings(max_examples=30, deadline=None)
def test_staged_cameras_have_no_flaws(seed: int) -> None:
    drawn = sample_exposure(np.random.default_rng(seed), bright=seed % 2 == 0)
    assert max(abs(drawn.roll), abs(drawn.pitch)) <= math.radians(2.0) + 1e-9
    assert drawn.jpeg == 0.0 or 50.0 <= drawn.jpeg <= 95.0
    assert 0.0 <= drawn.nadir <= math.radians(65.0)
    staged = sample_staged_exposure(np.random.default_rng(seed))
    flaws = (staged.roll, staged.pitch, staged.nadir, staged.zenith, staged.seam_step, staged.seam_shift, staged.jpeg)
    assert not any(flaws)


@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_developed_picture_does_not_depend_on_its_batch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras = Exposure(torch.from_numpy(np.stack([sample_exposure(rng).rows for _ in range(4)])).float())
    radiance = torch.rand(4, ROWS, COLUMNS, 3, generator=torch.Generator().manual_seed(seed % 1000))
    noise = torch.zeros(ROWS, COLUMNS, 3)
    together = develop(radiance.clone(), cameras, noise)
    alone = torch.cat([develop(radiance[k : k + 1].clone(), cameras[k : k + 1], noise) for k in range(4)])
    # Rounding to bytes may fall either way.
    assert float(((together.int() - alone.int()).abs() > 1).float().mean()) < 0.01


# Supersampling


@pytest.fixture(scope="module")
def materials() -> MaterialLibrary:
    return MaterialLibrary.create(np.random.default_rng(0))


@pytest.mark.parametrize("rays", [(2, 1), (1, 2), (2, 2)])
def test_supersampling_keeps_the_picture(materials: MaterialLibrary, rays: tuple[int, int]) -> None:
    rng = np.random.default_rng(11)
    shots = [shot for _ in range(3) for shot in sample_shots(generate_home(rng), 2, rng, "empty")]
    few = PanoramaRenderer(materials, height=ROWS, width=COLUMNS).render(shots).float()
    many = PanoramaRenderer(materials, height=ROWS, width=COLUMNS, supersample=rays).render(shots).float()
    assert few.shape == many.shape
    assert float((few - many).abs().median()) <= 2.0
    # Averaging takes contrast away, never adds any.
    steps = [float((picture[:, 1:] - picture[:, :-1]).abs().mean()) for picture in (few, many)]
    assert rays[0] == 1 or steps[1] < steps[0]


def test_single_supersample_applies_to_both_axes(materials: MaterialLibrary) -> None:
    shots = sample_shots(generate_home(np.random.default_rng(1)), 1, np.random.default_rng(1))
    first, second = (
        PanoramaRenderer(materials, height=32, width=64, supersample=rays).render(shots) for rays in (2, (2, 2))
    )
    assert torch.equal(first, second)


def test_supersample_below_one_is_refused(materials: MaterialLibrary) -> None:
    with pytest.raises(InvalidInputError, match="at least 1"):
        PanoramaRenderer(materials, supersample=(0, 1))
