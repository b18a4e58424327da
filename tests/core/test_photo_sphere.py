"""Photo Sphere metadata: placement of parts, levelling, and robustness against bad metadata."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from lalaloc_core.conventions import column_azimuths, row_elevations
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph import open_photograph
from lalaloc_core.photograph.photo_sphere import PhotoSphere, read_photo_sphere
from lalaloc_core.photograph.spheres import NEUTRAL, level, read_sphere
from tests.painted import picture_file

HEIGHT, WIDTH = 64, 128
FULL_HEIGHT, FULL_WIDTH = 512, 1024
NAMESPACE = "http://ns.google.com/photos/1.0/panorama/"


def xmp(**properties: object) -> bytes:
    """Return a packet with GPano properties as attributes."""
    return packet_of(" " + " ".join(f'GPano:{name}="{value}"' for name, value in properties.items()) + ">")


def xmp_of_elements(**properties: object) -> bytes:
    """Return a packet with GPano properties as elements."""
    return packet_of(">" + "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in properties.items()))


def packet_of(description: str) -> bytes:
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:GPano="{NAMESPACE}"{description}</rdf:Description>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def crop(left: int, top: int, width: int, height: int, **others: object) -> dict[str, object]:
    return {
        "FullPanoWidthPixels": FULL_WIDTH,
        "FullPanoHeightPixels": FULL_HEIGHT,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
    } | others


def directions(height: int, width: int) -> np.ndarray:
    """Return each pixel's direction (h, w, 3): right, forward and up of a level camera."""
    azimuth, elevation = np.meshgrid(column_azimuths(width), row_elevations(height))
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
    )


def world(rays: np.ndarray) -> np.ndarray:
    """Return smooth colours, different in every direction."""
    x, y, z = np.moveaxis(rays, -1, 0)
    channels = [x + 0.4 * y * z, y - 0.4 * x * z, z + 0.3 * np.sin(3.0 * x)]
    return np.round(127.5 + 85.0 * np.stack(channels, axis=-1)).astype(np.uint8)


def turn(axis: int, angle: float) -> np.ndarray:
    """Return the right-handed rotation about right (0), forward (1) or up (2)."""
    first, second = [i for i in range(3) if i != axis]
    sign = -1.0 if axis == 1 else 1.0
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = math.cos(angle)
    matrix[first, second], matrix[second, first] = -sign * math.sin(angle), sign * math.sin(angle)
    return matrix


def tilted(height: int, width: int, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Return the picture of a camera that was pitched up, then rolled clockwise about its viewing direction.

    Independent of the code under test: the camera is turned by rotation matrices. Right-handed about `right` lifts the
    viewing direction; right-handed about `forward`, which points away from the photographer, is clockwise to them.
    """
    pose = turn(0, math.radians(pitch_deg)) @ turn(1, math.radians(roll_deg))
    return world(directions(height, width) @ pose.T)


def encoded(pixels: np.ndarray, kind: str = "PNG", packet: bytes | None = None) -> bytes:
    """Encode a picture with an XMP packet."""
    options: dict[str, Any] = {"quality": 98, "subsampling": 0} if kind == "JPEG" else {}
    options |= {"lossless": True} if kind == "WEBP" else {}
    if packet is not None and kind == "PNG":
        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", packet.decode())
        options["pnginfo"] = info
    elif packet is not None:
        options["xmp"] = packet
    return picture_file(pixels, kind, **options)


def opened(content: bytes) -> np.ndarray:
    return read_sphere(content, height=HEIGHT, width=WIDTH)


FULL = world(directions(FULL_HEIGHT, FULL_WIDTH))
LEVEL = world(directions(HEIGHT, WIDTH)).astype(int)


def level_world(left: int, width: int) -> np.ndarray:
    """Return the level sphere whose centre is that of a part of the full sphere, by its columns."""
    turn = math.tau * ((left + 0.5 * width) / FULL_WIDTH - 0.5)
    azimuth, elevation = np.meshgrid(column_azimuths(WIDTH) + turn, row_elevations(HEIGHT))
    across = np.cos(elevation)
    return world(np.stack([across * np.sin(azimuth), across * np.cos(azimuth), np.sin(elevation)], axis=-1)).astype(int)


class TestParts:
    @pytest.mark.parametrize(("kind", "write"), [("JPEG", xmp), ("PNG", xmp_of_elements), ("WEBP", xmp)])
    @pytest.mark.parametrize(
        ("left", "top", "width", "height"),
        [(0, 128, 1024, 256), (256, 0, 512, 512), (128, 64, 640, 320), (131, 67, 637, 315)],
    )
    def test_part_is_placed_on_a_neutral_sphere(
        self, kind: str, write: Callable[..., bytes], left: int, top: int, width: int, height: int
    ) -> None:
        packet = write(**crop(left, top, width, height))
        pixels = opened(encoded(FULL[top : top + height, left : left + width], kind, packet)).astype(int)
        scale, shown = FULL_WIDTH // WIDTH, level_world(left, width)
        # The picture's centre is the sphere's.
        left = (FULL_WIDTH - width) // 2
        inner = (
            slice(-(-top // scale) + 1, (top + height) // scale - 1),
            slice(-(-left // scale) + 1, (left + width) // scale - 1),
        )
        np.testing.assert_allclose(pixels[inner], shown[inner], atol=5)
        outside = np.ones((HEIGHT, WIDTH), bool)
        outside[top // scale : -(-(top + height) // scale), left // scale : -(-(left + width) // scale)] = False
        assert (pixels[outside] == NEUTRAL).all()
        assert outside.any()

    def test_scaled_part_keeps_its_place(self) -> None:
        packet = xmp(**crop(128, 64, 640, 320))
        small = np.asarray(Image.fromarray(FULL[64:384, 128:768]).resize((320, 160), Image.Resampling.BOX))
        pixels = opened(encoded(small, "PNG", packet)).astype(int)
        np.testing.assert_allclose(pixels[10:46, 26:102], level_world(128, 640)[10:46, 26:102], atol=5)

    def test_explicit_full_sphere_and_level_pose_change_nothing(self) -> None:
        explicit = opened(encoded(FULL, "PNG", xmp(**crop(0, 0, 1024, 512))))
        np.testing.assert_array_equal(explicit, opened(encoded(FULL)))
        np.testing.assert_array_equal(level(FULL, pitch=0.0, roll=0.0), FULL)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"CroppedAreaLeftPixels": 500}, "is not within the full sphere of 1024 x 512"),
            ({"CroppedAreaTopPixels": -1}, "CroppedAreaTopPixels is '-1'; it must be between 0 and"),
            ({"CroppedAreaImageHeightPixels": 400}, "the part is 640 x 400, but the picture is 640 x 256"),
            ({"FullPanoHeightPixels": 400}, "not twice as wide as high"),
            ({"FullPanoWidthPixels": "1e300"}, "FullPanoWidthPixels is '1e300'"),
            ({"FullPanoWidthPixels": "nan"}, "FullPanoWidthPixels is 'nan'"),
            ({"FullPanoWidthPixels": ""}, "FullPanoWidthPixels is ''"),
            ({"CroppedAreaImageWidthPixels": 0}, "a width or height is 0"),
        ],
    )
    def test_contradictory_part_is_refused(self, changes: dict[str, object], reason: str) -> None:
        packet = xmp(**(crop(128, 64, 640, 320) | changes))
        np.testing.assert_array_equal(
            opened(encoded(FULL[:320, :640], "PNG", packet)), opened(encoded(FULL[:320, :640]))
        )
        flat = encoded(FULL[:256, :640], "PNG", xmp(**(crop(128, 64, 640, 256) | changes)))
        with pytest.raises(InvalidPhotographError, match=f"640 x 256; .* twice as wide as high, .*: .*{reason}"):
            opened(flat)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"FullPanoWidthPixels": 10240, "FullPanoHeightPixels": 5120}, "0.4% of the sphere; the minimum is 10%"),
            ({"ProjectionType": "cylindrical"}, "'cylindrical'; only 'equirectangular'"),
        ],
    )
    def test_unusable_projection_or_part_is_refused(self, changes: dict[str, object], reason: str) -> None:
        packet = xmp(**(crop(128, 64, 640, 320) | changes))
        with pytest.raises(InvalidPhotographError, match=reason):
            opened(encoded(FULL[:320, :640], "PNG", packet))


class TestLevelling:
    @pytest.mark.parametrize(
        ("pitch_deg", "roll_deg"),
        [(0, 10), (0, -10), (15, 0), (-15, 0), (20, 30), (-40, 115), (0, 180), (90, 0), (-90, 45), (0.5, -0.5)],
    )
    def test_tilted_camera_is_levelled(self, pitch_deg: float, roll_deg: float) -> None:
        packet = xmp(PosePitchDegrees=pitch_deg, PoseRollDegrees=roll_deg)
        content = encoded(tilted(FULL_HEIGHT, FULL_WIDTH, pitch_deg, roll_deg), "PNG", packet)
        np.testing.assert_allclose(opened(content).astype(int), LEVEL, atol=5)

    @pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(30, 0), (0, 20)])
    def test_pitch_and_roll_signs_follow_the_specification(self, pitch_deg: float, roll_deg: float) -> None:
        """White sky and black ground show the direction of the rotation."""
        pose = turn(0, math.radians(pitch_deg)) @ turn(1, math.radians(roll_deg))
        rays = directions(FULL_HEIGHT, FULL_WIDTH) @ pose.T
        tilted = np.where(rays[..., 2:] < 0.0, 0, 255).astype(np.uint8).repeat(3, -1)
        row, column = FULL_HEIGHT // 2, FULL_WIDTH // 2
        if pitch_deg > 0.0:
            below = row + round(pitch_deg / 180.0 * FULL_HEIGHT)
            assert tilted[below - 3, column, 0] == 255, "pitch is degrees above the horizon for the centre"
            assert tilted[below + 3, column, 0] == 0
        else:
            assert tilted[row - 20, column + FULL_WIDTH // 8, 0] == 0, (
                "positive roll turns the horizon counterclockwise"
            )
            assert tilted[row - 20, column - FULL_WIDTH // 8, 0] == 255
        levelled = level(tilted, pitch=math.radians(pitch_deg), roll=math.radians(roll_deg))
        assert (levelled[: row - 4] == 255).all()
        assert (levelled[row + 4 :] == 0).all()

    @given(pitch=st.floats(-math.pi / 2, math.pi / 2), roll=st.floats(-math.pi, math.pi))
    @settings(max_examples=25)
    def test_levelling_works_at_seam_and_poles(self, pitch: float, roll: float) -> None:
        picture = tilted(256, 512, math.degrees(pitch), math.degrees(roll))
        expected = world(directions(256, 512)).astype(int)
        np.testing.assert_allclose(level(picture, pitch=pitch, roll=roll).astype(int), expected, atol=4)

    def test_tilted_part_is_placed_first(self) -> None:
        whole = tilted(FULL_HEIGHT, FULL_WIDTH, 10, 5)
        packet = xmp(**crop(0, 64, 1024, 384, PosePitchDegrees=10, PoseRollDegrees=5))
        pixels = opened(encoded(whole[64:448], "PNG", packet)).astype(int)
        np.testing.assert_allclose(pixels[20:44], LEVEL[20:44], atol=5)


class TestMetadata:
    def test_compass_heading_is_returned(self) -> None:
        content = encoded(FULL, "JPEG", xmp(PoseHeadingDegrees=123.5))
        heading = open_photograph(content, sphere_size=(HEIGHT, WIDTH)).compass_heading
        assert heading == pytest.approx(math.radians(123.5))
        assert open_photograph(encoded(FULL), sphere_size=(HEIGHT, WIDTH)).compass_heading is None

    def test_initial_view_is_ignored(self) -> None:
        packet = xmp(InitialViewHeadingDegrees=90, InitialViewPitchDegrees=20, InitialViewRollDegrees=20)
        assert read_photo_sphere([packet], width=1024, height=512) == PhotoSphere()

    @pytest.mark.parametrize(
        "properties",
        [
            {"PosePitchDegrees": 91, "PoseRollDegrees": 541, "PoseHeadingDegrees": 720.5},
            {"PosePitchDegrees": "inf", "PoseRollDegrees": "-nan", "PoseHeadingDegrees": 1e300},
            {"PosePitchDegrees": "up", "PoseRollDegrees": "1,2,3", "PoseHeadingDegrees": "north"},
        ],
    )
    def test_angles_out_of_range_are_ignored_with_a_warning(self, properties: dict[str, object]) -> None:
        found = read_photo_sphere([xmp(**properties)], width=1024, height=512)
        assert (found.pitch, found.roll, found.compass_heading) == (0.0, 0.0, None)
        assert [text.split(";")[0] for text in found.warnings] == [
            f"GPano {name} is '{value}'" for name, value in properties.items()
        ]

    def test_angles_are_reduced_to_half_a_turn(self) -> None:
        packet = xmp(PosePitchDegrees=340, PoseRollDegrees="348,5", PoseHeadingDegrees=-90)
        found = read_photo_sphere([packet], width=1024, height=512)
        assert found.warnings == ()
        assert np.degrees([found.pitch, found.roll]) == pytest.approx([-20.0, -11.5])
        assert found.compass_heading == pytest.approx(math.radians(270.0))

    @pytest.mark.parametrize(
        "packet", [b"", b"<x", b"\0\0\0", b"\xff\xfe<", b'<?xml version="1.0" encoding="nonsense"?>']
    )
    def test_unreadable_packet_is_ignored(self, packet: bytes) -> None:
        assert read_photo_sphere([packet], width=1024, height=512) == PhotoSphere()
        np.testing.assert_array_equal(opened(encoded(FULL, "WEBP", packet)), opened(encoded(FULL)))

    @pytest.mark.parametrize(
        "packet",
        [
            xmp(PosePitchDegrees=45).replace(b"</rdf:Description>", b""),
            xmp(PosePitchDegrees=45).replace(f'xmlns:GPano="{NAMESPACE}"'.encode(), b""),
            xmp_of_elements(PosePitchDegrees=45).replace(f'xmlns:GPano="{NAMESPACE}"'.encode(), b""),
            xmp(PosePitchDegrees=45).replace(NAMESPACE.encode(), NAMESPACE[:-1].encode()),
            b"<!-- " + b"x" * 300_000 + b" -->" + xmp(PosePitchDegrees=45),
        ],
        ids=["not closed", "undeclared prefix", "undeclared elements", "other namespace", "large"],
    )
    def test_properties_of_malformed_packets_are_read(self, packet: bytes) -> None:
        assert read_photo_sphere([packet], width=1024, height=512).pitch == pytest.approx(math.radians(45.0))

    def test_text_that_is_named_xmp_is_no_packet(self) -> None:
        info = PngInfo()
        info.add_text("xmp", xmp(PosePitchDegrees=45).decode())
        np.testing.assert_array_equal(opened(picture_file(FULL, pnginfo=info)), opened(encoded(FULL)))

    def test_first_packet_with_a_property_counts(self) -> None:
        packets = [xmp(PosePitchDegrees=10), xmp(), xmp(PosePitchDegrees=20, PoseRollDegrees=5)]
        found = read_photo_sphere(packets, width=1024, height=512)
        assert np.degrees([found.pitch, found.roll]) == pytest.approx([10.0, 5.0])
        assert found.warnings == ("GPano PosePitchDegrees is stated as '10' and as '20'; the first is used",)

    def test_entities_and_deep_elements_are_harmless(self, tmp_path: Path) -> None:
        levels = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
        bomb = f'<!DOCTYPE x [<!ENTITY e0 "{"x" * 100}">{levels}]>'.encode() + xmp(PosePitchDegrees="&e9;")
        assert read_photo_sphere([bomb], width=1024, height=512) == PhotoSphere()
        (tmp_path / "pitch").write_text("45", encoding="ascii")
        packet = f'<!DOCTYPE x [<!ENTITY e SYSTEM "{(tmp_path / "pitch").as_uri()}">]>'.encode()
        assert read_photo_sphere([packet + xmp(PosePitchDegrees="&e;")], width=1024, height=512) == PhotoSphere()
        deep = b"<a>" * 30_000 + b"</a>" * 30_000
        assert read_photo_sphere([deep], width=1024, height=512) == PhotoSphere()

    @given(packet=st.binary(max_size=200), cut=st.integers(0, 600))
    @settings(max_examples=100)
    def test_no_packet_raises(self, packet: bytes, cut: int) -> None:
        whole = xmp(**crop(128, 64, 640, 320, PosePitchDegrees=3))
        read_photo_sphere([whole[:cut] + packet + whole[cut:]], width=640, height=320)
