"""PNG and JPEG pictures of plans."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from PIL import Image, ImageOps

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.file_kinds import Tones
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions, ReportBuilder
from lalaloc_core.importers.drawing.drawing_scale import (
    Scale,
    check_scale,
    drawing_scale,
    reject_dimensions,
    scale_by_dimensions,
    written_dimensions,
)
from lalaloc_core.importers.drawing.scale_guess import Measures, assume_scale, first_scale, guess_scale
from lalaloc_core.importers.drawing.sketch_drawing import name_rooms, text_hints
from lalaloc_core.importers.drawing.storeys import Box, assemble_storeys
from lalaloc_core.importers.drawing.vector_drawing import Area
from lalaloc_core.importers.picture.ink import Colours, Gray, blank_outside, darken_pale_walls, drawn_extent
from lalaloc_core.importers.picture.lettering import read_texts
from lalaloc_core.importers.picture.occupancy import sketch_map
from lalaloc_core.importers.picture.sketch_picture import sketch_picture

_MIN_SIDE_PX = 64
# Opacity of pixels that count, the least share of others on a transparent ground, tones that are light (of 255), and
# the least share of dark lines.
_CLEAR, _LEAST_CLEAR, _LIGHT, _LEAST_DARK = 128, 0.2, 150.0, 0.02
# Tones (of 16) that are dark, and the share of the picture that has the ground's.
_DARK_TONES, _MOSTLY = 7, 0.5
# A larger picture has a wrong scale.
_MAX_EXTENT_M = 1000.0


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan in a picture, as a draft."""
    builder = ReportBuilder("picture", is_draft=True)
    gray, warmth, colours, paper_m_per_pixel = _open(content, builder, budget)
    _check_kind(gray, options, builder)
    if options.crop is not None:
        gray = blank_outside(gray, options.crop)
        warmth = None if warmth is None else blank_outside(warmth, options.crop)
        colours = np.dstack([blank_outside(colours[..., channel], options.crop) for channel in range(3)])
    texts = read_texts(gray, builder, budget)
    budget.hints += text_hints(texts.drawing.letterings, "the picture")
    # Dimensions are preferred to "1:100": scans keep their resolution when they are made smaller.
    dimensions = written_dimensions(texts.drawing, budget.check_time)
    measured = scale_by_dimensions(dimensions, texts.drawing.extent) if texts.drawing.shapes else None

    def measure(scale: float) -> Measures:
        # Symbols that are found by their size tell nothing about the scale.
        placed = texts.placed(scale)
        sketch = sketch_picture(gray, scale, ReportBuilder(), budget, warmth, has_symbols=False, letterings=placed)
        return Measures.of(sketch, scale, placed, texts.drawing, dimensions)

    def guess(written: Sequence[Scale]) -> Scale | None:
        first = first_scale(drawn_extent(gray))
        if sketch_map(colours, first, ReportBuilder(), budget) is not None:
            budget.hints.append("maps as robots draw them have no leaves of doors, which would tell the scale")
            return None
        return assume_scale(guess_scale(measure, first, budget), builder, written)

    factor, source = builder.metres_per_unit, builder.scale_source = drawing_scale(
        replace(options, units=None),
        "the picture",
        [texts.drawing],
        paper_m_per_unit=paper_m_per_pixel,
        paper_m=None if paper_m_per_pixel is None else max(gray.shape) * paper_m_per_pixel,
        own=measured,
        guess=guess,
    )
    check_scale(factor, source, measured, builder)
    reject_dimensions(dimensions, factor, builder)
    rows, columns = gray.shape
    if max(rows, columns) * factor > _MAX_EXTENT_M:
        raise InvalidFloorPlanError(
            f"the picture is {columns * factor:.0f} m by {rows * factor:.0f} m at {factor:g} m per pixel; the limit is "
            f"{_MAX_EXTENT_M:g} m; check the scale (metres_per_pixel, known_distance or scale)"
        )
    letterings = texts.placed(factor)
    sketch = sketch_map(colours, factor, builder, budget)
    if sketch is None or not sketch.rooms:
        sketch = sketch_picture(gray, factor, builder, budget, warmth, letterings=letterings)
    if not sketch.rooms:
        raise InvalidFloorPlanError(
            f"no walls that enclose a room were found in the picture, which is {columns * factor:.1f} m by "
            f"{rows * factor:.1f} m at {factor:g} m per pixel; check the scale (metres_per_pixel, known_distance or "
            "scale), and that walls are dark or drawn with two lines"
        )
    rooms = [Area(room.shape, "", "room") for room in sketch.rooms]
    sketch.rooms = name_rooms(rooms, letterings, builder, sketch.drawn)

    def in_file(box: Box) -> Box:
        x0, y0, x1, y1 = (number / factor for number in box)
        return max(x0, 0.0), max(rows - y1, 0.0), min(x1, float(columns)), min(rows - y0, float(rows))

    return assemble_storeys(sketch, letterings, builder, options, budget, in_file)


def _check_kind(gray: Gray, options: ImportOptions, builder: ReportBuilder) -> None:
    """Refuse photographs, unless the options say that the picture is a plan."""
    tones = Tones.of(gray)
    if tones is None or not tones.is_photograph:
        return
    if not options.plan:
        raise InvalidFloorPlanError(
            "the picture looks like a photograph, not like a floor plan: send it to be localised; if it is a plan, "
            "set plan=true (--is-plan on the command line)"
        )
    builder.notes.append("the picture looks like a photograph and was read as a plan, because plan=true is set")


def _open(content: bytes, builder: ReportBuilder, budget: Budget) -> tuple[Gray, Gray | None, Colours, float | None]:
    """Return the grey picture on white, its warmth, its colours, and the length of a pixel on paper if it is given."""
    with open_picture(content, ["PNG", "JPEG"], "the picture", "save it again as PNG", budget) as picture:
        if min(picture.size) < _MIN_SIDE_PX:
            raise InvalidFloorPlanError(
                f"the picture has {picture.width} x {picture.height} pixels; the minimum is {_MIN_SIDE_PX} x "
                f"{_MIN_SIDE_PX}; use a larger picture"
            )
        dpi = picture.info.get("dpi")
        # A PNG can have a text of this name, in which Pillow would look for an orientation.
        if isinstance(picture.info.get("xmp"), str):
            del picture.info["xmp"]
        upright = in_bytes(ImageOps.exif_transpose(picture))
        drawn = upright.convert("RGBA")
        flat = Image.new("RGBA", upright.size, "black" if _is_light(drawn) else "white")
        flat.alpha_composite(drawn)
        gray = np.asarray(flat.convert("L"))
        warmth = None if upright.mode in ("1", "L", "LA", "I", "I;16", "F") else _warmth(flat)
        colours = np.asarray(flat.convert("RGB"))
        if (with_dark_walls := darken_pale_walls(colours)) is not None:
            gray, warmth = with_dark_walls, None
            builder.notes.append("walls are the areas of one colour between the floors, which are darker")
        elif _has_dark_ground(gray):
            # Red and blue lines are nearly as dark as the ground.
            ground = np.median(colours[::8, ::8].reshape(-1, 3), axis=0).astype(np.uint8)
            apart = np.maximum(colours, ground) - np.minimum(colours, ground)
            gray, warmth = 255 - apart.max(axis=2), None
            builder.notes.append("the picture shows light lines on a dark ground and was inverted")
    return gray, warmth, colours, _paper(dpi)


@contextmanager
def open_picture(content: bytes, kinds: list[str], name: str, remedy: str, budget: Budget) -> Iterator[Image.Image]:
    """Open a picture within the limit of pixels; errors in the block are those of a damaged file."""
    limit = budget.limits.max_plan_pixels
    many = f"the limit is {limit} in total (max_plan_pixels); reduce its resolution, or crop it"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=kinds) as picture:
                if picture.width * picture.height > limit:
                    raise InvalidFloorPlanError(f"{name} has {picture.width} x {picture.height} pixels; {many}")
                yield picture
    except InvalidFloorPlanError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InvalidFloorPlanError(f"{name} has too many pixels and cannot be read; {many}") from error
    except (OSError, ValueError, SyntaxError, EOFError, TypeError, ZeroDivisionError) as error:
        raise InvalidFloorPlanError(f"{name} is damaged and cannot be read; {remedy}") from error


def in_bytes(picture: Image.Image) -> Image.Image:
    """Return a grey picture of 16 bits with 8, which Pillow would cut off; others as they are."""
    is_wide = picture.mode.startswith("I")
    return Image.fromarray((np.asarray(picture, np.int64) >> 8).clip(0, 255).astype(np.uint8)) if is_wide else picture


def _is_light(picture: Image.Image) -> bool:
    """Return whether all that is drawn on a transparent ground is light, as for dark pages."""
    alpha = np.asarray(picture.getchannel("A"))
    if (alpha < _CLEAR).mean() < _LEAST_CLEAR or not (alpha >= _CLEAR).any():
        return False
    return float(np.quantile(np.asarray(picture.convert("L"))[alpha >= _CLEAR], _LEAST_DARK)) > _LIGHT


def _has_dark_ground(gray: Gray) -> bool:
    """Return whether the most frequent tone is dark, and most of the picture has about this tone."""
    share = np.bincount(gray.ravel() >> 4, minlength=16) / gray.size
    ground = int(share.argmax())
    return ground < _DARK_TONES and float(share[max(ground - 1, 0) : ground + 2].sum()) > _MOSTLY


def _warmth(picture: Image.Image) -> Gray:
    """Return half of red minus blue, plus 128 (see `Ink.warmth`)."""
    red, blue = (np.asarray(picture.getchannel(name)) for name in "RB")
    # Computed in bytes: wider types take hundreds of megabytes for the largest pictures.
    return (red >> 1) + (127 - (blue >> 1)) + np.uint8(1)


def _paper(dpi: object) -> float | None:
    """Return metres of paper per pixel; 72 and 96 dpi are defaults without meaning."""
    if not isinstance(dpi, tuple) or not dpi:
        return None
    value = float(dpi[0])
    return 0.0254 / value if 97.0 <= value <= 2400.0 else None
