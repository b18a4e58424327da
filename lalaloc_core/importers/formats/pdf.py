"""PDF: pages that are drawn with lines are read as a drawing, scanned pages as pictures.

A PDF knows no layers that mean anything and no rooms, so what comes of it is a draft, whichever way it was read.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.drawing.scale import drawing_scale
from lalaloc_core.importers.drawing.shapes import Area
from lalaloc_core.importers.drawing.understand import named_rooms, understand
from lalaloc_core.importers.formats.pdf_page import PageContent, open_page, read_page
from lalaloc_core.importers.model.assemble import ImportedPlan, assemble
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.model.sketch import Sketch
from lalaloc_core.importers.picture import sketch_picture

FORMAT = "pdf"
_METRES_PER_POINT = 0.0254 / 72.0
# A page with fewer lines than this, or mostly covered by a picture, is a scan.
_MIN_LINES, _MOSTLY = 12, 0.5
_FINEST_M, _COARSEST_PT = 0.01, 4.0


def import_pdf(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """The plan on one page of a PDF.

    `metres_per_pixel` is metres per point (1/72 inch), `known_distance` in points from the page's lower left corner.

    Raises:
        InvalidFloorPlanError: what is wrong with the file, or that it does not say its scale.
    """
    document, page = open_page(content, options.page)
    try:
        found = read_page(page, budget)
        texts = [lettering.text for lettering in found.drawing.letterings]
        # A unit of the page is a point, whatever somebody says of units.
        asked = replace(options, units=None)
        factor, source = drawing_scale(asked, "the PDF", paper_m_per_unit=_METRES_PER_POINT, texts=texts)
        builder = ReportBuilder()
        sketch = _as_drawing(found, factor, builder, budget)
        if sketch is None or not sketch.rooms:
            builder = ReportBuilder()
            builder.notes.append(f"page {options.page} was read as a picture")
            sketch = _as_picture(page, found, factor, builder, budget)
    finally:
        document.close()
    plan = assemble(sketch, builder, options, format=FORMAT, metres_per_unit=factor, scale_source=source, is_draft=True)
    return (plan,)


def _as_drawing(found: PageContent, factor: float, builder: ReportBuilder, budget: Budget) -> Sketch | None:
    drawing = found.drawing
    if len(drawing.strokes) + len(drawing.areas) < _MIN_LINES or found.picture_share > _MOSTLY:
        return None
    builder.use("lines", "perhaps walls", len(drawing.strokes))
    builder.use("areas", "perhaps walls", len(drawing.areas))
    builder.use("curves", "swings of doors", len(drawing.swings))
    builder.use("texts", "names", len(drawing.letterings))
    return understand(drawing.scaled(factor, turn_over=False), builder, budget)


def _as_picture(page: object, found: PageContent, factor: float, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Draw the page, as finely as it needs and may be."""
    width, height = found.size_pt
    metres_per_pixel = max(_FINEST_M, factor * 0.25)
    scale = min(factor / metres_per_pixel, _COARSEST_PT)
    if width * height * scale**2 > budget.limits.max_plan_pixels:
        raise InvalidFloorPlanError(
            f"the page is {width * factor:.0f} m by {height * factor:.0f} m at this scale, too large to be drawn; "
            "is the scale right?"
        )
    bitmap = page.render(scale=scale, grayscale=True)  # type: ignore[attr-defined]
    gray = np.asarray(bitmap.to_numpy()).reshape(bitmap.height, bitmap.width, -1)[:, :, 0]
    sketch = sketch_picture(gray, factor / scale, builder, budget)
    # A scan that was made searchable has its lettering beside the picture.
    texts = found.drawing.scaled(factor, turn_over=False).letterings
    sketch.rooms = named_rooms([Area(room.shape, "", "room") for room in sketch.rooms], texts, builder)
    return sketch
