"""PDF: pages with lines are read as drawings, scanned pages as pictures.

A PDF has neither rooms nor meaningful layers, so the result is always a draft.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble
from lalaloc_core.importers.common.limits import Budget
from lalaloc_core.importers.common.options import ImportOptions
from lalaloc_core.importers.common.report import ReportBuilder
from lalaloc_core.importers.common.sketch import Sketch
from lalaloc_core.importers.drawing.dimensions import drawn_scale
from lalaloc_core.importers.drawing.scale import drawing_scale
from lalaloc_core.importers.drawing.shapes import Area
from lalaloc_core.importers.drawing.sketching import named_rooms, sketch_drawing
from lalaloc_core.importers.formats.pdf_page import PageContent, open_page, read_page
from lalaloc_core.importers.picture.sketching import sketch_picture

_METRES_PER_POINT = 0.0254 / 72.0
# A page with fewer lines, or with a larger share covered by pictures, is a scan.
_MIN_LINES, _MOSTLY = 12, 0.5
_FINEST_M, _COARSEST_PT = 0.01, 4.0


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan on one page of a PDF.

    `metres_per_pixel` is metres per point (1/72 inch); `known_distance` is in points from the page's lower left corner.

    Raises:
        InvalidFloorPlanError: the file is invalid, or neither the page nor the options give its scale.
    """
    document, page = open_page(content, options.page)
    try:
        found = read_page(page, budget)
        texts = [lettering.text for lettering in found.drawing.letterings]
        # A unit of a PDF is always a point.
        without_units = replace(options, units=None)
        factor, source = drawing_scale(
            without_units,
            "the PDF",
            paper_m_per_unit=_METRES_PER_POINT,
            texts=texts,
            dimensions=lambda: drawn_scale(found.drawing, budget.check_time),
        )
        builder = ReportBuilder()
        sketch = _as_drawing(found, factor, builder, budget)
        if sketch is None or not sketch.rooms:
            builder = ReportBuilder()
            builder.notes.append(f"page {options.page} was read as a picture")
            sketch = _as_picture(page, found, factor, builder, budget)
    finally:
        document.close()
    plan = assemble(
        sketch,
        builder,
        options,
        budget.limits.plan,
        format="pdf",
        metres_per_unit=factor,
        scale_source=source,
        is_draft=True,
    )
    return (plan,)


def _as_drawing(found: PageContent, factor: float, builder: ReportBuilder, budget: Budget) -> Sketch | None:
    drawing = found.drawing
    if len(drawing.strokes) + len(drawing.areas) < _MIN_LINES or found.picture_share > _MOSTLY:
        return None
    builder.use("lines", "possible walls", len(drawing.strokes))
    builder.use("areas", "possible walls", len(drawing.areas))
    builder.use("curves", "door swings", len(drawing.swings))
    builder.use("texts", "names", len(drawing.letterings))
    return sketch_drawing(drawing.scaled(factor, flip_y=False), builder, budget)


def _as_picture(page: object, found: PageContent, factor: float, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Render the page and read it as a picture."""
    width, height = found.size_pt
    metres_per_pixel = max(_FINEST_M, factor * 0.25)
    scale = min(factor / metres_per_pixel, _COARSEST_PT)
    if width * height * scale**2 > budget.limits.max_plan_pixels:
        raise InvalidFloorPlanError(
            f"the page is {width * factor:.0f} m by {height * factor:.0f} m, {width * height * scale**2:.0f} pixels; "
            f"the limit is {budget.limits.max_plan_pixels} (max_plan_pixels); check the scale"
        )
    bitmap = page.render(scale=scale, grayscale=True)  # type: ignore[attr-defined]
    gray = np.asarray(bitmap.to_numpy()).reshape(bitmap.height, bitmap.width, -1)[:, :, 0]
    sketch = sketch_picture(gray, factor / scale, builder, budget)
    # Searchable scans contain text over the picture.
    texts = found.drawing.scaled(factor, flip_y=False).letterings
    sketch.rooms = named_rooms([Area(room.shape, "", "room") for room in sketch.rooms], texts, builder)
    return sketch
