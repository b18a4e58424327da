"""Reading panoramas: what is accepted, and that nothing but the named error ever comes out."""

from __future__ import annotations

import io
import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.localise.images import PanoramaLimits, read_panorama

HEIGHT, WIDTH = 32, 64
LOSSLESS = {"PNG": {}, "WEBP": {"lossless": True}}
NEARLY = {"JPEG": {"quality": 95}, **LOSSLESS}


def picture(mode: str = "RGB", height: int = 128) -> Image.Image:
    """A red left quarter, a green second, a blue third, a white last; the upper half darker."""
    quarters = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]], np.uint8)
    pixels = np.repeat(quarters, height // 2, axis=0)[None].repeat(height, 0)
    pixels[: height // 2] //= 2
    return Image.fromarray(pixels).convert(mode)


def encoded(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def read(content: bytes, limits: PanoramaLimits | None = None) -> np.ndarray:
    return read_panorama(content, height=HEIGHT, width=WIDTH, limits=limits)


def png_header(width: int, height: int) -> bytes:
    """A PNG that claims a size and has next to no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")


def grey_16_bit(values: np.ndarray) -> bytes:
    return encoded(Image.fromarray(values.astype(np.uint16)))


class TestAccepted:
    @pytest.mark.parametrize("kind", NEARLY)
    def test_every_format_gives_the_same_pixels_in_place(self, kind: str) -> None:
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

    @pytest.mark.parametrize("mode", ["L", "LA", "1"])
    def test_grey_pictures_are_grey_in_all_channels(self, mode: str) -> None:
        pixels = read(encoded(picture(mode)))
        assert (pixels == pixels[..., :1]).all()
        assert pixels[24, 56].tolist() == [255, 255, 255]

    def test_sixteen_bits_keep_their_tones(self) -> None:
        ramp = np.tile(np.linspace(0, 65535, 256).astype(np.uint16), (128, 1))
        pixels = read(grey_16_bit(ramp))
        expected = ramp.reshape(128, WIDTH, 4).mean(axis=2)[0] / 257.0
        np.testing.assert_allclose(pixels[10, :, 0], expected, atol=2.0)

    def test_an_exif_orientation_is_followed(self) -> None:
        exif = Image.Exif()
        exif[0x0112] = 6  # stored turned; the viewer turns it a quarter clockwise
        turned = picture(height=256).transpose(Image.Transpose.ROTATE_90)
        content = encoded(turned, "JPEG", exif=exif.tobytes(), quality=95)
        np.testing.assert_allclose(read(content).astype(int), read(encoded(picture(height=256))), atol=12)

    def test_scaling_averages_instead_of_picking(self) -> None:
        stripes = np.zeros((128, 256, 3), np.uint8)
        stripes[:, ::2] = 200
        np.testing.assert_allclose(read(encoded(Image.fromarray(stripes))), 100, atol=1)

    @pytest.mark.parametrize("width", [511, 512, 513])
    def test_a_stitcher_s_rounding_is_forgiven(self, width: int) -> None:
        assert read(encoded(Image.new("RGB", (width, 256)))).shape == (HEIGHT, WIDTH, 3)

    def test_a_large_jpeg_is_judged_by_its_own_size_not_by_the_scaled_one(self) -> None:
        limits = PanoramaLimits(min_height=600)
        assert read(encoded(picture(height=640), "JPEG"), limits).shape == (HEIGHT, WIDTH, 3)


class TestRefused:
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (b"", "empty"),
            (b"hello", "not a readable"),
            (b"\x89PNG\r\n\x1a\n", "not a readable|damaged"),
            (encoded(picture(), "GIF"), "not a readable"),
            (encoded(picture(), "BMP"), "not a readable"),
            (encoded(picture(), "TIFF"), "not a readable"),
            (encoded(Image.new("RGB", (256, 512))), "twice as wide"),
            (encoded(Image.new("RGB", (256, 256))), "twice as wide"),
            (encoded(Image.new("RGB", (256, 64))), "twice as wide"),
            (encoded(Image.new("RGB", (530, 256))), "twice as wide"),
            (encoded(Image.new("RGB", (126, 63))), "63 pixels high, at least 64"),
            (encoded(Image.new("RGB", (2, 1))), "at least 64"),
        ],
    )
    def test_what_is_no_panorama_is_refused_with_the_reason(self, content: bytes, reason: str) -> None:
        with pytest.raises(InvalidPanoramaError, match=reason):
            read(content)

    @pytest.mark.parametrize("kind", NEARLY)
    @pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95])
    def test_a_truncated_file_is_refused(self, kind: str, share: float) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (128, 256, 3), dtype=np.uint8)
        content = encoded(Image.fromarray(noise), kind, **NEARLY[kind])
        with pytest.raises(InvalidPanoramaError):
            read(content[: int(share * len(content))])

    @pytest.mark.parametrize(("width", "height"), [(20_000, 10_000), (14_200, 7_100), (2**31 - 1, 2**30)])
    def test_a_bomb_is_refused_on_its_header(self, width: int, height: int) -> None:
        begin = time.perf_counter()
        with pytest.raises(InvalidPanoramaError, match=r"pixels|damaged"):
            read(png_header(width, height))
        assert time.perf_counter() - begin < 1.0

    def test_the_limit_on_pixels_is_configurable(self) -> None:
        with pytest.raises(InvalidPanoramaError, match="at most 1000"):
            read(encoded(picture()), PanoramaLimits(max_pixels=1000))

    def test_an_orientation_that_turns_a_panorama_upright_makes_it_a_portrait(self) -> None:
        exif = Image.Exif()
        exif[0x0112] = 6
        with pytest.raises(InvalidPanoramaError, match="128 x 256"):
            read(encoded(picture(), "JPEG", exif=exif.tobytes()))

    # Pillow warns of damaged metadata.
    @pytest.mark.filterwarnings("ignore::UserWarning")
    @pytest.mark.parametrize("kind", NEARLY)
    @given(data=st.data())
    @settings(max_examples=150)
    def test_whatever_bytes_are_altered_only_the_named_error_comes_out(self, kind: str, data: st.DataObject) -> None:
        exif = Image.Exif()
        exif[0x0112], exif[0x010E] = 1, "description"
        content = bytearray(encoded(picture(), kind, exif=exif.tobytes(), **NEARLY[kind]))
        for _ in range(data.draw(st.integers(1, 4))):
            # Headers and metadata stand at the front.
            last = data.draw(st.sampled_from([40, 200, len(content)])) - 1
            content[data.draw(st.integers(0, min(last, len(content) - 1)))] = data.draw(st.integers(0, 255))
        try:
            pixels = read(bytes(content))
        except InvalidPanoramaError:
            return
        assert pixels.shape == (HEIGHT, WIDTH, 3)
