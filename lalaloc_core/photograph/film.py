"""Films of a turn on one spot: sharp frames at equal angles, with the angles between them.

FFmpeg, in OpenCV, reads the film from memory with the demuxer that its first bytes call for, and no protocol: playlists
and references to other files open nothing. Optical flow between samples tells how far the camera has turned, so that of
each angle the sharpest frame is kept; overlap tells the angles between these (`turn_angles.py`).
"""

from __future__ import annotations

import io
import math
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import process_time

import cv2
import numpy as np
from jaxtyping import UInt8

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import InvalidFilmError
from lalaloc_core.file_kinds import VIDEO, describe_file
from lalaloc_core.photograph.exif import ExifLens, fisheye_of
from lalaloc_core.photograph.film_motion import FlowTracker
from lalaloc_core.photograph.overlap import LIKELY_SD, Step, shrunk
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.photo_sphere import PhotoSphere
from lalaloc_core.photograph.photograph import Photograph, photograph_of_picture
from lalaloc_core.photograph.projection import find_lens, is_twice_as_wide
from lalaloc_core.photograph.sphere_formats import THUMBNAIL_SIDE, Thumbnail, find_sphere_format, inside_bars
from lalaloc_core.photograph.stated_camera import AUTO, StatedCamera
from lalaloc_core.photograph.turn_angles import TurnAngles, angles_of_turn
from lalaloc_core.photograph.turned import turn_views, turned_photographs

# Demuxers of FFmpeg by the kind of file; a kind is told by its first bytes.
_DEMUXERS = {"MP4 or MOV": "mov", "WebM or Matroska": "matroska"}
_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
_EBML, _DOC_TYPES, _HEAD = b"\x1a\x45\xdf\xa3", (b"webm", b"matroska"), 64
_CODECS = {b"h264": "H.264", b"avc1": "H.264", b"hevc": "HEVC", b"hvc1": "HEVC", b"hev1": "HEVC", b"VP90": "VP9"}
_CODECS |= {b"vp09": "VP9", b"VP80": "VP8", b"VP8 ": "VP8", b"FMP4": "MPEG-4", b"mp4v": "MPEG-4"}
# Telemetry of GoPro's films, whose usual mode is a fisheye.
_ACTION = b"GoPro MET"
_SPHERES = "films of full spheres are not read: send a frame as a photograph, which shows as much"
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# All rows and columns.
_WHOLE = slice(None), slice(None)
# Samples per second, and of a whole film.
_RATE, _SAMPLES = 12.0, 240
# Times of frames in files are rounded by so much.
_TIME_ROUNDED_S = 0.002
# Longer side (pixels) of kept frames.
_LONG_SIDE = 960
# Share of the duration that a film states, less 1 s, that it has at least unless it is cut off.
_WHOLE_SHARE = 0.9
# Mean grey level of frames that are too dark.
_DARK = 12.0
# Standard deviation (radians) of turns by optical flow, besides what the tracker tells.
_FLOW_SD = math.radians(3.0)
# Largest turn (radians, by optical flow, which can be wrong by a third) whose frames are kept.
_MOST_TURN = 1.5 * TWO_PI
# Turn (radians) that a film shows at least, a nod that nobody makes, and how much larger it is if a film is sideways.
_LEAST_TURN, _MOST_NOD, _SIDEWAYS = math.radians(30.0), math.radians(100.0), 3.0
# Bars: their least share of the picture, pixels and ratio of the sides of what is between them, and samples from one to
# the next that they are looked for in, first in so many.
_LEAST_BARS, _LEAST_SIDE, _LONGEST, _LOOKED_AT, _FIRST_LOOKS = 0.08, 100, 3.0, 8, 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """Frames of a turn that were kept of a film."""

    photographs: tuple[Photograph, ...]
    times_s: tuple[float, ...]
    angles: tuple[TurnAngles, ...]
    frames: int
    dropped: Mapping[str, int]
    duration_s: float
    turned: float
    warnings: tuple[str, ...] = ()


@dataclass(eq=False)
class _Sample:
    """A frame that can be kept: its time, number, angle by optical flow, sharpness and picture."""

    time_s: float
    number: int
    heading: float
    sharpness: float
    picture: UInt8[np.ndarray, "h w 3"]


@dataclass(eq=False)
class _Samples:
    """Sharpest frames by angle, the part of them within bars (rows, columns), and what became of the others."""

    stored_size: tuple[int, int] = (0, 0)
    inside: tuple[slice, slice] = _WHOLE
    looks: list[UInt8[np.ndarray, "h w 3"]] = field(default_factory=list)
    is_barred: bool = False
    first: UInt8[np.ndarray, "h w 3"] | None = None
    changes: bool = False
    best: dict[int, _Sample] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)
    frames: int = 0
    last_s: float = 0.0
    claimed_s: float = 0.0

    @property
    def full_size(self) -> tuple[int, int]:
        """Width and height of the part of frames within the bars."""
        rows, columns = self.inside
        return len(range(self.stored_size[0])[columns]), len(range(self.stored_size[1])[rows])

    def add(self, sample: _Sample, step: float) -> None:
        """Keep a sample if it is the sharpest of its angle."""
        place = round(sample.heading / step)
        rival = self.best.get(place)
        if rival is None and len(self.best) >= _MOST_TURN / step:
            self.dropped["after more than a turn"] += 1
            return
        if rival is None or sample.sharpness > rival.sharpness:
            self.best[place] = sample
        if rival is not None:
            self.dropped["less sharp than another of this angle"] += 1


def read_film(
    content: bytes,
    *,
    stated: StatedCamera | None = None,
    patch_size: PatchSize | None = None,
    limits: FilmLimits | None = None,
) -> Film:
    """Read a film of a turn on one spot: MP4, MOV, WebM or Matroska with H.264, HEVC, MPEG-4, VP8 or VP9.

    Raises:
        InvalidFilmError: the file is not such a film, is damaged, exceeds a limit, or shows nothing.
    """
    stated, limits, size = stated or StatedCamera(), limits or FilmLimits(), patch_size or PatchSize()
    stated.check()
    if len(content) > limits.max_bytes:
        raise InvalidFilmError(
            f"the film has {len(content)} bytes; the limit is {limits.max_bytes} (LALALOC_MAX_FILM_BYTES)"
        )
    is_known = stated.projection != AUTO or stated.hfov_deg is not None or stated.intrinsics is not None
    hfov = None if stated.hfov_deg is None else math.radians(stated.hfov_deg)
    if not is_known and _ACTION in content:
        hfov, stated = fisheye_of("GoPro"), replace(stated, projection="fisheye")
    elif stated.projection == AUTO:
        stated = replace(stated, projection="perspective")
    tracker, samples, begin = FlowTracker(hfov), _Samples(), process_time()
    _sample_film(content, tracker, samples, limits, begin)
    if not is_known:
        _refuse_spheres(samples)
    inside = _inside_bars(samples)
    if inside != _WHOLE:
        tracker, samples = FlowTracker(hfov), _Samples(inside=inside)
        _sample_film(content, tracker, samples, limits, begin)
    kept = sorted(samples.best.values(), key=lambda sample: sample.time_s)
    if not kept:
        raise InvalidFilmError("all frames of the film are dark or blank: film in a lit room")
    if tracker.nodded > max(_MOST_NOD, _SIDEWAYS * tracker.turned):
        raise InvalidFilmError(_on_side(tracker, "lies on its side"))
    photographs, angles = _turned(kept, samples.full_size, stated, size, tracker, limits.threads)
    joined = _likely(angles)
    first = angles[joined[0]].heading
    if len(joined) < len(kept):
        samples.dropped["blank, at an unknown angle"] += len(kept) - len(joined)
    return Film(
        photographs=tuple(photographs[index] for index in joined),
        times_s=tuple(kept[index].time_s for index in joined),
        angles=tuple(
            replace(angles[index], heading=float(wrap_angle(angles[index].heading - first))) for index in joined
        ),
        frames=samples.frames,
        dropped=dict(samples.dropped),
        duration_s=samples.last_s,
        turned=tracker.turned,
        warnings=(*_warnings(samples, tracker), *_assumed([angles[index] for index in joined])),
    )


def _turned(
    kept: Sequence[_Sample],
    full_size: tuple[int, int],
    stated: StatedCamera,
    size: PatchSize,
    tracker: FlowTracker,
    threads: int,
) -> tuple[list[Photograph], list[TurnAngles]]:
    """Return the photographs of frames with the tilt and field of view that their overlap tells, and their angles."""
    exif = ExifLens(fisheye=fisheye_of("GoPro"), camera="GoPro")
    lens = find_lens(*full_size, stated=stated, sphere=PhotoSphere(), exif=exif, looks_spherical=lambda: False)
    if lens.is_sphere:
        raise InvalidFilmError(_SPHERES)
    with ThreadPoolExecutor(threads) as pool:
        jobs = [pool.submit(photograph_of_picture, its.picture, full_size, lens, stated, size, "film") for its in kept]
        photographs = [job.result() for job in jobs]
    views = turn_views(photographs)
    tracker.calibrate(views[0].camera.hfov, full_size)
    heading, error = (values[[sample.number for sample in kept]] for values in tracker.reckoned())
    steps = [
        Step(float(turn), math.hypot(_FLOW_SD, float(sd)))
        for turn, sd in zip(np.diff(heading), np.diff(error), strict=True)
    ]
    angles = angles_of_turn(views, steps)
    photographs = turned_photographs(photographs, views, angles, size)
    tracker.calibrate(photographs[0].hfov.value, full_size)
    return photographs, angles


def _refuse_spheres(samples: _Samples) -> None:
    """Refuse a film most of whose first looks show a full sphere, in any format, or a grid of pictures."""
    thumbnails = [Thumbnail(look) for look in samples.looks[:_FIRST_LOOKS]]
    found = map(find_sphere_format, thumbnails)
    refused = [each.text.replace("photograph", "film") for each in found if each is not None and each.box is None]
    if is_twice_as_wide(*samples.stored_size):
        refused += [_SPHERES for thumbnail in thumbnails if thumbnail.looks_spherical]
    if 2 * len(refused) > len(thumbnails):
        raise InvalidFilmError(refused[0])


def _likely(angles: Sequence[TurnAngles]) -> list[int]:
    """Return the numbers of the frames to keep: if most angles are likely, the others, of blank walls, are left out."""
    likely = [index for index, angle in enumerate(angles) if angle.heading_sd <= LIKELY_SD]
    return likely if 2 * len(likely) > len(angles) else list(range(len(angles)))


def _assumed(angles: Sequence[TurnAngles]) -> list[str]:
    """Return a warning about frames whose angles overlap does not tell."""
    assumed = [angle.heading_sd for angle in angles if angle.is_assumed]
    if not assumed:
        return []
    return [
        f"nothing links {len(assumed)} of the {len(angles)} frames that were kept to most others, as on plain walls: "
        f"their angles were assumed by the speed of the turn, within ± {math.degrees(2.0 * max(assumed)):.0f}°; turn "
        "slowly at an even speed, and step back from plain walls"
    ]


def _on_side(tracker: FlowTracker, statement: str) -> str:
    return (
        f"the film {statement}: in it the camera nods by {math.degrees(tracker.nodded):.0f}° and turns by "
        f"{math.degrees(tracker.turned):.0f}°; rotate it by 90° in a viewer, save it and send that film"
    )


def _warnings(samples: _Samples, tracker: FlowTracker) -> list[str]:
    inside = math.prod(samples.full_size) / math.prod(samples.stored_size)
    turned, is_on_side = tracker.turned, tracker.nodded > max(_LEAST_TURN, _SIDEWAYS * tracker.turned)
    is_cut = samples.last_s < _WHOLE_SHARE * samples.claimed_s - 1.0
    faults = {
        f"the film has bars, {1.0 - inside:.0%} of its picture: they were cut off": inside < 1.0,
        f"the film ends after {samples.last_s:.1f} of {samples.claimed_s:.1f} s, as if cut off: send all of it": is_cut,
        _on_side(tracker, "may lie on its side"): is_on_side,
        f"the camera turns by {math.degrees(turned):.0f}° only: film one slow turn, once around on the spot": turned
        < _LEAST_TURN,
        "the camera walks: things grow or shift as they do not in a turn; stay on one spot, and turn about "
        "yourself": tracker.walks,
        f"the camera shakes: it nods by {math.degrees(tracker.nod):.1f}° from one sample to the next; hold it with "
        "both hands, and turn slowly": tracker.shakes,
        f"{100.0 * tracker.lost_share:.0f} % of the film shows nothing that can be followed, such as blank walls or "
        "blur: its angles are less sure; turn slowly, in a lit room": tracker.lost_share > 0.5,
    }
    return [text for text, applies in faults.items() if applies]


def _sample_film(content: bytes, tracker: FlowTracker, samples: _Samples, limits: FilmLimits, begin: float) -> None:
    """Decode a film, and add its sharpest frames by angle; its CPU time counts from `begin`."""
    with _opened(content, limits) as (capture, samples.claimed_s), ThreadPoolExecutor(1) as follower:
        interval_s = max(1.0 / _RATE, samples.claimed_s / _SAMPLES)
        next_s = 0.0
        followed: Future[None] | None = None
        while capture.grab():
            samples.frames += 1
            time_s = max(1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC), samples.last_s)
            samples.last_s = time_s
            if time_s > limits.max_s:
                raise _too_long(time_s, limits)
            if process_time() - begin > limits.max_cpu_s:
                raise InvalidFilmError(
                    f"decoding took more than {limits.max_cpu_s:g} s of CPU time for the first {time_s:.1f} s of the "
                    "film, the limit (max_film_cpu_s): send a film with fewer pixels, or a shorter one"
                )
            if time_s + _TIME_ROUNDED_S < next_s:
                samples.dropped["between samples"] += 1
                continue
            # Samples stay at their rate on average, whatever that of the frames.
            next_s = max(next_s + interval_s, time_s)
            seen, frame = capture.retrieve()
            if not seen or frame is None:
                samples.dropped["damaged"] += 1
                continue
            if samples.stored_size == (0, 0):
                samples.stored_size = frame.shape[1::-1]
            if samples.stored_size != frame.shape[1::-1]:
                samples.dropped["of another size"] += 1
                continue
            picture = shrunk(frame[samples.inside], _LONG_SIDE)
            samples.first = picture if samples.first is None else samples.first
            samples.changes = samples.changes or not np.array_equal(samples.first, picture)
            # A sample is followed while the next one is decoded, where there is a core for it.
            if followed is not None:
                followed.result()
            if samples.is_barred:
                break
            followed = follower.submit(_sample, picture, time_s, samples, tracker)
            if limits.threads == 1:
                followed.result()
        if followed is not None:
            followed.result()
    if not samples.frames:
        raise InvalidFilmError("no frame of the film can be decoded: it is damaged, or has no pictures; save it anew")
    if not samples.changes:
        # FFmpeg gives the same frame, of any content, for each one of an interlaced film.
        raise InvalidFilmError(
            f"all {samples.frames} frames of the film are the same: film one slow turn in a lit room, and send a "
            "picture as a photograph; export an interlaced film, as of a camcorder, as progressive"
        )


def _sample(picture: UInt8[np.ndarray, "h w 3"], time_s: float, samples: _Samples, tracker: FlowTracker) -> None:
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    if cv2.mean(grey)[0] < _DARK:
        samples.dropped["dark"] += 1
        return
    if samples.inside == _WHOLE and tracker.number % _LOOKED_AT == 0:
        samples.looks.append(shrunk(picture, THUMBNAIL_SIDE))
        # A film with bars is read once more, within them.
        samples.is_barred = len(samples.looks) == _FIRST_LOOKS and _inside_bars(samples) != _WHOLE
    heading = tracker.follow(grey)
    sharpness = float(cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_32F))[1].item()) ** 2
    samples.add(
        _Sample(time_s, tracker.number, heading, sharpness, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)), tracker.step
    )


def _inside_bars(samples: _Samples) -> tuple[slice, slice]:
    """Return the rows and columns of frames between bars, by some of all frames; all of them without bars."""
    if not samples.looks:
        return _WHOLE
    looks, parts = np.stack(samples.looks), []
    for side, rows, (begin, end) in zip(samples.stored_size[::-1], looks.shape[1:3], inside_bars(looks), strict=True):
        parts.append(slice(round(begin * side / rows), round(end * side / rows)))
    inside = [part.stop - part.start for part in parts]
    is_picture = min(inside) >= _LEAST_SIDE and max(inside) <= _LONGEST * min(inside)
    is_barred = math.prod(inside) <= (1.0 - _LEAST_BARS) * math.prod(samples.stored_size)
    return (parts[0], parts[1]) if is_picture and is_barred else _WHOLE


@contextmanager
def _opened(content: bytes, limits: FilmLimits) -> Iterator[tuple[cv2.VideoCapture, float]]:
    """Open a film in memory; yield it with the duration (s) that it claims."""
    kind = film_kind(content)
    if kind is None:
        raise InvalidFilmError(
            f"the film is {describe_file(content) or 'another file'} by its first bytes, not MP4, MOV, WebM or "
            "Matroska: record or export it in one of these formats, and send pictures as photographs"
        )
    before = os.environ.get(_OPTIONS)
    # No protocol: everything is in memory. FFmpeg would otherwise choose among all of its demuxers by the content.
    os.environ[_OPTIONS] = f"input_format;{_DEMUXERS[kind]}|protocol_whitelist;none|enable_drefs;0"
    # It outlives the capture, which reads from it until it is released.
    stream = io.BytesIO(content)
    try:
        capture = cv2.VideoCapture(stream, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, limits.threads])  # pyright: ignore
    except cv2.error as error:
        raise InvalidFilmError(f"the film is damaged: {error.err}") from error
    finally:
        if before is None:
            del os.environ[_OPTIONS]
        else:
            os.environ[_OPTIONS] = before
    try:
        yield capture, _checked(capture, kind, limits)
    finally:
        capture.release()


def film_kind(content: bytes) -> str | None:
    """Return the kind of a film by its first bytes: a key of `_DEMUXERS`; None for other files."""
    if content[4:8] in _BOXES and describe_file(content) in (None, VIDEO):
        return "MP4 or MOV"
    if content[:4] == _EBML and any(name in content[4:_HEAD] for name in _DOC_TYPES):
        return "WebM or Matroska"
    return None


def _checked(capture: cv2.VideoCapture, kind: str, limits: FilmLimits) -> float:
    """Check a film's header; return the duration (s) that it claims."""
    if not capture.isOpened():
        raise InvalidFilmError(f"the {kind} file has no film that can be read: it is cut off, damaged or sound only")
    code = struct.pack("<I", int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF)
    if code not in _CODECS:
        known = ", ".join(sorted(set(_CODECS.values())))
        name = code.decode("ascii", "replace").strip("\0 ") or "unknown"
        raise InvalidFilmError(f"the film's codec is '{name}'; it must be one of {known}: export it anew")
    width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > limits.max_pixels:
        raise InvalidFilmError(
            f"the film has {width} x {height} = {width * height} pixels; the limit is {limits.max_pixels} "
            "(max_film_pixels): record in 4K or less"
        )
    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if across > 0.0 and down > 0.0 and across != down:
        raise InvalidFilmError(f"the film's pixels are {across:g}:{down:g}, not square: export it with square pixels")
    rate, frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    claimed_s = frames / rate if rate > 0.0 and frames > 0.0 and math.isfinite(rate) else 0.0
    if claimed_s > limits.max_s + 1.0:
        raise _too_long(claimed_s, limits)
    return claimed_s


def _too_long(seconds: float, limits: FilmLimits) -> InvalidFilmError:
    return InvalidFilmError(
        f"the film is longer than {limits.max_s:g} s, the limit (max_film_s): it has {seconds:.0f} s at least; "
        "cut it to one turn"
    )


@dataclass(frozen=True, kw_only=True)
class FilmLimits:
    """Limits of films; threads decode while the caller's follows the camera, and read the frames that are kept."""

    max_bytes: int = 100 * 2**20
    max_s: float = 60.0
    max_pixels: int = 4096 * 2304
    max_cpu_s: float = 20.0
    threads: int = 2
