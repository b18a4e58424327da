"""Names, areas and dimensions that are printed in pictures and scans of plans."""

from __future__ import annotations

import io
import socket
import subprocess
import sys
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D
from PIL import Image, ImageDraw, ImageFont

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportedPlan, ImportOptions, import_plan
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.picture import lettering
from lalaloc_core.importers.picture.lettering import read_texts
from tests.importers.conftest import shapes
from tests.painted import picture_file

FONT = Path(lettering.__file__).parents[2] / "draw" / "fonts" / "DejaVuSans.ttf"
# Enough time for all texts on a busy machine.
LIMITS = ImportLimits(max_import_s=600.0)
AREAS_M2 = {"Wohnzimmer": 23.4, "Küche": 13.92, "Bedroom": 13.92}


@dataclass
class PrintedPlan:
    """Picture of a flat of 9.3 m by 6.4 m with three rooms, names, areas and six dimensions."""

    px_per_m: float = 70.0
    text_px: int = 20
    margin_m: float = 1.8
    areas: bool = True
    dimensions: bool = True
    picture: Image.Image = field(init=False)

    def __post_init__(self) -> None:
        width_m, height_m = 9.3 + 2 * self.margin_m, 6.4 + 2 * self.margin_m
        self.picture = Image.new("L", (round(width_m * self.px_per_m), round(height_m * self.px_per_m)), 255)
        self.pen = ImageDraw.Draw(self.picture)
        for wall in ((0, 0, 9.3, 0.2), (0, 6.2, 9.3, 6.4), (0, 0, 0.2, 6.4), (9.1, 0, 9.3, 6.4), (4.1, 0, 4.3, 6.4),
                     (4.1, 3.1, 9.3, 3.3)):  # fmt: skip
            self._box(wall, 0)
        self._box((1.0, 6.2, 2.6, 6.4), 255)
        for y in (6.23, 6.37):
            self._line((1.0, y, 2.6, y))
        for (name, area), middle in zip(AREAS_M2.items(), ((2.1, 3.4), (6.7, 4.9), (6.7, 1.8)), strict=True):
            self._text(middle, name)
            if self.areas:
                self._text((middle[0], middle[1] - 0.5), f"{area:.1f} m²")
        if self.dimensions:
            for start, end, y in ((0.2, 4.1, -0.6), (4.3, 9.1, -0.6), (0.0, 9.3, -1.3)):
                self._dimension(start, end, y, is_vertical=False)
            for start, end, x in ((0.2, 3.1, -0.6), (3.3, 6.2, -0.6), (0.0, 6.4, -1.3)):
                self._dimension(start, end, x, is_vertical=True)

    def file(self, format: str = "PNG", **options: float) -> bytes:
        return picture_file(self.picture, format, **options)

    def _pixel(self, x: float, y: float) -> tuple[float, float]:
        return (x + self.margin_m) * self.px_per_m, self.picture.height - (y + self.margin_m) * self.px_per_m

    def _box(self, bounds: tuple[float, float, float, float], grey: int) -> None:
        x0, y0, x1, y1 = bounds
        self.pen.rectangle((*self._pixel(x0, y1), *self._pixel(x1, y0)), fill=grey)

    def _line(self, ends: tuple[float, float, float, float], width: int = 2) -> None:
        self.pen.line((*self._pixel(*ends[:2]), *self._pixel(*ends[2:])), fill=0, width=width)

    def _text(self, middle: tuple[float, float], text: str, degrees: float = 0.0) -> None:
        font = ImageFont.truetype(str(FONT), self.text_px)
        _, _, right, bottom = font.getbbox(text)
        label = Image.new("L", (int(right) + 6, int(bottom) + 6), 255)
        ImageDraw.Draw(label).text((3, 3), text, font=font, fill=0)
        label = label.rotate(degrees, expand=True)
        x, y = self._pixel(*middle)
        self.picture.paste(label, (round(x - 0.5 * label.width), round(y - 0.5 * label.height)))

    def _dimension(self, start: float, end: float, level: float, *, is_vertical: bool) -> None:
        """Draw a dimension, chained ones with slashes and those in all with a text that interrupts the line."""

        def turned(*numbers: float) -> tuple[float, float, float, float]:
            x0, y0, x1, y1 = numbers
            return (y0, x0, y1, x1) if is_vertical else (x0, y0, x1, y1)

        self._line(turned(start - 0.1, level, end + 0.1, level))
        for end_m in (start, end):
            self._line(turned(end_m, level - 0.15, end_m, level + 0.15), 1)
            self._line(turned(end_m - 0.08, level - 0.08, end_m + 0.08, level + 0.08), 3)
        middle, above = 0.5 * (start + end), level + (0.22 if level > -1.0 else 0.0) * (-1.0 if is_vertical else 1.0)
        position = (above, middle) if is_vertical else (middle, above)
        self._text(position, f"{end - start:.2f}", 90.0 if is_vertical else 0.0)


class OutlinedPlan(PrintedPlan):
    """The same flat as a PDF at 1:50 whose letters are drawn as areas, beside the number of the sheet as a text."""

    def __post_init__(self) -> None:
        sides_m = 9.3 + 2 * self.margin_m, 6.4 + 2 * self.margin_m
        self.figure = Figure(figsize=(sides_m[0] / 50 / 0.0254, sides_m[1] / 50 / 0.0254))
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set(xlim=(-self.margin_m, 9.3 + self.margin_m), ylim=(-self.margin_m, 6.4 + self.margin_m))
        self.axes.set_axis_off()
        super().__post_init__()

    def pdf(self, sheet: str) -> bytes:
        """Return the page with the number of the sheet in its corner."""
        self.axes.text(7.0, -1.6, sheet)
        stream = io.BytesIO()
        self.figure.savefig(stream, format="pdf")
        return stream.getvalue()

    def _box(self, bounds: tuple[float, float, float, float], grey: int) -> None:
        x0, y0, x1, y1 = bounds
        if grey == 0:
            self.axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color="black", linewidth=0.0))

    def _line(self, ends: tuple[float, float, float, float], width: int = 2) -> None:
        self.axes.plot(ends[::2], ends[1::2], "black", linewidth=0.3 * width)

    def _text(self, middle: tuple[float, float], text: str, degrees: float = 0.0) -> None:
        path = TextPath((0.0, 0.0), text, size=self.text_px / self.px_per_m, prop=FontProperties(fname=str(FONT)))
        box = path.get_extents()
        place = Affine2D().translate(-0.5 * (box.x0 + box.x1), -0.5 * (box.y0 + box.y1))
        path = path.transformed(place.rotate_deg(degrees).translate(*middle))
        self.axes.add_patch(PathPatch(path, color="black", linewidth=0.0))


def check_flat(plan: ImportedPlan, pixels_per_metre: float | None = None) -> None:
    names = {room["name"]: room["type"] for room in plan.document["rooms"]}
    assert names == {"Wohnzimmer": "living", "Küche": "kitchen", "Bedroom": "bedroom"}
    assert plan.report.scale_source.endswith("dimensions written in the drawing")
    areas_m2 = dict(zip(names, (shape.area for shape in shapes(plan.document)), strict=True))
    assert areas_m2 == pytest.approx(AREAS_M2, rel=0.04)
    assert any("the areas written in 3 rooms agree" in note for note in plan.report.notes)
    if pixels_per_metre:
        assert plan.report.metres_per_unit * pixels_per_metre == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(("px_per_m", "text_px"), [(40.0, 13), pytest.param(110.0, 30, marks=pytest.mark.slow)])
def test_printed_names_and_dimensions_of_a_picture_are_read(px_per_m: float, text_px: int):
    check_flat(import_plan(PrintedPlan(px_per_m, text_px).file(), limits=LIMITS), px_per_m)


@pytest.mark.slow
def test_straight_scan_with_noise_and_shadow_is_read():
    page = PrintedPlan(40.0, 13)
    grey = np.asarray(page.picture, dtype=float)
    rows, columns = grey.shape
    shadow = 1.0 - 0.4 * (np.linspace(0.0, 1.0, rows)[:, None] + np.linspace(0.0, 1.0, columns))
    noise = np.random.default_rng(0).normal(0.0, 5.0, grey.shape)
    page.picture = Image.fromarray(np.clip((20.0 + 0.9 * grey) * shadow + noise, 0, 255).astype(np.uint8))
    check_flat(import_plan(page.file(), limits=LIMITS), page.px_per_m)


@pytest.mark.slow
def test_printed_names_and_dimensions_of_a_scan_are_read():
    page = PrintedPlan()
    page.picture = page.picture.rotate(1.5, expand=True, fillcolor=255, resample=Image.Resampling.BICUBIC)
    plan = import_plan(page.file("PDF", resolution=100.0), limits=LIMITS)
    check_flat(plan, page.px_per_m * 72.0 / 100.0)
    assert "page 1 was read as a picture" in plan.report.notes


@pytest.mark.slow
def test_letters_that_a_pdf_draws_are_read_and_are_no_pillars():
    plan = import_plan(OutlinedPlan().pdf("Sheet A-101"), limits=LIMITS)
    check_flat(plan, 72.0 / 0.0254 / 50.0)
    assert plan.report.scale_source.startswith("6 dimensions")
    assert "page 1 was read as a picture" not in plan.report.notes
    assert not any("holes" in room for room in plan.document["rooms"])


def test_drawn_letters_are_no_pillars_where_texts_are_not_read(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lettering, "find_spec", lambda name: None)
    plan = import_plan(OutlinedPlan().pdf("1:50"))
    assert plan.report.scale_source == "1:50, written in the drawing"
    assert [room.get("holes") for room in plan.document["rooms"]] == [None] * 3


@pytest.mark.slow
def test_scale_that_contradicts_the_texts_gives_warnings():
    plan = import_plan(PrintedPlan().file(), ImportOptions(metres_per_pixel=0.02), LIMITS)
    assert plan.report.metres_per_unit == 0.02
    written, areas = plan.report.warnings
    assert "dimensions written in the drawing give 0.0142" in written or "give 0.0143" in written
    assert "written in 3 rooms give 0.0143" in areas or "written in 3 rooms give 0.0144" in areas
    assert "0.02 is used (option metres_per_pixel)" in areas


@pytest.mark.slow
def test_two_names_in_a_room_are_reported():
    page = PrintedPlan(dimensions=False)
    page._box((4.3, 3.1, 9.1, 3.3), 255)
    plan = import_plan(page.file(), ImportOptions(metres_per_pixel=1.0 / page.px_per_m), LIMITS)
    assert any("'Küche' and 'Bedroom' are written in one room of 29 m²" in line for line in plan.report.warnings)


def test_without_the_extra_texts_are_not_read(monkeypatch: pytest.MonkeyPatch):
    page = PrintedPlan(40.0, 13)
    monkeypatch.setattr(lettering, "find_spec", lambda name: None)
    with pytest.raises(InvalidFloorPlanError, match="the picture gives no scale"):
        import_plan(page.file())
    plan = import_plan(page.file(), ImportOptions(metres_per_pixel=1.0 / page.px_per_m))
    assert [room.get("name") for room in plan.document["rooms"]] == [None] * 3
    assert any("-e '.[ocr]'" in note for note in plan.report.notes)


def test_models_are_not_downloaded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(socket.socket, "connect", pytest.fail)
    lettering._reader.cache_clear()
    texts = read_texts(np.asarray(PrintedPlan(40.0, 13).picture), ReportBuilder(), Budget(LIMITS))
    assert {"Küche", "9.30"} <= {text.text for text in texts.drawing.letterings}


def test_reading_texts_ends_with_its_share_of_the_time():
    picture = Image.new("L", (1200, 900), 255)
    pen, font = ImageDraw.Draw(picture), ImageFont.truetype(str(FONT), 24)
    for y in range(0, 900, 60):
        for x in range(0, 1200, 300):
            pen.text((x + 20, y + 10), f"Room {x // 300} {y // 60}", font=font, fill=0)
    clock, builder = count(), ReportBuilder()
    budget = Budget(ImportLimits(max_import_s=9.0), lambda: float(next(clock)))
    texts = read_texts(np.asarray(picture), builder, budget).drawing.letterings
    (warning,) = builder.warnings
    assert f"{len(texts)} of 60 texts were read" in warning
    assert 0 < len(texts) < 60
    assert budget.elapsed_s < 9.0


def test_lines_that_are_both_beside_a_high_text_are_joined_from_left_to_right():
    runs = [(100.0, 130.0, 50.0, 1), (5.0, 40.0, 50.0, 1)]
    assert lettering._join_runs(runs, [np.array([60.0, 0.0, 70.0, 100.0])]) == [(5.0, 130.0, 50.0, 1)]


@pytest.mark.slow
def test_lack_of_memory_leaves_the_rooms_without_names(tmp_path: Path):
    page = PrintedPlan()
    (tmp_path / "plan.png").write_bytes(page.file())
    program = f"""
from lalaloc_core.importers import ImportOptions, import_plan
from lalaloc_core.importers.picture import lettering
from service.workers.process import limit_memory
import onnxruntime, rapidocr.main, lalaloc_core.importers.formats.picture
limit_memory(200 * 2**20)
content = open({str(tmp_path / "plan.png")!r}, "rb").read()
plan = import_plan(content, ImportOptions(metres_per_pixel={1.0 / page.px_per_m}))
print(len(plan.document["rooms"]), *plan.report.warnings)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("3 texts were not read")
