"""Photographs of any projection: decisions, errors, tilt, and patches."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import ExifTags

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.nets.layout_network import RingConfig
from lalaloc_core.nets.view_network import ViewEncoderConfig
from lalaloc_core.photograph import Intrinsics, PatchSize, Photograph, open_photograph
from lalaloc_core.photograph.cameras import Around, Camera, Fisheye, Perspective
from lalaloc_core.photograph.levelling import measure_bend
from lalaloc_core.photograph.patches import UNSEEN, Patch, joined_patches, patch_azimuths
from lalaloc_core.photograph.picture_files import PhotographLimits
from lalaloc_core.photograph.projection import is_sphere
from lalaloc_core.photograph.spheres import level
from tests.core.fault_photographs import FOLDER
from tests.core.taken import EXAMPLES, PHONE, jpeg, opened, sphere, take
from tests.core.test_photo_sphere import crop, encoded, xmp
from tests.painted import picture_file
from tests.strategies import present

Tag = ExifTags.Base
MAIN = Perspective.of_hfov(640, 480, math.radians(67.3))
ULTRAWIDE = Perspective.of_hfov(640, 480, math.radians(106.2))


def view_of(camera: Camera, name: str = "living_room", heading_deg: float = 0.0) -> np.ndarray:
    return take(sphere(name), camera, heading_deg=heading_deg)


class TestProjection:
    def test_orientation_is_applied_before_the_lens(self) -> None:
        upright = take(sphere("living_room"), Perspective.of_hfov(480, 640, math.radians(53.1)))
        view = opened(jpeg(np.rot90(upright).copy(), PHONE, orientation=6))
        assert math.degrees(view.hfov.value) == pytest.approx(53.1, abs=0.1)
        assert view.camera is not None
        assert (view.camera.width, view.camera.height) == (480, 640)
        same = opened(jpeg(upright, PHONE))
        assert np.abs(view.patches[0].pixels.astype(int) - same.patches[0].pixels).mean() < 4.0

    def test_focal_length_of_a_picture_that_was_cropped_is_not_used_against_its_lines(self) -> None:
        whole = view_of(Perspective.of_hfov(1280, 960, math.radians(106.2)), heading_deg=30.0)
        tags = {Tag.FocalLengthIn35mmFilm: 13, Tag.ExifImageWidth: 1280, Tag.ExifImageHeight: 960}
        assert opened(jpeg(whole[::2, ::2].copy(), tags)).hfov.source == "exif"
        view = opened(jpeg(whole[240:720, 320:960].copy(), tags))
        assert "its EXIF focal length gives 106°" in view.warnings[0]
        assert math.degrees(view.hfov.value) == pytest.approx(67.3, abs=10.0)

    @pytest.mark.parametrize("name", ["bedroom", "kitchen", "living_room", "study"])
    def test_sphere_without_metadata_is_recognised(self, name: str) -> None:
        view = opened((EXAMPLES / f"{name}.jpg").read_bytes())
        assert (view.projection, view.projection_source) == ("equirectangular", "estimated")
        assert present(view.sphere).shape == (128, 256, 3)
        assert view.patches == ()

    @pytest.mark.parametrize("name", ["bedroom", "kitchen", "living_room", "study"])
    def test_pictures_twice_as_wide_as_high_are_no_spheres(self, name: str) -> None:
        scene = sphere(name)
        pictures = {
            "crop": scene[64:320, 300:812],
            "half": scene[128:384, :512],
            "photograph": view_of(Perspective.of_hfov(600, 300, math.radians(90.0)), name),
            "white": np.full((256, 512, 3), 255, np.uint8),
            "ramp": np.broadcast_to(np.linspace(0, 255, 512).astype(np.uint8)[:, None], (256, 512, 3)),
            "noise": np.random.default_rng(0).integers(0, 256, (256, 512, 3)).astype(np.uint8),
        }
        for pixels in pictures.values():
            with pytest.raises(InvalidPhotographError, match=r"not a full 360° sphere.*state hfov_deg"):
                opened(jpeg(np.ascontiguousarray(pixels)))

    def test_stated_field_of_view_and_projection_make_pictures_usable(self) -> None:
        crop = jpeg(view_of(Perspective.of_hfov(600, 300, math.radians(90.0))))
        view = opened(crop, hfov_deg=90.0)
        assert (view.projection, view.projection_source, view.hfov.source) == ("perspective", "assumed", "given")
        content = (EXAMPLES / "kitchen.jpg").read_bytes()
        assert opened(content, projection="cylindrical", hfov_deg=180.0).projection == "cylindrical"
        white = jpeg(np.full((256, 512, 3), 255, np.uint8))
        assert opened(white, projection="equirectangular").sphere is not None

    def test_gpano_metadata_decide(self) -> None:
        scene = sphere("kitchen")
        part = crop(256, 128, 512, 256)
        view = opened(encoded(scene[128:384, 256:768].copy(), "JPEG", xmp(**part)))
        assert (view.projection, view.projection_source) == ("equirectangular", "gpano")
        assert view.azimuths == pytest.approx((-0.5 * math.pi, 0.5 * math.pi))
        strip = take(scene, Around(width=512, height=256, hfov=math.pi))
        content = encoded(strip, "JPEG", xmp(**part, ProjectionType="cylindrical"))
        view = opened(content)
        assert (view.projection, view.hfov.source) == ("cylindrical", "gpano")
        assert view.hfov.value == pytest.approx(math.pi)
        view = opened(content, intrinsics=Intrinsics(fx=400.0, fy=400.0))
        assert view.warnings == ("intrinsics are not used: the photograph is a strip",)

    def test_strip_asks_for_its_angle(self) -> None:
        strip = view_of(Around(width=1200, height=300, hfov=math.radians(240.0)))
        with pytest.raises(InvalidPhotographError, match="is a strip; state projection=cylindrical and hfov_deg"):
            opened(jpeg(strip))
        with pytest.raises(InvalidPhotographError, match="which angle the strip of 1200 x 300 shows; state hfov_deg"):
            opened(jpeg(strip, {Tag.CustomRendered: 6, Tag.FocalLengthIn35mmFilm: 26}))
        with pytest.raises(InvalidPhotographError, match="40000 x 64; one side can be 500 times as long as the other"):
            opened(picture_file(np.zeros((64, 40_000, 3), np.uint8)), hfov_deg=360.0)
        view = opened(jpeg(strip), hfov_deg=240.0)
        assert (view.projection, view.projection_source) == ("cylindrical", "assumed")
        assert len(view.patches) > 1

    def test_unknown_field_of_view_is_estimated(self) -> None:
        view = opened(jpeg(view_of(MAIN, "living_room", 45.0)))
        assert view.hfov.source == "estimated"
        assert abs(view.hfov.value - MAIN.hfov) < 3.0 * view.hfov.sd
        assert re.search(r"° ± \d+° was estimated from straight lines", view.warnings[-1])
        blank = np.full((480, 640, 3), 200, np.uint8)
        for exif in ({}, {Tag.FocalLengthIn35mmFilm: 65535}):
            view = opened(jpeg(blank, exif))
            # The prior: most phones are within one standard deviation of their usual lens.
            assert math.degrees(view.hfov.value) == pytest.approx(67.0, abs=5.0)
            assert math.degrees(view.hfov.sd) > 8.0
            assert re.search(r"° ± \d+° is only usual; state hfov_deg", view.warnings[-1])

    def test_damaged_exif_counts_as_missing(self) -> None:
        content = jpeg(np.full((96, 128, 3), 200, np.uint8), PHONE, orientation=6)
        begin = content.index(b"Exif") + 6
        rng = np.random.default_rng(0)
        sources = set()
        for _ in range(100):
            damaged = bytearray(content)
            for position in rng.integers(begin, begin + 80, 3):
                damaged[position] = rng.integers(0, 256)
            sources.add(opened(bytes(damaged)).hfov.source)
        assert sources == {"exif", "estimated"}

    def test_similar_borders_alone_make_no_sphere(self) -> None:
        tile = np.random.default_rng(0).integers(0, 256, (8, 16, 3)).astype(np.uint8)
        assert not is_sphere(cv2.resize(np.concatenate([tile, tile[:, ::-1]], axis=1), (256, 128)))

    @pytest.mark.parametrize("row", [slice(None, 6), slice(-6, None)])
    def test_an_object_at_one_pole_leaves_a_sphere(self, row: slice) -> None:
        pixels = sphere("living_room").copy()
        pixels[row, : pixels.shape[1] // 2] = 255
        pixels[row, pixels.shape[1] // 2 :] = 0
        assert is_sphere(pixels)


class TestStatements:
    @pytest.mark.parametrize(
        ("stated", "message"),
        [
            ({"projection": "mercator"}, "projection is 'mercator'; it must be one of auto, equirect"),
            ({"hfov_deg": math.nan}, "hfov_deg is nan; it must be between 10 and 360"),
            ({"hfov_deg": -60.0}, "hfov_deg is -60"),
            ({"projection": "perspective", "hfov_deg": 170.0}, "hfov_deg is 170; it must be between 10 and 150"),
            ({"pitch_deg": 80.0}, "pitch_deg is 80; it must be between -60 and 60"),
            ({"roll_deg": math.inf}, "roll_deg is inf"),
            ({"hfov_deg": 60.0, "intrinsics": Intrinsics(fx=500.0, fy=500.0)}, "exclude each other"),
            ({"projection": "cylindrical", "intrinsics": Intrinsics(fx=500.0, fy=500.0)}, "do not apply"),
            ({"intrinsics": Intrinsics(fx=0.0, fy=500.0)}, "fx is 0; it must be positive"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=math.nan)}, "fy is nan; it must be finite"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=100.0)}, "must agree within a factor of 2"),
            ({"intrinsics": Intrinsics(fx=20.0, fy=20.0)}, "a field of view of .*; it must be between 10° and 150°"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=500.0, cx=700.0)}, "cx is 700, outside of the upright picture of"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=500.0, k4=0.1)}, "k4 does not belong"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=500.0, k1=-2.0)}, "distortion is not invertible"),
            ({"intrinsics": Intrinsics(fx=500.0, fy=500.0, k1=1e9)}, "k1 is 1e\\+09; it must be between"),
            (
                {"projection": "fisheye", "intrinsics": Intrinsics(fx=300.0, fy=300.0, p1=0.1)},
                "p1 does not belong to the projection 'fisheye'",
            ),
            ({"projection": "fisheye"}, "a fisheye photograph needs hfov_deg"),
        ],
    )
    def test_invalid_values_are_refused(self, stated: dict[str, Any], message: str) -> None:
        with pytest.raises(InvalidPhotographError, match=message):
            opened(jpeg(view_of(MAIN), PHONE), **stated)

    def test_small_and_large_pictures_are_refused(self) -> None:
        with pytest.raises(InvalidPhotographError, match="50 x 40; the minimum is 64 pixels"):
            opened(jpeg(np.zeros((40, 50, 3), np.uint8)), hfov_deg=60.0)
        content = jpeg(np.zeros((200, 300, 3), np.uint8))
        with pytest.raises(InvalidPhotographError, match="max_pixels"):
            open_photograph(content, sphere_size=(128, 256), limits=PhotographLimits(max_pixels=1000))

    def test_intrinsics_are_used_with_their_distortion(self) -> None:
        camera = Perspective(width=640, height=480, fx=420.0, fy=420.0, cx=330.5, cy=230.5, radial=(-0.2, 0.03, 0.0))
        intrinsics = Intrinsics(fx=420.0, fy=420.0, cx=330.0, cy=230.0, k1=-0.2, k2=0.03)
        view = opened(jpeg(view_of(camera)), intrinsics=intrinsics, pitch_deg=0.0, roll_deg=0.0)
        assert view.camera == camera
        assert patch_error(view, "living_room") < 6.0


class TestTilt:
    @pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (15.0, 4.0), (-15.0, -4.0)])
    def test_tilt_is_estimated_within_its_uncertainty(self, pitch_deg: float, roll_deg: float) -> None:
        errors, deviations = [], []
        for name in ("bedroom", "kitchen", "living_room", "study"):
            for heading_deg in (20.0, 140.0, 260.0):
                pixels = take(sphere(name), ULTRAWIDE, pitch_deg=pitch_deg, roll_deg=roll_deg, heading_deg=heading_deg)
                view = opened(jpeg(pixels), hfov_deg=106.2)
                errors.append(np.degrees([view.pitch.value, view.roll.value]) - (pitch_deg, roll_deg))
                deviations.append(np.degrees([view.pitch.sd, view.roll.sd]))
        assert np.median(np.abs(errors), axis=0).max() < 1.0
        assert (np.abs(errors) < 3.0 * np.array(deviations)).mean() > 0.85

    @pytest.mark.parametrize("light", [200, 8])
    def test_blank_wall_tells_nothing_about_the_tilt(self, light: int) -> None:
        view = opened(jpeg(np.full((480, 640, 3), light, np.uint8)), hfov_deg=67.0)
        assert [text.split(",")[0] for text in view.warnings] == ["the photograph is dark"] * (light < 12)
        assert view.pitch.source == view.roll.source == "assumed"
        assert math.degrees(view.pitch.sd) > 10.0

    def test_stated_tilt_is_used(self) -> None:
        pixels = take(sphere("kitchen"), MAIN, pitch_deg=12.0, roll_deg=-3.0)
        view = opened(jpeg(pixels, PHONE), pitch_deg=12.0, roll_deg=-3.0)
        assert view.pitch.source == view.roll.source == "given"
        assert patch_error(view, "kitchen") < 6.0

    def test_stated_tilt_levels_a_sphere(self) -> None:
        tilted = sphere("kitchen")
        view = opened(jpeg(tilted), projection="equirectangular", pitch_deg=10.0, roll_deg=0.0)
        expected = cv2.resize(
            level(tilted, pitch=math.radians(10.0), roll=0.0), (256, 128), interpolation=cv2.INTER_AREA
        )
        assert np.abs(present(view.sphere).astype(int) - expected).mean() < 4.0


def _placed(headings_deg: Sequence[int]) -> list[tuple[Patch, float]]:
    views = [
        opened(jpeg(view_of(MAIN, heading_deg=heading), PHONE), pitch_deg=0.0, roll_deg=0.0) for heading in headings_deg
    ]
    return [(view.patches[0], math.radians(heading)) for view, heading in zip(views, headings_deg, strict=True)]


def patch_error(view: Photograph, name: str, heading_deg: float = 0.0) -> float:
    """Return the mean difference (grey levels) of the patches from the scene that the photograph was taken from."""
    size = PatchSize()
    camera = Around(width=size.width, height=2 * size.height, hfov=size.hfov, spherical=True)
    errors = []
    for patch in view.patches:
        whole = take(sphere(name), camera, heading_deg=heading_deg + math.degrees(patch.azimuth_rad))
        bottom = camera.height // 2 - round(math.radians(size.bottom_deg) * camera.resolution)
        expected = whole[bottom - size.height : bottom]
        errors.append(np.abs(patch.pixels[patch.seen].astype(int) - expected[patch.seen]).mean())
    return float(np.mean(errors))


class TestPatches:
    def test_patch_has_square_pixels_and_the_size_of_the_encoder(self) -> None:
        size = PatchSize()
        assert (size.bottom_deg, size.top_deg) == (-45.0, 39.375)
        assert size.resolution == pytest.approx(size.height / math.radians(size.top_deg - size.bottom_deg))
        config = ViewEncoderConfig()
        ring = RingConfig(sectors=64)
        assert (size.height, size.width, size.top_deg) == (config.image_height, config.image_width, config.top_deg)
        assert size.hfov == pytest.approx(config.width_rad(ring))

    @pytest.mark.parametrize(
        ("camera", "stated"),
        [
            (ULTRAWIDE, {"hfov_deg": 106.2}),
            (Around(width=1400, height=400, hfov=math.radians(250.0)), {"hfov_deg": 250.0}),
            (Around(width=1600, height=400, hfov=2.0 * math.pi), {"projection": "cylindrical", "hfov_deg": 360.0}),
            (Fisheye.of_hfov(800, 800, math.radians(180.0)), {"projection": "fisheye", "hfov_deg": 180.0}),
            (
                Around(width=1000, height=400, hfov=math.radians(200.0), spherical=True),
                {"projection": "equirectangular", "hfov_deg": 200.0},
            ),
        ],
    )
    def test_patches_show_the_sphere(self, camera: Camera, stated: dict[str, Any]) -> None:
        view = opened(jpeg(view_of(camera)), pitch_deg=0.0, roll_deg=0.0, **stated)
        assert patch_error(view, "living_room") < 6.0
        assert view.azimuths == pytest.approx((-0.5 * camera.hfov, 0.5 * camera.hfov), abs=0.02)

    def test_strip_is_decoded_as_fine_as_its_patches(self) -> None:
        """Stripes of 1° stay sharp in a strip that is many times as wide as photographs are decoded."""
        strip = np.zeros((1000, 6000, 3), np.uint8)
        strip[:, (np.arange(6000) // 17) % 2 == 0] = 255
        view = opened(jpeg(strip), hfov_deg=359.0, pitch_deg=0.0, roll_deg=0.0)
        assert all(patch.pixels[96, 20:-20].std() > 93.0 for patch in view.patches)

    def test_pitch_of_a_strip_moves_its_horizon(self) -> None:
        strip = view_of(Around(width=1400, height=400, hfov=math.radians(250.0), elevation=math.radians(8.0)))
        view = opened(jpeg(strip), projection="cylindrical", hfov_deg=250.0, pitch_deg=8.0, roll_deg=0.0)
        assert patch_error(view, "living_room") < 6.0
        assert view.pitch.source == "given"

    def test_unseen_pixels_are_grey(self) -> None:
        (patch,) = opened(jpeg(view_of(MAIN), PHONE), pitch_deg=0.0, roll_deg=0.0).patches
        assert (patch.pixels[~patch.seen] == UNSEEN).all()
        np.testing.assert_array_equal(patch.rgba[..., 3] == 255, patch.seen)
        seen_columns = np.flatnonzero(patch.seen.any(axis=0))
        resolution = PatchSize().width / PatchSize().hfov_deg
        assert len(seen_columns) / resolution == pytest.approx(67.3, abs=1.0)
        assert seen_columns.mean() == pytest.approx(127.5, abs=1.0)

    @pytest.mark.parametrize("first_deg", [0, 15, -170])
    def test_photographs_once_around_are_joined(self, first_deg: int) -> None:
        joined = joined_patches(_placed(range(first_deg, first_deg + 360, 40)), PatchSize())
        assert [round(math.degrees(patch.azimuth_rad)) for patch in joined] == list(range(0, 360, 45))
        assert all(patch.seen.any(axis=0).all() for patch in joined)
        view = replace(opened(jpeg(view_of(MAIN), PHONE)), patches=tuple(joined))
        assert patch_error(view, "living_room") < 8.0

    @pytest.mark.parametrize("headings_deg", [(0,), (0, 40, 80), (0, 120, 240), range(0, 320, 40)])
    def test_photographs_with_a_gap_are_not_joined(self, headings_deg: Sequence[int]) -> None:
        assert joined_patches(_placed(headings_deg), PatchSize()) == []

    @pytest.mark.parametrize("hfov_deg", [60.0, 112.5, 140.0, 200.0, 300.0, 359.0, 360.0])
    def test_patches_cover_every_azimuth(self, hfov_deg: float) -> None:
        size = PatchSize()
        centres = np.degrees(patch_azimuths(math.radians(hfov_deg), size))
        azimuth = np.linspace(-0.5, 0.5, 721) * hfov_deg
        offset = np.abs((azimuth[:, None] - centres + 180.0) % 360.0 - 180.0)
        assert offset.min(axis=1).max() <= 0.5 * (size.hfov_deg + size.step_deg)
        assert len(centres) <= 1 + hfov_deg / 80.0

    def test_fine_stripes_become_grey(self) -> None:
        """Sampling without filtering would turn stripes into moiré."""
        stripes = np.zeros((1512, 2016, 3), np.uint8)
        stripes[:, ::2] = 254
        (patch,) = opened(picture_file(stripes), hfov_deg=67.0, pitch_deg=0.0, roll_deg=0.0).patches
        assert patch.pixels[patch.seen].std() < 4.0

    def test_verticals_of_a_tilted_photograph_become_vertical(self) -> None:
        """A white stripe on one meridian stays in one column."""
        scene = np.zeros((512, 1024, 3), np.uint8)
        scene[:, 590:598] = 255
        pixels = take(scene, ULTRAWIDE, pitch_deg=15.0, roll_deg=5.0)
        (patch,) = opened(jpeg(pixels), hfov_deg=106.2, pitch_deg=15.0, roll_deg=5.0).patches
        rows = np.flatnonzero(patch.seen[:, 180:206].all(axis=1))
        weights = patch.pixels[rows, 180:206, 0].astype(float)
        centres = weights @ np.arange(180, 206) / weights.sum(axis=1)
        expected = 127.5 + (594.0 / 1024.0 - 0.5) * 360.0 * 256.0 / 112.5
        assert len(rows) > 100
        np.testing.assert_allclose(centres, expected, atol=1.0)


@pytest.mark.parametrize("field", [120.0, 130.0])
def test_fisheye_picture_that_is_read_in_perspective_has_bent_lines(field: float) -> None:
    camera = Fisheye.of_hfov(1280, 960, math.radians(field))
    taken = jpeg(take(sphere("living_room"), camera))
    warnings = opened(taken, projection="perspective", hfov_deg=100.0).warnings
    assert any("straight lines are bent by" in text and "state projection=fisheye" in text for text in warnings)
    stated = opened(taken, projection="fisheye", hfov_deg=field).warnings
    assert not any("bent" in text for text in stated)


@pytest.mark.parametrize("name", ["kitchen", "living_room", "bedroom", "study"])
@pytest.mark.parametrize("heading_deg", [0.0, 200.0])
def test_lines_of_a_picture_in_perspective_are_straight(name: str, heading_deg: float) -> None:
    camera = Perspective.of_hfov(1280, 960, math.radians(80.0))
    photograph = opened(jpeg(take(sphere(name), camera, heading_deg=heading_deg)), hfov_deg=80.0)
    assert not any("bent" in text for text in photograph.warnings)


def test_camera_with_an_orientation_or_a_stated_tilt_tells_which_side_is_up() -> None:
    upright = view_of(MAIN, heading_deg=120.0)
    by_software, by_camera = jpeg(upright, orientation=1), jpeg(upright, orientation=1, maker="Phone")
    by_editor = jpeg(upright[:-1], orientation=1, maker="Phone")
    assert [opened(content).is_upright for content in (by_software, by_camera, by_editor)] == [False, True, False]
    assert opened(by_software, pitch_deg=40.0).is_upright


def test_bend_is_measured_in_shares_of_the_longer_side() -> None:
    def bent(x: np.ndarray, y: float) -> np.ndarray:
        """Return pieces of a line that rises by 8 px to its middle."""
        points = np.stack([x, y + math.copysign(8.0, y - 240.0) * (1.0 - ((x - 320.0) / 320.0) ** 2)], axis=1)
        return np.concatenate([points[:-1], points[1:]], axis=1)

    x = np.linspace(0.0, 640.0, 17)
    lines = np.concatenate([bent(x, y) for y in (20.0, 60.0, 420.0, 460.0)])
    bend = measure_bend(lines, width=640, height=480)
    assert bend == pytest.approx(8.0 / 640.0 * 240.0 / 200.0, rel=0.2)
    straight = np.concatenate(
        [np.stack([x[:-1], x[:-1] * 0 + y, x[1:], x[1:] * 0 + y], axis=1) for y in (20.0, 60.0, 460.0)]
    )
    assert (measure_bend(straight, width=640, height=480) or 0.0) == pytest.approx(0.0, abs=1e-6)
    # An arch is on one side of the centre.
    assert measure_bend(np.concatenate([bent(x, y) for y in (20.0, 40.0, 60.0)]), width=640, height=480) is None


def test_exif_orientation_of_a_heic_picture_without_a_turn_is_named() -> None:
    content = (FOLDER / "phone.heic").read_bytes()
    # An entry of the orientation in the place of that of the Exif block.
    entry = b"\x87i\0\4\0\0\0\1\0\0\0\x1a", b"\1\x12\0\3\0\0\0\1\0\6\0\0"
    photograph = opened(content.replace(*entry))
    assert photograph.warnings[0].startswith("the Exif orientation 6 was ignored, as HEIC")
    assert not photograph.is_upright


def test_heic_picture_with_a_broken_exif_block_is_read() -> None:
    photograph = opened((FOLDER / "heic_bad_exif.heic").read_bytes())
    assert present(photograph.sphere).std() > 20.0
    assert any("Exif" in text or "EXIF" in text for text in photograph.warnings), photograph.warnings
