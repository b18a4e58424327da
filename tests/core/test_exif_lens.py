"""Focal lengths by EXIF metadata: as phones write them, and absurd ones."""

from __future__ import annotations

import math
from typing import Any

import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from lalaloc_core.photograph.exif import ExifLens, read_exif_lens

Tag = ExifTags.Base
FULL_SIZE: dict[Any, Any] = {Tag.ExifImageWidth: 4032, Tag.ExifImageHeight: 3024}


def read(tags: dict[Any, Any], size: tuple[int, int] = (4032, 3024), packets: tuple[bytes, ...] = ()) -> ExifLens:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update(tags)
    return read_exif_lens(exif, packets, width=size[0], height=size[1])


def hfov_deg(lens: ExifLens, width: int) -> float:
    assert lens.focal is not None
    return math.degrees(2.0 * math.atan(0.5 * width / lens.focal))


@pytest.mark.parametrize(
    ("film_mm", "size", "expected_deg"),
    [
        (26, (4032, 3024), 67.3),
        (26, (3024, 4032), 53.1),
        (13, (4032, 3024), 106.2),
        # 16:9 keeps the width of the 4:3 sensor, a square its height.
        (26, (4032, 2268), 67.3),
        (26, (3024, 3024), 53.1),
        (24, (6000, 4000), 73.7),
    ],
)
def test_equivalent_focal_length_gives_the_field_of_view(
    film_mm: int, size: tuple[int, int], expected_deg: float
) -> None:
    lens = read({Tag.FocalLengthIn35mmFilm: film_mm}, size=size)
    assert hfov_deg(lens, size[0]) == pytest.approx(expected_deg, abs=0.1)
    assert lens.warnings == ()


def test_sensor_by_resolution_replaces_the_equivalent() -> None:
    plane = {Tag.FocalPlaneXResolution: IFDRational(4_032_000, 489), Tag.FocalPlaneResolutionUnit: 3}
    by_plane = read(FULL_SIZE | plane | {Tag.FocalLength: IFDRational(415, 100), Tag.DigitalZoomRatio: 1.0})
    assert hfov_deg(by_plane, 4032) == pytest.approx(61.0, abs=0.2)
    zoomed = read(FULL_SIZE | plane | {Tag.FocalLength: 4.15, Tag.DigitalZoomRatio: 2.0})
    assert zoomed.focal == pytest.approx(2.0 * (by_plane.focal or 0.0))


def test_digital_zoom_widens_the_uncertainty() -> None:
    plain = read({Tag.FocalLengthIn35mmFilm: 52})
    zoomed = read({Tag.FocalLengthIn35mmFilm: 52, Tag.DigitalZoomRatio: 2.0})
    assert zoomed.focal == plain.focal
    assert zoomed.focal_sd > 5.0 * plain.focal_sd


@pytest.mark.parametrize(
    ("tags", "shown"),
    [
        ({Tag.FocalLengthIn35mmFilm: 65535}, "FocalLengthIn35mmFilm is 65535 mm; it must be between 4 and 250 mm"),
        ({Tag.FocalLength: IFDRational(4, 0)}, "FocalLength is not a number"),
        ({Tag.FocalLength: -4.0}, "FocalLength is -4 mm"),
        ({Tag.FocalLengthIn35mmFilm: "wide"}, "FocalLengthIn35mmFilm is not a number"),
        ({Tag.FocalLengthIn35mmFilm: (26, 26)}, "FocalLengthIn35mmFilm is not a number"),
        ({Tag.DigitalZoomRatio: 1e9}, "DigitalZoomRatio is 1e+09; it must be between 1 and 20"),
        (FULL_SIZE | {Tag.FocalLength: 4.2, Tag.FocalPlaneXResolution: 0.001}, "FocalPlaneXResolution gives a sensor"),
    ],
)
def test_absurd_values_are_ignored_with_a_warning(tags: dict[Any, Any], shown: str) -> None:
    lens = read(tags)
    assert lens.focal is None
    assert len(lens.warnings) == 1
    assert shown in lens.warnings[0]


def test_zero_means_unknown() -> None:
    tags = {Tag.FocalLength: IFDRational(0, 1), Tag.FocalLengthIn35mmFilm: 0, Tag.DigitalZoomRatio: IFDRational(0, 1)}
    assert read(tags) == ExifLens(focal_sd=read({}).focal_sd)


def test_picture_cropped_later_has_no_focal_length() -> None:
    tags = FULL_SIZE | {Tag.FocalLengthIn35mmFilm: 26}
    assert not read(tags).is_doubtful
    assert read(tags, size=(2016, 1512)).is_doubtful
    assert read(tags, size=(1512, 2016)).focal is not None
    assert "was cropped" in read(tags, size=(1800, 1512)).warnings[0]
    edited = {Tag.FocalLengthIn35mmFilm: 26, Tag.ExifImageWidth: 1131, Tag.ExifImageHeight: 935}
    assert "was cropped" in read(edited, size=(1131, 935)).warnings[0]
    assert read({Tag.FocalLengthIn35mmFilm: 26}, size=(963, 722)).is_doubtful


@pytest.mark.parametrize(
    ("packet", "is_cropped"),
    [
        (b"<x ns1:HasCrop='True'/>", True),
        (b"<x crs:CropTop='0.000' crs:CropLeft='0.25'/>", True),
        (b'<x crs:HasCrop="True" crs:AlreadyApplied="False"/>', False),
        (b'<x tiff:ImageWidth="4032" tiff:ImageLength="2268"/>', True),
        (b'<li darktable:operation="crop" darktable:enabled="1"/>', True),
        (b'<li darktable:operation="crop" darktable:enabled="0"/><li darktable:operation="flip"/>', False),
    ],
)
def test_crops_are_stated_by_editors(packet: bytes, is_cropped: bool) -> None:
    assert (read({Tag.FocalLengthIn35mmFilm: 26}, packets=(packet,)).focal is None) == is_cropped
