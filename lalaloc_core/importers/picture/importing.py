"""PNG and JPEG files."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.drawing.scale import drawing_scale
from lalaloc_core.importers.model.assemble import ImportedPlan, assemble
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.picture.sketching import sketch_picture

FORMAT = "picture"
_MIN_SIDE_PX = 64
# A picture of more metres than that has a wrong scale, and would be drawn over the heads of all limits.
_MAX_EXTENT_M = 1000.0


def import_picture(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """The plan that a picture shows, as a draft.

    Raises:
        InvalidFloorPlanError: no picture that can be read, or nothing says how long a pixel is.
    """
    gray, warmth, paper_m_per_pixel = _open(content, budget)
    factor, source = drawing_scale(replace(options, units=None), "the picture", paper_m_per_unit=paper_m_per_pixel)
    rows, columns = gray.shape
    if max(rows, columns) * factor > _MAX_EXTENT_M:
        raise InvalidFloorPlanError(
            f"the picture is {columns * factor:.0f} m by {rows * factor:.0f} m at {factor:g} m per pixel, at most "
            f"{_MAX_EXTENT_M:g} m are read; is the scale right?"
        )
    builder = ReportBuilder()
    sketch = sketch_picture(gray, factor, builder, budget, warmth)
    if not sketch.rooms:
        raise InvalidFloorPlanError(
            f"no walls that enclose a room were found in the picture, which is {columns * factor:.1f} m by "
            f"{rows * factor:.1f} m at {factor:g} m per pixel; is the scale right, and are the walls dark or "
            "drawn with two lines?"
        )
    return (
        assemble(sketch, builder, options, format=FORMAT, metres_per_unit=factor, scale_source=source, is_draft=True),
    )


def _open(
    content: bytes, budget: Budget
) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"] | None, float | None]:
    """(grey picture on white paper, its warmth, length of a pixel on paper where the file says)."""
    limit = budget.limits.max_plan_pixels
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as picture:
                width, height = picture.size
                if width * height > limit:
                    raise InvalidFloorPlanError(
                        f"the picture has {width} x {height} pixels, at most {limit} are read (max_plan_pixels)"
                    )
                if min(width, height) < _MIN_SIDE_PX:
                    raise InvalidFloorPlanError(
                        f"the picture has {width} x {height} pixels, at least {_MIN_SIDE_PX} each way are needed"
                    )
                dpi = picture.info.get("dpi")
                upright = ImageOps.exif_transpose(picture)
                flat = Image.new("RGBA", upright.size, "white")
                flat.alpha_composite(upright.convert("RGBA"))
                gray = np.asarray(flat.convert("L"))
                grey_modes = ("1", "L", "LA", "I", "I;16", "F")
                warmth = None if upright.mode in grey_modes else _warmth(flat)
    except InvalidFloorPlanError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError, Image.DecompressionBombWarning,
            TypeError, ZeroDivisionError) as error:  # fmt: skip
        raise InvalidFloorPlanError(f"the picture cannot be read: {error}") from error
    return gray, warmth, _paper(dpi)


def _warmth(picture: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """Half of red minus blue, as of `Ink`."""
    red, blue = (np.asarray(picture.getchannel(name)) for name in "RB")
    # In bytes: of the largest picture that is read, wider numbers would take hundreds of megabytes.
    return (red >> 1) + (127 - (blue >> 1)) + np.uint8(1)


def _paper(dpi: object) -> float | None:
    """Metres of paper per pixel; 72 and 96 are what programs write that do not know."""
    if not isinstance(dpi, tuple) or not dpi:
        return None
    value = float(dpi[0])
    return 0.0254 / value if 97.0 <= value <= 2400.0 else None
