"""PDF: pages with lines are read as drawings, scanned pages as pictures.

A PDF has neither rooms nor meaningful layers, so the result is always a draft.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pypdfium2
import shapely
from jaxtyping import UInt8

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.room_types import room_types_from_name
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions, ReportBuilder, Sketch
from lalaloc_core.importers.drawing.drawing_scale import drawing_scale, written_dimensions
from lalaloc_core.importers.drawing.scale_guess import Measures, ScaleGuess, assume_scale, first_scale, guess_scale
from lalaloc_core.importers.drawing.sketch_drawing import guess_drawing, name_rooms, sketch_drawing, text_hints
from lalaloc_core.importers.drawing.storeys import Box, assemble_storeys
from lalaloc_core.importers.drawing.vector_drawing import Area, Lettering
from lalaloc_core.importers.formats.pdf_page import PageContent, open_page, read_page
from lalaloc_core.importers.picture.ink import blank_outside
from lalaloc_core.importers.picture.lettering import READ_PX, PictureTexts, read_texts
from lalaloc_core.importers.picture.sketch_picture import sketch_picture

# A page with fewer lines, or with a larger share covered by pictures, is a scan; smaller pictures are logos.
_MIN_LINES, _MOSTLY, _LEAST = 12, 0.5, 0.02
_FINEST_M, _COARSEST_PT = 0.01, 4.0
# Margin around a text that is removed, as a share of the root of its area.
_AROUND_TEXT = 0.1


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan on one page of a PDF.

    `metres_per_pixel` is metres per point (1/72 inch); `known_distance` is in points from the page's lower left corner.
    """
    document, page = open_page(content, options.page)
    try:
        where = f"page {options.page} of {len(document)} was read: set page to that of the plan"
        budget.hints += [where] * (len(document) > 1)
        budget.begin(f"reading page {options.page} of {len(document)}")
        found = read_page(page, options.page, budget)
        if found.hidden:
            named = ", ".join(repr(layer) if layer else "one without a name" for layer in found.hidden)
            budget.hints.append(
                f"layers that are switched off in the PDF were not read: {named}; switch on what is of the plan, "
                "for screens and for print"
            )
        found.crop, paper, shapes = options.crop, options.crop or page.get_bbox(), found.drawing.shapes
        if options.crop is not None or (shapes and not shapely.covers(shapely.box(*paper), shapes).all()):
            found.drawing = found.drawing.cropped(paper)
        notes = list(budget.hints)
        budget.hints += text_hints(found.drawing.letterings, f"page {options.page} of the PDF")
        return _read(found, notes, options, budget)
    finally:
        document.close()


def _read(found: PageContent, notes: list[str], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    builder = ReportBuilder("pdf", is_draft=True, notes=notes)
    if found.out_of_range:
        builder.notes.append(f"{found.out_of_range} lines were left out, as their coordinates are out of range")
    for layer, count in found.hidden.items():
        builder.use(layer, "ignored (layer is off)", count)
    scan = _read_scan(found, builder, budget)
    # A unit of a PDF is always a point.
    without_units, drawings = replace(options, units=None), [found.drawing, scan.drawing]
    factor, _ = builder.metres_per_unit, builder.scale_source = drawing_scale(
        without_units,
        "the PDF",
        drawings,
        budget.check_time,
        paper_m_per_unit=found.unit_m,
        paper_m=max(found.size_pt) * found.unit_m,
        guess=lambda written: assume_scale(_guess(found, scan, budget), builder, written),
    )
    # Marks of dimensions can be read as letters, so these are removed after the scale is known.
    _remove_letters(found)
    # Searchable scans contain text over the picture.
    letterings = found.drawing.scaled(factor, flip_y=False).letterings or scan.placed(factor)
    before = deepcopy(builder)
    sketch = _as_drawing(found, factor, builder, budget)
    if sketch is None or not sketch.rooms:
        builder = before
        builder.notes.append(f"page {options.page} was read as a picture")
        sketch = _as_picture(found, factor, builder, budget, letterings=letterings)
        rooms = [Area(room.shape, "", "room") for room in sketch.rooms]
        sketch.rooms = name_rooms(rooms, letterings, builder, sketch.drawn)

    def in_points(box: Box) -> Box:
        x0, y0, x1, y1 = box
        return x0 / factor, y0 / factor, x1 / factor, y1 / factor

    return assemble_storeys(sketch, letterings, builder, options, budget, in_points)


def _guess(found: PageContent, scan: PictureTexts, budget: Budget) -> ScaleGuess | None:
    """Return the scale of a page by the usual sizes of its parts, None if they are too few."""
    if _is_drawing(found):
        _remove_letters(found)
        return guess_drawing(found.drawing, budget, flip_y=False)
    dimensions = written_dimensions(scan.drawing, budget.check_time)

    def measure(scale: float) -> Measures:
        # Symbols that are found by their size tell nothing about the scale.
        letterings = found.drawing.scaled(scale, flip_y=False).letterings or scan.placed(scale)
        sketch = _as_picture(found, scale, ReportBuilder(), budget, has_symbols=False, letterings=letterings)
        return Measures.of(sketch, scale, letterings, scan.drawing, dimensions)

    return guess_scale(measure, first_scale(0.9 * max(found.size_pt)), budget)


def _is_drawing(found: PageContent) -> bool:
    return len(found.drawing.strokes) + len(found.drawing.areas) >= _MIN_LINES and found.picture_share <= _MOSTLY


def _as_drawing(found: PageContent, factor: float, builder: ReportBuilder, budget: Budget) -> Sketch | None:
    drawing = found.drawing
    if not _is_drawing(found):
        return None
    if found.picture_share >= _LEAST:
        share = f"pictures cover {found.picture_share:.0%} of the page"
        builder.warnings.append(f"{share} and are not read, as it has lines: if one is the plan, set crop to it")
    builder.use("lines", "possible walls", len(drawing.strokes))
    builder.use("areas", "possible walls", len(drawing.areas))
    builder.use("curves", "door swings", len(drawing.swings))
    builder.use("texts", "names", len(drawing.letterings))
    return sketch_drawing(drawing.scaled(factor, flip_y=False), builder, budget)


def _as_picture(
    found: PageContent,
    factor: float,
    builder: ReportBuilder,
    budget: Budget,
    *,
    has_symbols: bool = True,
    letterings: Sequence[Lettering] = (),
) -> Sketch:
    """Render the page and read it as a picture; `has_symbols` looks for fixtures, `letterings` divide rooms."""
    width, height = found.size_pt
    metres_per_pixel = max(_FINEST_M, factor * 0.25)
    scale = min(factor / metres_per_pixel, _COARSEST_PT)
    if width * height * scale**2 > budget.limits.max_plan_pixels:
        raise InvalidFloorPlanError(
            f"the page is {width * factor:.0f} m by {height * factor:.0f} m, {width * height * scale**2:.0f} pixels; "
            f"the limit is {budget.limits.max_plan_pixels} (max_plan_pixels); check the scale"
        )
    gray = _gray(found.page.render(scale=scale, grayscale=True), found.crop, scale)  # type: ignore[arg-type]
    return sketch_picture(gray, factor / scale, builder, budget, has_symbols=has_symbols, letterings=letterings)


def _gray(bitmap: pypdfium2.PdfBitmap, crop: Box | None, scale: float) -> UInt8[np.ndarray, "h w"]:
    """Return the pixels of a rendered page, blank outside a box in points, y up."""
    gray = np.asarray(bitmap.to_numpy()).reshape(bitmap.height, bitmap.width, -1)[:, :, 0]
    if crop is None:
        return gray
    x0, y0, x1, y1 = (number * scale for number in crop)
    return blank_outside(gray, (x0, gray.shape[0] - y1, x1, gray.shape[0] - y0))


def _read_scan(found: PageContent, builder: ReportBuilder, budget: Budget) -> PictureTexts:
    """Return the texts of a scanned page, in points; letters that are drawn as lines join the texts of the page."""
    is_scan, own = found.picture_share > _MOSTLY, list(found.drawing.letterings)
    # A page can have a title block as text, and rooms with drawn letters.
    if not is_scan and any(room_types_from_name(lettering.text) for lettering in own):
        return PictureTexts()
    width, height = found.size_pt
    scale = min(READ_PX / max(width, height, 1.0), _COARSEST_PT)
    bitmap = found.page.render(scale=scale, grayscale=True)  # type: ignore[arg-type]
    # Lines of a drawing are not turned, so its texts must not be.
    gray = _gray(bitmap, found.crop, scale)
    scan = read_texts(gray, builder, budget, straighten=is_scan).scaled(1.0 / scale)
    if is_scan:
        return scan
    convert = bitmap.get_posconv(found.page)

    def on_page(x: float, y: float) -> tuple[float, float]:
        """Return a place on the page for one in points from the middle of the bitmap."""
        return convert.to_page(round(0.5 * bitmap.width + x * scale), round(0.5 * bitmap.height - y * scale))

    for lettering in scan.drawing.letterings:
        position = on_page(*lettering.position)
        if all(math.dist(position, text.position) > lettering.height for text in own):
            found.drawing.letterings.append(replace(lettering, position=position))
    found.letters = [shapely.Polygon([on_page(*corner) for corner in corners]) for corners in scan.outlines]
    return PictureTexts()


def _remove_letters(found: PageContent) -> None:
    """Remove the shapes that texts consist of: dark letters would be pillars."""
    tree = shapely.STRtree([text.buffer(_AROUND_TEXT * math.sqrt(text.area), quad_segs=1) for text in found.letters])
    drawing = found.drawing
    drawing.areas = [area for area in drawing.areas if not len(tree.query(area.shape, predicate="within"))]
    drawing.strokes = [stroke for stroke in drawing.strokes if not len(tree.query(stroke.line, predicate="within"))]
