"""Films of a turn: formats, frames that are kept, faults, limits, and files that name other files."""

from __future__ import annotations

import math
import os
import socket
import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidFilmError
from lalaloc_core.photograph import StatedCamera
from lalaloc_core.photograph.film import Film, FilmLimits, read_film
from lalaloc_core.photograph.film_motion import FlowTracker
from tests.core.filmed import H264, HEVC, RATE, STEP_DEG, VP9, encode, needs_ffmpeg, run, turn

pytestmark = needs_ffmpeg
FIELD = StatedCamera(hfov_deg=53.0)
CODECS = {"turn.mov": HEVC, "turn.webm": VP9, "turn.mkv": VP9, "h264.mkv": H264, "part2.mp4": ("-c:v", "mpeg4")}


@pytest.fixture(scope="module")
def h264(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return encode(turn(), tmp_path_factory.mktemp("film") / "turn.mp4")


def misses_deg(film: Film) -> np.ndarray:
    """Return the errors of the headings of a film that turns at a constant speed."""
    true = np.radians(STEP_DEG * RATE * np.array(film.times_s))
    missed = wrap_angle(np.array([angle.heading for angle in film.angles]) - true)
    return np.degrees(np.abs(wrap_angle(missed - np.median(missed))))


def check_turn(film: Film) -> None:
    assert misses_deg(film).max() < 1.5
    assert math.degrees(film.turned) == pytest.approx(360.0, abs=25.0)
    assert film.frames == 61
    assert len(film.photographs) + sum(film.dropped.values()) == film.frames
    assert 20 <= len(film.photographs) <= 32
    assert list(film.times_s) == sorted(film.times_s)
    assert film.warnings == ()


@pytest.mark.parametrize("name", CODECS)
def test_film_of_any_codec_gives_angles(tmp_path: Path, name: str) -> None:
    check_turn(read_film(encode(turn(), tmp_path / name, *CODECS[name]), stated=FIELD))


@pytest.mark.slow
def test_unknown_field_of_view_is_found(h264: bytes) -> None:
    film = read_film(h264)
    check_turn(film)
    hfov = film.photographs[0].hfov
    assert hfov.source == "estimated"
    assert math.degrees(hfov.value) == pytest.approx(53.0, abs=2.0)


def test_film_is_upright_by_its_metadata(tmp_path: Path) -> None:
    encode([np.rot90(frame, -1).copy() for frame in turn()[:20]], tmp_path / "a.mp4")
    run("-i", str(tmp_path / "a.mp4"), "-c", "copy", "-metadata:s:v", "rotate=90", str(tmp_path / "b.mp4"))
    film = read_film((tmp_path / "b.mp4").read_bytes(), stated=FIELD)
    camera = film.photographs[0].camera
    assert camera is not None
    assert (camera.width, camera.height) == (270, 480)
    assert misses_deg(film).max() < 1.5


@pytest.mark.slow
def test_times_are_those_of_the_frames(h264: bytes, tmp_path: Path) -> None:
    source, target = tmp_path / "turn.mp4", tmp_path / "late.mp4"
    source.write_bytes(h264)
    run("-i", str(source), "-vf", "setpts=PTS+gt(N\\,30)*2/TB", "-vsync", "vfr", "-c:v", "libx264", str(target))
    film = read_film(target.read_bytes(), stated=FIELD)
    assert film.duration_s == pytest.approx(8.0, abs=0.1)
    assert not [time_s for time_s in film.times_s if 3.1 < time_s < 4.9]


@pytest.mark.slow
def test_frames_at_the_rate_of_samples_are_all_used(tmp_path: Path) -> None:
    source, target = tmp_path / "turn.mp4", tmp_path / "turn.webm"
    encode(turn()[:30], source)
    # Times in WebM are whole milliseconds.
    run("-r", "12", "-i", str(source), *VP9, str(target))
    film = read_film(target.read_bytes(), stated=FIELD)
    assert film.frames == 30
    assert "between samples" not in film.dropped


@pytest.mark.slow
def test_plain_wall_is_passed_at_the_usual_speed(tmp_path: Path) -> None:
    blank = np.full_like(turn()[0], 128)
    frames = [*turn()[:31], *[blank] * 12, *turn()[43:61]]
    film = read_film(encode(frames, tmp_path / "wall.mp4"), stated=FIELD)
    assumed = [time_s for time_s, angle in zip(film.times_s, film.angles, strict=True) if angle.is_assumed]
    assert len(assumed) >= 3
    assert min(assumed) >= 3.1
    assert max(assumed) < 4.3
    # The two sides of the wall overlap where the turn closes.
    assert misses_deg(film).max() < 4.0
    assert max(angle.heading_sd for angle in film.angles) < math.radians(12.0)
    assert any(f"nothing links {len(assumed)} of the" in warning for warning in film.warnings)


@pytest.mark.slow
def test_blank_frames_at_unknown_angles_are_left_out(tmp_path: Path) -> None:
    blank = np.full_like(turn()[0], 128)
    film = read_film(encode([*turn()[:36], *[blank] * 25], tmp_path / "wall.mp4"), stated=FIELD)
    assert film.dropped["blank, at an unknown angle"] >= 2
    assert len(film.photographs) + sum(film.dropped.values()) == film.frames
    assert max(angle.heading_sd for angle in film.angles) < math.radians(12.0)


def test_upright_edges_of_plain_walls_are_followed() -> None:
    def wall(edge: int) -> np.ndarray:
        """Return a corner of two plain walls, as a blurred edge without a corner point."""
        grey = np.full((400, 300), 120, np.uint8)
        grey[:, edge:] = 150
        return cv2.GaussianBlur(grey, (0, 0), 3.0)

    tracker, step = FlowTracker(math.radians(53.0)), 20
    for index in range(6):
        tracker.follow(wall(220 - step * index))
    heading, error = tracker.reckoned()
    per_step = math.atan(step / (150.0 / math.tan(math.radians(26.5))))
    assert heading == pytest.approx(per_step * np.arange(6), abs=math.radians(0.5))
    assert error[-1] > 0.0
    assert tracker.lost_share == 0.0
    # Nothing to follow: the turn goes on at the usual speed, with more doubt.
    for _ in range(3):
        tracker.follow(np.full((400, 300), 150, np.uint8))
    later, doubt = tracker.reckoned()
    assert later[-1] == pytest.approx(8.0 * per_step, abs=math.radians(1.0))
    assert doubt[-1] - error[-1] > 0.9 * per_step
    assert tracker.lost_share == pytest.approx(3.0 / 8.0)


def zoomed(index: int) -> np.ndarray:
    frame, share = turn()[0], 1.0 - 0.012 * index
    height, width = (round(share * side) for side in frame.shape[:2])
    top, left = (frame.shape[0] - height) // 2, (frame.shape[1] - width) // 2
    return cv2.resize(frame[top : top + height, left : left + width], frame.shape[1::-1])


def test_camera_that_stands_still_lies_on_its_side_or_walks_is_named(tmp_path: Path) -> None:
    still = read_film(encode([turn()[0]] * 20, tmp_path / "still.mp4"), stated=FIELD)
    assert len(still.photographs) == 1
    assert "the camera turns by 0° only" in still.warnings[0]
    lying = read_film(encode([np.rot90(frame).copy() for frame in turn()[:16]], tmp_path / "side.mp4"), stated=FIELD)
    assert "the film may lie on its side: in it the camera nods by" in lying.warnings[0]
    walk = read_film(encode([zoomed(index) for index in range(50)], tmp_path / "walk.mp4"), stated=FIELD)
    assert any("the camera walks" in warning for warning in walk.warnings)


@pytest.mark.slow
def test_camera_that_shakes_is_named(tmp_path: Path) -> None:
    shaken = [np.roll(frame, 40 * (index % 2), axis=0) for index, frame in enumerate(turn())]
    film = read_film(encode(shaken, tmp_path / "shaken.mp4"), stated=FIELD)
    assert any("the camera shakes" in warning for warning in film.warnings)


def test_dark_frames_are_dropped_and_dark_sides_of_one_are_no_bars(tmp_path: Path) -> None:
    frames = [frame.copy() for frame in turn()[:10]]
    frames[0][:, :45] = frames[0][:, -45:] = 0
    film = read_film(encode([*frames, *[np.zeros_like(turn()[0])] * 5], tmp_path / "dark.mp4"), stated=FIELD)
    assert film.dropped["dark"] == 5
    assert not any("bars" in warning for warning in film.warnings)
    with pytest.raises(InvalidFilmError, match="all frames of the film are dark"):
        read_film(encode([frame // 32 for frame in turn()[:5]], tmp_path / "black.mp4"))


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"max_bytes": 1000}, "the limit is 1000 \\(LALALOC_MAX_FILM_BYTES\\)"),
        ({"max_s": 2.0}, "longer than 2 s, the limit \\(max_film_s\\)"),
        ({"max_pixels": 1000}, "270 x 480 = 129600 pixels; the limit is 1000 \\(max_film_pixels\\)"),
        ({"max_cpu_s": 1e-4}, "more than 0.0001 s of CPU time .* \\(max_film_cpu_s\\)"),
    ],
)
def test_limits_are_named(h264: bytes, limits: dict[str, float], reason: str) -> None:
    with pytest.raises(InvalidFilmError, match=reason):
        read_film(h264, limits=replace(FilmLimits(), **limits))


def test_broken_and_soundless_files_and_spheres_are_refused(h264: bytes, tmp_path: Path) -> None:
    sound, jpegs = tmp_path / "sound.mp4", tmp_path / "jpegs.mp4"
    run("-f", "lavfi", "-i", "sine=duration=1", "-c:a", "aac", str(sound))
    encode(turn()[:5], jpegs, "-c:v", "mjpeg")
    for content, reason in (
        (b"", "by its first bytes"),
        (b"\xff\xd8\xff picture", "by its first bytes"),
        (h264[:2000], "cut off, damaged or sound only"),
        (sound.read_bytes(), "cut off, damaged or sound only|no frame of the film"),
        (jpegs.read_bytes(), "codec is .*; it must be one of H.264, HEVC, MPEG-4, VP8, VP9"),
    ):
        with pytest.raises(InvalidFilmError, match=reason):
            read_film(content)
    with pytest.raises(InvalidFilmError, match="films of full spheres are not read"):
        read_film(h264, stated=StatedCamera(projection="equirectangular"))


@pytest.mark.slow
def test_damaged_frames_end_no_process(tmp_path: Path) -> None:
    rng, film = np.random.default_rng(0), encode(turn()[:12], tmp_path / "turn.mp4")
    for _ in range(8):
        content = bytearray(film)
        for place in rng.integers(40, len(content), 40):
            content[place] = int(rng.integers(256))
        try:
            read_film(bytes(content), stated=FIELD, limits=FilmLimits(max_cpu_s=5.0))
        except InvalidFilmError:
            continue


def with_reference(content: bytes, path: Path) -> bytes:
    """Return an MP4 file whose pictures are said to be in another file, by an alias as QuickTime writes it."""
    where = content.index(b"dref") - 4
    (size,) = struct.unpack_from(">I", content, where)
    name = str(path).encode()
    # Version and flags; alias record up to its levels; records of the absolute path and the end.
    alias = (
        bytes(4) + bytes(10) + bytes([0]) + bytes(27) + bytes(12) + bytes([len(name[:63])]) + name[:63].ljust(63, b"\0")
    )
    alias += bytes(16) + struct.pack(">HH", 0, 0) + bytes(16) + struct.pack(">HH", 2, len(name)) + name
    alias += bytes(len(name) % 2) + struct.pack(">HH", 0xFFFF, 0)
    entry = struct.pack(">I4s", 8 + len(alias), b"alis") + alias
    box = struct.pack(">I4sII", 16 + len(entry), b"dref", 0, 1) + entry
    changed = bytearray(content[:where] + box + content[where + size :])
    for outer in (b"moov", b"trak", b"mdia", b"minf", b"dinf"):
        at = content.index(outer) - 4
        (length,) = struct.unpack_from(">I", content, at)
        struct.pack_into(">I", changed, at, length + len(box) - size)
    return bytes(changed)


def playlists(path: Path, port: int) -> dict[str, bytes]:
    address = f"http://127.0.0.1:{port}/film.ts"
    return {
        "ffconcat": f"ffconcat version 1.0\nfile '{path}'\nfile '{address}'\n".encode(),
        "hls": f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{path}\n#EXTINF:5,\n{address}\n".encode(),
        "hls after a box": struct.pack(">I4s", 16, b"ftyp")
        + b"isom\0\0\0\0"
        + f"#EXTM3U\n{path}\n{address}\n".encode(),
        "dash": f'<?xml version="1.0"?><MPD><BaseURL>{address}</BaseURL></MPD>'.encode(),
        "sdp": f"v=0\nc=IN IP4 127.0.0.1\nm=video {port} RTP/AVP 96\n".encode(),
    }


@pytest.mark.parametrize("kind", ["ffconcat", "hls", "hls after a box", "dash", "sdp", "dref"])
def test_files_that_name_others_open_none(h264: bytes, tmp_path: Path, kind: str) -> None:
    # A reader of the pipe would wait for a writer; connections would be in the socket's backlog.
    pipe = tmp_path / "other.mp4"
    os.mkfifo(pipe)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        port = server.getsockname()[1]
        content = with_reference(h264, pipe) if kind == "dref" else playlists(pipe, port)[kind]
        with suppress(InvalidFilmError):
            read_film(content, stated=FIELD)
        with pytest.raises(TimeoutError):
            server.accept()
    with pytest.raises(OSError, match="No such device or address"):
        os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
