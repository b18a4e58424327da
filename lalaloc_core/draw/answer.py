"""The picture of an answer: the plan with the posterior and the pose, the photograph with its layout, or both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.draw.canvas import FOUND, INK, MUTED, RULE, Number, document, shortened, words
from lalaloc_core.draw.heat import HeatMap, colour_bar, heat_image, posterior_map
from lalaloc_core.draw.outline import Outline, layout_outline, photograph_key, photograph_part
from lalaloc_core.draw.plan import ELLIPSE_STDS, Marker, draw_camera, extent_m, plan_part, shape_of
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.answers.documents import Answer, Position, PossiblePose
from lalaloc_core.localise.belief import RIGHT_WITHIN_M, probability_map
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.picture_files import jpeg
from lalaloc_core.shown_text import probability_text

Picture = Literal["both", "plan", "photograph"]

_WIDTH, _PAD = 1600.0, 36.0
# Size of a drawn sphere, and largest of other photographs; photographs that fit it are not scaled.
PHOTOGRAPH_SIZE = (1528, 764)
_HEADER, _KEY, _LEGEND = 104.0, 52.0, 400.0
# Minimum and maximum height of the plan's drawing.
_MIN_PLAN, _MAX_PLAN = 560.0, 1150.0
# Candidates below this probability are not drawn.
_MIN_PROBABILITY = 0.001
# Longer titles and names are shortened.
_MAX_CHARACTERS = 52
# Origin of the heading in words.
_SOURCES = {"given": "given", "photograph": "from the compass", "searched": "estimated"}


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnAnswer:
    """The contents of an answer's picture.

    Attributes:
        camera: the predicted pose, with its covariance if known.
        rivals: the other candidates.
        heat: map of the posterior; None leaves the floors white.
    """

    plan: FloorPlan
    camera: Marker
    room_index: int
    camera_height_m: float
    heading_source: str
    confidence: float | None
    rivals: Sequence[PossiblePose] = ()
    heat: HeatMap | None = None
    photograph: Photograph | None = None

    @property
    def outline(self) -> Outline:
        """The layout as seen from the predicted pose."""
        position_m = np.array([self.camera.x_m, self.camera.y_m])
        heading = heading_from_degrees(self.camera.heading_deg or 0.0)
        outline = layout_outline(self.plan, position_m, self.room_index, heading, self.camera_height_m)
        return outline if self.photograph is None else outline.seen_in(self.photograph)


def drawn_answer(answer: Answer) -> DrawnAnswer:
    """Collect the contents of the picture of an answer in one plan."""
    evidence, covariance = answer.evidence, None
    plan, grid = evidence.ground.plan, evidence.ground.grid
    if answer.covariance_m2 is not None:
        (xx, xy), (_, yy) = answer.covariance_m2
        covariance = (xx, xy, yy)
    x_m, y_m = answer.position.x_m, answer.position.y_m
    return DrawnAnswer(
        plan=plan,
        camera=Marker(x_m=x_m, y_m=y_m, heading_deg=answer.heading_deg, covariance_m2=covariance),
        room_index=evidence.found.candidates[0].room_index,
        camera_height_m=answer.camera_height_m,
        heading_source=_SOURCES[answer.heading_source],
        confidence=answer.confidence,
        rivals=answer.candidates[1:],
        heat=posterior_map(plan, probability_map(plan, grid.poses, evidence.found.posterior), grid.step_m),
        photograph=None if evidence.photograph.is_sphere else evidence.photograph,
    )


def draw_answer(
    answer: DrawnAnswer,
    photograph: UInt8[np.ndarray, "h w 3"] | None = None,
    picture: Picture = "both",
    *,
    title: str | None = None,
    rooms: str | None = None,
) -> str:
    """Draw an answer as an SVG document, 1600 pixels wide.

    The photograph is a levelled full sphere from `photograph.spheres.read_sphere`, or that of `answer.photograph` from
    `photograph.photograph.open_picture`; it is required unless `picture` is "plan".
    The default title is the room. `rooms` is a cached result of `draw_rooms` for the plan.
    """
    room = answer.plan.rooms[answer.room_index].name
    parts = [_header(answer, title or room, None if title is None else room)]
    y = _HEADER
    if picture != "plan":
        if photograph is None:
            raise ValueError(f"photograph is None; picture='{picture}' needs it")
        shown, outline = _sized(photograph, is_sphere=answer.photograph is None), answer.outline
        height, width = shown.shape[:2]
        x = _PAD + 0.5 * (PHOTOGRAPH_SIZE[0] - width)
        parts.append(photograph_part(jpeg(shown), outline, (x, y, width, height)))
        y += height
        parts.append(photograph_key(outline, _PAD, y + 32))
        y += _KEY
    if picture != "photograph":
        seen = [(answer.camera.x_m, answer.camera.y_m)]
        width = _WIDTH - 3 * _PAD - _LEGEND
        height = min(max(width / shape_of(answer.plan, seen), _MIN_PLAN), _MAX_PLAN)
        heat = "" if answer.heat is None else heat_image(answer.heat, answer.plan)
        marks = _marks(answer)
        box = (_PAD, y, width, height)
        parts.append(plan_part(answer.plan, box, marks, seen_m=seen, heat=heat, rooms=rooms))
        parts.append(_legend(answer, _WIDTH - _PAD - _LEGEND, y, height))
        y += height
    return document(_WIDTH, y + _PAD, f"{answer.plan.name}: {room}", parts)


def confidence_words(confidence: float) -> str:
    """Describe a confidence in words."""
    for minimum, text in ((0.95, "almost certain"), (0.8, "very likely"), (0.5, "likely"), (0.2, "doubtful")):
        if confidence >= minimum:
            return text
    return "very unlikely"


def ellipse_m(covariance_m2: tuple[float, float, float]) -> tuple[float, float]:
    """Return the half axes (m), longer first, of the 95 % ellipse of a covariance (xx, xy, yy; m²)."""
    xx, xy, yy = covariance_m2
    minor, major = ELLIPSE_STDS * np.sqrt(np.maximum(np.linalg.eigvalsh([[xx, xy], [xy, yy]]), 0.0))
    return float(major), float(minor)


def _header(answer: DrawnAnswer, title: str, room: str | None) -> str:
    heading_deg = answer.camera.heading_deg or 0.0
    facts = [] if room is None else [shortened(room, _MAX_CHARACTERS)]
    facts += [
        f"x {answer.camera.x_m:.2f} m, y {answer.camera.y_m:.2f} m",
        f"heading {heading_deg:.1f}° ({answer.heading_source})",
        f"camera {answer.camera_height_m:.2f} m over the floor",
    ]
    return words(_PAD, 54, shortened(title, _MAX_CHARACTERS), 36, more='font-weight="bold"') + words(
        _PAD, 86, "  ·  ".join(facts), 20, fill=MUTED
    )


def _marks(answer: DrawnAnswer) -> str:
    """Draw rivals and the predicted pose over the plan."""
    extent = extent_m(answer.plan)
    size = extent / 60.0
    parts = []
    for number, rival in reversed(list(enumerate(_shown(answer), start=2))):
        parts.append(
            f'<g class="rival" transform="translate({rival.position.x_m:.4f} {-rival.position.y_m:.4f})">'
            f'<circle r="{0.9 * size:.4f}" fill="#fff" stroke="{FOUND}" stroke-width="{0.16 * size:.4f}"/>'
            f'<path d="M0 {-0.9 * size:.4f}V{-1.7 * size:.4f}" stroke="{FOUND}" stroke-width="{0.22 * size:.4f}" '
            f'transform="rotate({rival.heading_deg:.2f})"/>'
            f'<text y="{0.36 * size:.4f}" font-size="{size:.4f}" fill="{INK}">{number}</text></g>'
        )
    return "".join([*parts, draw_camera(answer.camera, extent)])


def _legend(answer: DrawnAnswer, x: Number, y: Number, height: Number) -> str:
    parts, row = [], y + 18
    if answer.confidence is not None:
        parts.append(words(x, row + 30, probability_text(answer.confidence), 46, more='font-weight="bold"'))
        parts.append(words(x, row + 60, f"within 1 m: {confidence_words(answer.confidence)}", 18, fill=MUTED))
        row += 96
    circle = f'<circle cx="{x + 11:.1f}" cy="{row - 6:.1f}" r="9" fill="{FOUND}"/>'
    parts.append(circle + words(x + 32, row, "predicted; the wedge shows the heading", 18))
    if answer.camera.covariance_m2 is not None:
        major, minor = ellipse_m(answer.camera.covariance_m2)
        row += 28
        parts.append(words(x + 32, row, f"95 % within ± {_length(major)} by ± {_length(minor)}", 16, fill=MUTED))
    rivals = _shown(answer)
    row += 48
    parts.append(words(x, row, "Other places" if rivals else "No other place", 18, more='font-weight="bold"'))
    for number, rival in enumerate(rivals, start=2):
        row += 34
        share = "" if rival.probability is None else probability_text(rival.probability)
        parts.append(
            f'<circle cx="{x + 11:.1f}" cy="{row - 6:.1f}" r="11" fill="#fff" stroke="{FOUND}" stroke-width="2"/>'
            + words(x + 11, row - 1, str(number), 13, anchor="middle")
            + words(x + 32, row, shortened(rival.room, 28), 17)
            + words(x + _LEGEND, row, share, 17, fill=MUTED, anchor="end")
        )
    if answer.heat is not None:
        parts.append(f'<path d="M{x:.1f} {y + height - 92:.1f}h{_LEGEND:.0f}" stroke="{RULE}"/>')
        parts.append(colour_bar(answer.heat, x, y + height - 74, _LEGEND))
    return "".join(parts)


def _sized(photograph: UInt8[np.ndarray, "h w 3"], *, is_sphere: bool) -> UInt8[np.ndarray, "h2 w2 3"]:
    height, width = photograph.shape[:2]
    size = PHOTOGRAPH_SIZE
    if not is_sphere:
        share = min(size[0] / width, size[1] / height)
        size = round(share * width), round(share * height)
    if (width, height) == size:
        return photograph
    return np.asarray(Image.fromarray(photograph).resize(size, Image.Resampling.BICUBIC))


def _shown(answer: DrawnAnswer) -> list[PossiblePose]:
    """Return the other places; candidates within 1 m of the answer or of a better one are the same place."""
    places: list[PossiblePose] = []
    for rival in answer.rivals:
        spot = rival.position
        if _distance_m(spot, answer.camera) < RIGHT_WITHIN_M:
            continue
        near = next((i for i, place in enumerate(places) if _distance_m(spot, place.position) < RIGHT_WITHIN_M), None)
        if near is None:
            places.append(rival)
        elif rival.probability is not None:
            places[near] = replace(places[near], probability=(places[near].probability or 0.0) + rival.probability)
    return [place for place in places if place.probability is None or place.probability >= _MIN_PROBABILITY]


def _distance_m(first: Position, second: Position | Marker) -> float:
    return math.hypot(first.x_m - second.x_m, first.y_m - second.y_m)


def _length(metres: float) -> str:
    return f"{100 * metres:.0f} cm" if metres < 0.995 else f"{metres:.1f} m"
