"""Pictures that hold a sphere in another format: converted, or named; ordinary photographs are left alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import Fisheye, Perspective
from lalaloc_core.photograph.picture_files import PhotographLimits, opened_picture
from lalaloc_core.photograph.sphere_formats import THUMBNAIL_SIDE, Thumbnail, find_sphere_format, inside_bars
from tests.core.taken import jpeg, opened, sphere, take, within_bars
from tests.core.test_photo_sphere import crop, encoded, xmp
from tests.painted import picture_file
from tests.strategies import present

NAMES = ("bedroom", "kitchen", "living_room", "study")


@cache
def small(name: str) -> np.ndarray:
    return cv2.resize(sphere(name), (1024, 512), interpolation=cv2.INTER_AREA)


def faces(sphere: np.ndarray) -> list[np.ndarray]:
    """Return front, right, back, left, up and down."""
    camera = Perspective.of_hfov(256, 256, 0.5 * math.pi)
    band = [take(sphere, camera, heading_deg=heading) for heading in (0.0, 90.0, 180.0, 270.0)]
    return [*band, take(sphere, camera, pitch_deg=90.0), take(sphere, camera, pitch_deg=-90.0)]


def equiangular(face: np.ndarray) -> np.ndarray:
    """Return a face with pixels at equal angles."""
    place = (np.arange(256) + 0.5) / 256 * 2.0 - 1.0
    on_face = ((np.tan(place * 0.25 * np.pi) + 1.0) * 128 - 0.5).astype(np.float32)
    return cv2.remap(face, *np.meshgrid(on_face, on_face), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def barred(sphere: np.ndarray, above: int, beside: int, grey: int = 0) -> np.ndarray:
    return np.pad(sphere, ((above, above), (beside, beside), (0, 0)), constant_values=grey)


def usable(sphere: np.ndarray) -> dict[str, np.ndarray]:
    """Return pictures from which the sphere is taken, by a word of their warning."""
    return {
        "bars at its borders, 11%": barred(sphere, 32, 0),
        "bars at its borders, 33%": barred(sphere, 128, 0, 255),
        "bars at its borders, 16%": barred(sphere, 0, 100),
    }


def circle(sphere: np.ndarray, heading_deg: float) -> np.ndarray:
    picture = take(sphere, Fisheye.of_hfov(512, 512, math.radians(190.0)), heading_deg=heading_deg)
    place = np.arange(512) - 255.5
    return picture * (np.hypot(*np.meshgrid(place, place)) < 255.0)[..., None].astype(np.uint8)


def unusable(sphere: np.ndarray) -> dict[str, np.ndarray]:
    """Return pictures that are refused, by a word of the refusal."""
    front, right, back, left, up, down = faces(sphere)
    empty = np.zeros_like(front)
    white = empty + 255
    other_eye = np.roll(sphere, 6, axis=1)
    square, other_square = (cv2.resize(eye, (512, 512)) for eye in (sphere, other_eye))
    rows = [[empty, up, empty, empty], [left, front, right, back], [empty, down, empty, empty]]
    column = [[white, up, white], [left, front, right], [white, down, white], [white, np.rot90(back, 2), white]]
    of_video = [equiangular(face) for face in (front, right, back, left, up, down)]
    turned = [np.rot90(of_video[5]), np.rot90(of_video[2], -1), np.rot90(of_video[4])]
    two = [circle(sphere, heading_deg) for heading_deg in (0.0, 180.0)]
    half, other_half = (eye[:, 256:768] for eye in (sphere, other_eye))
    return {
        "cube map, 3 x 2 faces": np.vstack([np.hstack([right, left, up]), np.hstack([down, front, back])]),
        "cube map, 3 x 2 faces: convert": np.vstack([np.hstack([of_video[i] for i in (3, 0, 1)]), np.hstack(turned)]),
        "cube map, 3 x 2": np.vstack(
            [np.hstack([left, np.rot90(front), right]), np.hstack([down, back[::-1, ::-1], up])]
        ),
        "cube map, 2 x 3": np.vstack([np.hstack([right, left]), np.hstack([up, down]), np.hstack([front, back])]),
        "cube map, 6 x 1": np.hstack([right, left, up, down, front, back]),
        "cube map, 6 x 1 faces": np.hstack([up, front, right, back, left, down]),
        "cube map, 6 x 1 faces: convert": np.hstack([np.rot90(right), left, up, down, np.rot90(front, -1), back]),
        "cube map, 1 x 6": np.vstack([front, right, back, left, up, down]),
        "cross of 4 x 3": np.vstack([np.hstack(row) for row in rows]),
        "cross of 3 x 4": np.vstack([np.hstack(row) for row in column]),
        "one eye above the other: cut out": np.vstack([sphere, other_eye]),
        "one eye beside the other: cut out": np.hstack([sphere, other_eye]),
        "stereo sphere, one eye beside": np.hstack([square, other_square]),
        "VR180, two eyes": np.hstack([half, other_half]),
        "dual fisheye": np.hstack(two),
        "dual fisheye picture": np.vstack(two),
        "circle of a fisheye": two[0],
        "circle of a fisheye lens": barred(two[0], 0, 100),
    }


@pytest.mark.parametrize("name", NAMES)
def test_sphere_is_taken_out_of_its_bars(name: str) -> None:
    sphere = small(name)
    whole = present(opened(jpeg(sphere)).sphere)
    for words, pixels in usable(sphere).items():
        view = opened(jpeg(pixels))
        assert (view.projection, view.projection_source) == ("equirectangular", "estimated"), words
        assert words in view.warnings[0]
        assert np.abs(present(view.sphere).astype(int) - whole).mean() < 6.0, words


@pytest.mark.parametrize(("columns", "gap"), [(3, 0), (2, 0), (2, 12)])
def test_collages_are_refused_and_are_no_cube_maps(columns: int, gap: int) -> None:
    rooms = [[barred(face, gap, gap) for face in faces(small(name))[:2]] for name in NAMES[:columns]]
    pixels = np.vstack([np.hstack([room[row] for room in rooms]) for row in (0, 1)])
    found = find_sphere_format(thumbnail(pixels))
    assert present(found).text.startswith(f"the photograph is a collage of {columns} x 2 photographs")


def thumbnail(pixels: np.ndarray) -> Thumbnail:
    share = THUMBNAIL_SIDE / max(pixels.shape)
    return Thumbnail(cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("ratio", [(2, 1), (4, 3), (3, 4), (3, 2), (1, 1), (16, 9)])
def test_detectors_scale_few_pixels(ratio: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    width, height = ratio
    pixels = cv2.resize(small("kitchen"), (THUMBNAIL_SIDE * width // max(ratio), THUMBNAIL_SIDE * height // max(ratio)))
    resize = Mock(wraps=cv2.resize)
    monkeypatch.setattr(cv2, "resize", resize)
    assert find_sphere_format(Thumbnail(pixels)) is None
    scaled = [math.prod(call.args[0].shape[:2]) for call in resize.call_args_list]
    assert sum(scaled) <= 4 * THUMBNAIL_SIDE**2, scaled


@pytest.mark.parametrize("name", NAMES)
def test_format_that_is_not_converted_is_refused_by_name(name: str) -> None:
    for words, pixels in unusable(small(name)).items():
        with pytest.raises(InvalidPhotographError, match=words):
            opened(jpeg(np.ascontiguousarray(pixels)))


def test_statement_turns_a_refusal_into_a_warning() -> None:
    pixels = unusable(small("kitchen"))["dual fisheye"]
    view = opened(jpeg(pixels), projection="equirectangular")
    assert "two circles that are not stitched" in view.warnings[0]
    assert opened(jpeg(pixels), hfov_deg=90.0).warnings == ()
    with pytest.raises(InvalidPhotographError, match="two circles"):
        opened(encoded(pixels, "JPEG", xmp(ProjectionType="equirectangular")))


@pytest.mark.parametrize("orientation", [6, 8])
def test_orientation_of_a_sphere_is_ignored(orientation: int) -> None:
    view = opened(jpeg(small("kitchen"), orientation=orientation))
    whole = present(opened(jpeg(small("kitchen"))).sphere)
    assert np.abs(present(view.sphere).astype(int) - whole).mean() < 3.0
    assert f"Exif orientation {orientation}, which is ignored" in view.warnings[0]


def ordinary(sphere: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, bool]]:
    """Yield views of usual lenses and shapes, and crops, whose lines are bent; and whether it is a crop."""
    for hfov_deg in (50.0, 67.0, 106.0):
        for width, height in ((640, 480), (480, 640), (600, 400), (360, 640), (640, 360), (500, 500), (800, 400)):
            across = 2.0 * math.atan(math.tan(0.5 * math.radians(hfov_deg)) * min(1.0, width / height))
            tilt = {"heading_deg": rng.uniform(0.0, 360.0), "pitch_deg": rng.uniform(-15.0, 15.0)}
            yield take(sphere, Perspective.of_hfov(width, height, across), **tilt), False
    for width, height in ((600, 300), (480, 320), (512, 384), (400, 400), (300, 450), (900, 400)):
        left, top = int(rng.integers(0, 1024 - width)), int(rng.integers(0, 512 - height))
        yield sphere[top : top + height, left : left + width], True


# One picture in four of one room, or all pictures of all rooms.
@pytest.mark.parametrize(
    ("name", "every"), [(NAMES[0], 4), *(pytest.param(name, 1, marks=pytest.mark.slow) for name in NAMES)]
)
def test_ordinary_photographs_are_left_alone(name: str, every: int) -> None:
    words = ("sphere", "cube map", "fisheye", "VR180")
    for pixels, is_crop in ((small(name), False), *list(ordinary(small(name), np.random.default_rng(0)))[::every]):
        try:
            warnings = opened(jpeg(np.ascontiguousarray(pixels))).warnings
        except InvalidPhotographError as error:
            # A crop twice as wide as high, or a strip.
            warnings = (str(error).replace("a full 360° sphere", "full"),)
        told = [text for text in warnings if not (is_crop and text.startswith("straight lines are bent"))]
        assert not any(word in text for word in words for text in told), warnings


class TestParts:
    """Parts of the sphere by their GPano metadata."""

    def part(self, left: int, **others: float) -> bytes:
        pixels = small("kitchen")[100:410, left : left + 600]
        return encoded(pixels, "JPEG", xmp(**crop(left, 100, 600, 310, **others)))

    @pytest.mark.parametrize("pitch_deg", [0.0, 5.0])
    def test_heading_is_that_of_the_centre_of_the_picture(self, pitch_deg: float) -> None:
        views = [opened(self.part(left, PosePitchDegrees=pitch_deg, PoseHeadingDegrees=200)) for left in (100, 212)]
        turn_deg = (100 + 300 - 512) * 360.0 / 1024.0
        assert views[0].compass_heading == pytest.approx(math.radians(200.0 + turn_deg))
        assert views[1].compass_heading == pytest.approx(math.radians(200.0))
        assert views[0].azimuths == pytest.approx((-math.pi * 600 / 1024, math.pi * 600 / 1024))
        # The seen part is in the middle: the border is neutral on both sides.
        seen = np.flatnonzero((present(views[0].sphere)[64] != 128).any(axis=-1))
        assert abs(seen[0] + seen[-1] - 255) <= 2

    def test_part_beyond_the_seam_is_refused(self) -> None:
        with pytest.raises(InvalidPhotographError, match=r"600 x 300 at \(800, 100\) is not within .* not a full"):
            opened(encoded(small("kitchen")[100:400, :600], "JPEG", xmp(**crop(800, 100, 600, 300))))

    def test_strip_of_a_full_turn_must_close(self) -> None:
        stated = {"ProjectionType": "cylindrical", "FullPanoWidthPixels": 1024, "CroppedAreaImageWidthPixels": 1024}
        whole, part = small("kitchen")[128:384], cv2.resize(small("kitchen")[128:384, :600], (1024, 400))
        assert opened(encoded(whole, "JPEG", xmp(**stated))).hfov.value == math.tau
        with pytest.raises(InvalidPhotographError, match=r"borders do not continue each other; state hfov_deg"):
            opened(encoded(part, "JPEG", xmp(**stated)))


_ONE_COLOUR = ["black", "unequal", "of two colours", "on one side", "with a strip", "in a window"]


@pytest.mark.parametrize("kind", [*_ONE_COLOUR, "blurred", "gradient"])
def test_photograph_is_taken_out_of_its_bars(kind: str) -> None:
    view = take(small("study"), Perspective.of_hfov(640, 400, math.radians(80.0)))
    found = opened(picture_file(within_bars(view, kind)))
    assert found.projection == "perspective"
    assert "% of the picture, as in a screenshot" in found.warnings[0]
    assert (present(found.camera).width, present(found.camera).height) == pytest.approx((640, 400), abs=5)


def test_black_zenith_and_nadir_and_a_single_edge_are_no_bars() -> None:
    edge = np.full((480, 360, 3), 235, np.uint8) * (np.arange(480) > 80)[:, None, None].astype(np.uint8)
    assert inside_bars(edge[None]) == ((0, 480), (0, 360))
    pixels = small("kitchen").copy()
    pixels[:60] = pixels[-60:] = 0
    for view in (opened(jpeg(pixels)), opened(jpeg(pixels), projection="equirectangular")):
        assert view.is_sphere
        assert not any("bars" in text for text in view.warnings)


@pytest.mark.parametrize(
    ("size", "stated", "is_ignored"),
    [((480, 640), (640, 480), True), ((640, 480), (480, 640), False), ((640, 480), (640, 480), False)],
)
def test_orientation_of_a_picture_that_was_turned_is_ignored(
    size: tuple[int, int], stated: tuple[int, int], is_ignored: bool
) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.ExifImageWidth: stated[0], ExifTags.Base.ExifImageHeight: stated[1]}
    content = picture_file(Image.new("RGB", size), "JPEG", exif=exif.tobytes())
    with opened_picture(content, PhotographLimits()) as file:
        assert (file.orientation, len(file.warnings)) == ((1, 1) if is_ignored else (6, 0))
