"""Reading spheres: accepted files, refused files, and robustness against damaged ones."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageChops

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph import StatedCamera, open_photograph
from lalaloc_core.photograph.file_segments import count_scans
from lalaloc_core.photograph.spheres import NEUTRAL, PhotographLimits, read_sphere
from tests.growth import assert_no_worse_than_linear
from tests.painted import picture_file as encoded
from tests.painted import png_file

HEIGHT, WIDTH = 32, 64
NOISE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (128, 256, 3), dtype=np.uint8))
LOSSLESS = {"PNG": {}, "WEBP": {"lossless": True}}
NEARLY = {"JPEG": {"quality": 95}, **LOSSLESS}
# By Exif orientation, from 2 on.
TURNS = ["FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE", "ROTATE_90", "TRANSVERSE", "ROTATE_270"]


def picture(mode: str = "RGB", height: int = 128) -> Image.Image:
    """Return a picture with red, green, blue and white quarters from the left; the upper half is darker."""
    quarters = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]], np.uint8)
    pixels = np.repeat(quarters, height // 2, axis=0)[None].repeat(height, 0)
    pixels[: height // 2] //= 2
    return Image.fromarray(pixels).convert(mode)


def read(content: bytes, limits: PhotographLimits | None = None) -> np.ndarray:
    return read_sphere(content, height=HEIGHT, width=WIDTH, limits=limits)


def of_scans(width: int, height: int, added: int) -> bytes:
    """Return a grey progressive JPEG of six scans with the last one repeated, a few dozen bytes each."""
    content = encoded(Image.new("L", (width, height), 90), "JPEG", progressive=True)
    # A scan starts with its Huffman table.
    begin = content.rindex(b"\xff\xc4", 0, content.rindex(b"\xff\xda"))
    return content[:-2] + added * content[begin:-2] + content[-2:]


class TestAccepted:
    @pytest.mark.parametrize("kind", NEARLY)
    def test_every_format_gives_the_same_pixels(self, kind: str) -> None:
        pixels = read(encoded(picture(), kind, **NEARLY[kind]))
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        assert pixels.dtype == np.uint8
        for quarter, colour in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)]):
            column = quarter * WIDTH // 4 + WIDTH // 8
            np.testing.assert_allclose(pixels[3 * HEIGHT // 4, column], colour, atol=6)
            np.testing.assert_allclose(pixels[HEIGHT // 4, column], np.array(colour) // 2, atol=6)

    @pytest.mark.parametrize("mode", ["RGBA", "P", "CMYK"])
    def test_other_colour_modes_become_rgb(self, mode: str) -> None:
        content = encoded(picture(mode), "JPEG" if mode == "CMYK" else "PNG")
        np.testing.assert_allclose(
            read(content)[24, [8, 24, 40, 56]].astype(int), np.array(picture())[96, 32::64], atol=8
        )

    def test_cmyk_with_and_without_adobe_marker(self) -> None:
        inks = picture("CMYK")
        with_marker = encoded(inks, "JPEG", quality=98)
        np.testing.assert_allclose(read(with_marker).astype(int), read(encoded(inks.convert("RGB"))), atol=8)
        # Files without the marker are not inverted; Pillow writes inverted inks, so both give the same picture.
        start = with_marker.index(b"\xff\xee")
        length = 2 + int.from_bytes(with_marker[start + 2 : start + 4], "big")
        assert with_marker[start + 4 : start + 9] == b"Adobe"
        plain = encoded(ImageChops.invert(inks), "JPEG", quality=98)
        plain = plain[:start] + plain[start + length :]
        np.testing.assert_allclose(read(plain).astype(int), read(with_marker), atol=8)

    @pytest.mark.parametrize("kind", LOSSLESS)
    @pytest.mark.parametrize("opacity", [0, 64, 128, 255])
    def test_transparent_pixels_become_neutral(self, kind: str, opacity: int) -> None:
        see_through = picture("RGBA")
        see_through.putalpha(opacity)
        options = LOSSLESS[kind] | ({"exact": True} if kind == "WEBP" else {})
        share = opacity / 255.0
        expected = share * np.asarray(read(encoded(picture()))) + (1.0 - share) * np.array(NEUTRAL)
        np.testing.assert_allclose(read(encoded(see_through, kind, **options)), expected, atol=1.5)

    def test_transparent_colours_of_other_modes_become_neutral(self) -> None:
        palette = picture().quantize(8)
        pixels = read(encoded(palette, transparency=palette.getpixel((10, 100))))
        assert pixels[24, 8].tolist() == list(NEUTRAL)
        np.testing.assert_allclose(pixels[24, 24], (0, 255, 0), atol=3)
        pixels = read(encoded(picture("L"), transparency=255))
        assert pixels[24, 56].tolist() == list(NEUTRAL)
        assert pixels[24, 8].tolist() == [76, 76, 76]
        pixels = read(encoded(picture(), transparency=(0, 255, 0)))
        assert pixels[24, 24].tolist() == list(NEUTRAL)
        assert pixels[24, 8].tolist() == [255, 0, 0]

    @pytest.mark.parametrize(("colour_type", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
    def test_16_bit_tones_are_kept(self, colour_type: int, channels: int) -> None:
        values = np.linspace(0, 65535, 128 * 256 * channels).reshape(128, 256, channels).astype(">u2")
        if channels in (2, 4):
            values[..., -1] = 65535
        rows = b"".join(b"\0" + row.tobytes() for row in values)
        pixels = read(png_file(256, 128, zlib.compress(rows), depth=16, colour_type=colour_type)).astype(float)
        colours = values[..., :3] if channels > 2 else values[..., :1].repeat(3, -1)
        expected = colours.astype(float).reshape(HEIGHT, 4, WIDTH, 4, 3).mean(axis=(1, 3)) / 257.0
        np.testing.assert_allclose(pixels, expected, atol=1.5)

    @pytest.mark.parametrize("mode", ["L", "LA", "1"])
    def test_grey_pictures_are_grey_in_all_channels(self, mode: str) -> None:
        pixels = read(encoded(picture(mode)))
        assert (pixels == pixels[..., :1]).all()
        assert pixels[24, 56].tolist() == [255, 255, 255]

    @pytest.mark.parametrize(("orientation", "turned"), [(1, None), *enumerate(TURNS, start=2)])
    def test_exif_orientation_is_undone(self, orientation: int, turned: str | None) -> None:
        stored = picture() if turned is None else picture().transpose(Image.Transpose[turned])
        exif = Image.Exif()
        exif[0x0112] = orientation
        np.testing.assert_array_equal(read(encoded(stored, exif=exif.tobytes())), read(encoded(picture())))

    @pytest.mark.parametrize(("kind", "mode"), [("PNG", "RGB"), ("PNG", "P"), ("PNG", "RGBA"), ("WEBP", "RGB")])
    def test_scaling_in_bands_gives_the_same_picture(self, kind: str, mode: str) -> None:
        height = 1999
        pixels = read(encoded(picture(mode, height=height).resize((2 * height + 1, height)), kind, **LOSSLESS[kind]))
        small = read(encoded(picture(mode)))
        inner = np.ones(WIDTH, bool)
        inner[::16] = inner[15::16] = False
        for half in (slice(0, 15), slice(17, 32)):
            np.testing.assert_allclose(pixels[half, inner].astype(int), small[half, inner], atol=6)

    def test_first_of_several_pictures_is_read(self) -> None:
        first, second = picture(), Image.new("RGB", (256, 128), (255, 255, 0))
        for kind, options in {"WEBP": {"lossless": True}, "PNG": {}, "MPO": {"quality": 95}}.items():
            content = encoded(first, kind, save_all=True, append_images=[second] * 3, **options)
            np.testing.assert_allclose(read(content).astype(int), read(encoded(first)), atol=8)

    def test_trailing_data_are_ignored(self) -> None:
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as file:
            file.writestr("index.html", "<script>alert(1)</script>")
        content = encoded(picture(), "JPEG", quality=95)
        np.testing.assert_array_equal(read(content + archive.getvalue()), read(content))

    def test_location_metadata_do_not_reach_the_pixels(self) -> None:
        exif = Image.Exif()
        exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 8.0, 1.0), 3: "E", 4: (11.0, 34.0, 2.0)})
        stated = StatedCamera(projection="equirectangular")
        plain, located = (
            vars(open_photograph(encoded(picture(), "JPEG", **metadata), sphere_size=(HEIGHT, WIDTH), stated=stated))
            for metadata in ({}, {"exif": exif})
        )
        np.testing.assert_array_equal(located.pop("sphere"), plain.pop("sphere"))
        assert located == plain

    def test_scaling_averages_instead_of_picking(self) -> None:
        stripes = np.zeros((128, 256, 3), np.uint8)
        stripes[:, ::2] = 200
        np.testing.assert_allclose(read(encoded(Image.fromarray(stripes))), 100, atol=1)

    @pytest.mark.parametrize("width", [511, 512, 513])
    def test_rounded_aspect_ratio_is_accepted(self, width: int) -> None:
        assert read(encoded(Image.new("RGB", (width, 256)))).shape == (HEIGHT, WIDTH, 3)

    def test_limits_use_the_size_before_scaling(self) -> None:
        limits = PhotographLimits(min_height=600)
        assert read(encoded(picture(height=640), "JPEG"), limits).shape == (HEIGHT, WIDTH, 3)


class TestScans:
    @pytest.mark.parametrize(("options", "scans"), [({}, 1), ({"progressive": True}, 10)])
    @pytest.mark.parametrize("restarts", [0, 1])
    def test_scans_match_the_encoder_script(self, options: dict[str, bool], scans: int, restarts: int) -> None:
        content = encoded(NOISE, "JPEG", quality=95, restart_marker_rows=restarts, **options)
        assert count_scans(content, 100) == (scans, False)
        assert count_scans(content, 4)[0] == min(scans, 5)
        # Markers in metadata and after the end do not count.
        thumbnail = Image.Exif()
        thumbnail[0x010E] = "\xff\xda" * 50
        assert count_scans(encoded(NOISE, "JPEG", exif=thumbnail, **options), 100) == (scans, False)
        assert count_scans(content + content[2:], 100) == (scans, False)

    @pytest.mark.parametrize("added", [0, 1, 10])
    def test_scan_count_matches_the_decoder(self, added: int) -> None:
        assert count_scans(of_scans(256, 128, added), 100) == (6 + added, False)
        assert read(of_scans(256, 128, added)).shape == (HEIGHT, WIDTH, 3)

    @pytest.mark.slow
    @pytest.mark.parametrize("unit", [b"\xff\x00", b"\xff\xff", b"\xff\xd0", b"\xff\x01", b"\xff\xe0\0\2", b"\0"])
    def test_scan_count_takes_linear_time(self, unit: bytes) -> None:
        def count(size: int) -> Callable[[], object]:
            content = b"\xff\xd8\xff\xda\0\2" + unit * (size // len(unit))
            return lambda: count_scans(content, 20)

        assert_no_worse_than_linear(count, 2_000_000)

    @given(st.binary(max_size=200))
    def test_any_bytes_have_a_scan_count(self, tail: bytes) -> None:
        assert 0 <= count_scans(b"\xff\xd8" + tail, 5)[0] <= 6


class TestRefused:
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (b"", "empty; if it is still in a cloud"),
            (b"hello", "not a readable"),
            (b"\x89PNG\r\n\x1a\n", "not a readable|damaged"),
            (encoded(picture(), "GIF"), "is a GIF picture, which is not supported; save or export it as JPEG, PNG or"),
            (encoded(picture(), "TIFF"), "is a TIFF picture"),
            (b"\0\0\0\x24ftypheic\0\0\0\0mif1heic", "is a HEIC picture"),
            (b"\0\0\0\x1cftypavif", "is an AVIF picture"),
            (b"\0\0\0\x1cftypisom", "is a video"),
            (b"%PDF-1.7", "is a PDF document"),
            (b"\0\0\0\x1cftypmif1\0\0\0\0" + bytes(60) + b"infe\2\0\0\0\0\1\0\0av01", "is an AVIF picture"),
            (b"\xff\x0a\xfa\x7f", "is a JPEG XL picture, which is not supported"),
            (b"\0\0\0\x0cJXL \r\n\x87\n", "is a JPEG XL picture"),
            (b"\0\0\0\x0cjP  \r\n\x87\n", "is a JPEG 2000 picture"),
            (b"\xff\x4f\xff\x51", "is a JPEG 2000 picture"),
            (b"\xef\xbb\xbf\n<!-- saved -->\n<!DOCTYPE HTML><p>", "is an HTML page.*; download the file itself"),
            (b"version https://git-lfs.github.com/spec/v1\noid sha256:1", "is a Git LFS pointer; run `git lfs pull`"),
            (b"bplist00\xd1", "is a property list, .* in a cloud; download the file itself"),
            (b'<?xml version="1.0"?>\n<!DOCTYPE plist PUBLIC "">', "is a property list"),
            (bytes(70_000), "is a file of zeros, .* in a cloud; download the file itself"),
            (b' {"name": "x", "type" : "FeatureCollection", "features": []}', "is GeoJSON"),
            (encoded(Image.new("RGB", (256, 512))), "256 x 512; .* is twice as wide as high, within 1%$"),
            (encoded(Image.new("RGB", (256, 64))), "twice as wide"),
            (encoded(Image.new("RGB", (126, 63))), "63 pixels high; the minimum is 64"),
        ],
    )
    def test_invalid_sphere_error_names_the_reason(self, content: bytes, reason: str) -> None:
        with pytest.raises(InvalidPhotographError, match=reason):
            read(content)

    @pytest.mark.parametrize("kind", NEARLY)
    @pytest.mark.parametrize("share", [0.02, 0.3, 0.35, 0.7, 0.95])
    def test_truncated_file_is_refused_but_for_a_jpeg_with_most_of_its_rows(self, kind: str, share: float) -> None:
        content = encoded(NOISE, kind, **NEARLY[kind])
        if kind != "JPEG" or share < 0.5:
            words = "that is damaged, or coded in a way" if kind != "JPEG" and share > 0.5 else None
            with pytest.raises(InvalidPhotographError, match=words):
                read(content[: int(share * len(content))])

    def test_rows_before_the_end_of_a_truncated_jpeg_are_used(self) -> None:
        content = encoded(NOISE, "JPEG", quality=95)
        whole = read(content).astype(int)
        for cut in (content[:-1], content[:-2]):
            np.testing.assert_array_equal(read(cut), whole)
        part = read(content[: int(0.7 * len(content))])
        np.testing.assert_array_equal(part[: HEIGHT // 2], whole[: HEIGHT // 2])
        assert (part[-8:] == NEUTRAL).all()

    @pytest.mark.parametrize(("width", "height"), [(20_000, 10_000), (14_200, 7_100), (2**31 - 1, 2**30)])
    def test_decompression_bomb_is_refused_by_header(self, width: int, height: int) -> None:
        # The file has almost no pixels.
        with pytest.raises(InvalidPhotographError, match=r"pixels|damaged"):
            read(png_file(width, height, zlib.compress(b"\0" * 100)))

    def test_jpeg_with_many_scans_is_refused(self) -> None:
        content = of_scans(14_000, 7_000, 400)
        assert len(content) < 700_000
        with pytest.raises(InvalidPhotographError, match=r"JPEG with more than 20 scans, the limit \(max_scans"):
            read(content)
        limits = PhotographLimits(max_scans=8)
        read(of_scans(256, 128, 2), limits)
        with pytest.raises(InvalidPhotographError, match=r"more than 8 scans"):
            read(of_scans(256, 128, 3), limits)

    @pytest.mark.parametrize("kind", [b"VP8X", b"VP8L", b"VP8 "])
    def test_webp_bomb_is_refused_before_allocation(self, kind: bytes) -> None:
        side = 16_383
        heads = {
            b"VP8X": bytes(4) + (side - 1).to_bytes(3, "little") * 2,
            b"VP8L": b"\x2f" + ((side - 1) | (side - 1) << 14).to_bytes(4, "little") + bytes(5),
            b"VP8 ": bytes(3) + b"\x9d\x01\x2a" + side.to_bytes(2, "little") * 2,
        }
        content = b"RIFF" + struct.pack("<I", 100) + b"WEBP" + kind + struct.pack("<I", 88) + heads[kind] + bytes(78)
        with pytest.raises(InvalidPhotographError, match=r"16383 x 16383 = \d+ pixels; the limit is 1000"):
            read(content, PhotographLimits(max_pixels=1000))

    def test_sideways_orientation_is_refused(self) -> None:
        exif = Image.Exif()
        exif[0x0112] = 6
        with pytest.raises(InvalidPhotographError, match="128 x 256"):
            read(encoded(picture(), "JPEG", exif=exif.tobytes()))

    # Pillow warns about damaged metadata.
    @pytest.mark.filterwarnings("ignore::UserWarning")
    @pytest.mark.parametrize("kind", NEARLY)
    @given(data=st.data())
    @settings(max_examples=150)
    def test_altered_bytes_raise_only_sphere_errors(self, kind: str, data: st.DataObject) -> None:
        exif = Image.Exif()
        exif[0x0112], exif[0x010E] = 1, "description"
        content = bytearray(encoded(picture(), kind, exif=exif.tobytes(), **NEARLY[kind]))
        for _ in range(data.draw(st.integers(1, 4))):
            # Headers and metadata are at the front.
            last = data.draw(st.sampled_from([40, 200, len(content)])) - 1
            content[data.draw(st.integers(0, min(last, len(content) - 1)))] = data.draw(st.integers(0, 255))
        try:
            pixels = read(bytes(content))
        except InvalidPhotographError:
            return
        assert pixels.shape == (HEIGHT, WIDTH, 3)
