"""Texts in pictures and scans by optical character recognition (OCR), and the lines that dimensions are written at.

The extra `ocr` brings the library and its models; nothing is downloaded. Without it, no text is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from jaxtyping import Float, UInt8

from lalaloc_core.errors import install_command
from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.geometry import point_xy
from lalaloc_core.importers.drawing.enclosed_rooms import without_overlaps
from lalaloc_core.importers.drawing.vector_drawing import Drawing, Lettering, Stroke
from lalaloc_core.importers.picture.ink import Gray, Ink, boxes_of_parts, read_ink

# Side (pixels) of a tile, which takes about 0.8 GB of address space, and longer side of the picture that is read.
_TILE_PX, _OVERLAP_PX = 1280, 256
_SMALLEST_PX, READ_PX = 1200, 2 * _TILE_PX - _OVERLAP_PX
# A picture is read as one tile first, and in several if a text is lower than this.
_LEGIBLE_PX = 18
# Heights (pixels) of letters in a picture as one tile, and their largest width: letters of a word can touch.
_LETTER_PX, _WORD_WIDTH = (3, 120), 15
# Texts are read in batches until this share of the import's time is over.
_SHARE_OF_TIME, _BATCH = 0.5, 6
_MIN_SCORE, _MAX_LENGTH, _MAX_TEXTS = 0.7, 200, 400
# Assumed length (m) of the longer side, for the thresholds of `read_ink`; texts are read before the scale is known.
_ASSUMED_M = 25.0
# Characters that are read for others: a letter, quotes in feet and inches, wide forms.
_ALIKE = str.maketrans({"$": "s", "’": "'", "‘": "'", "`": "'", "”": '"', "“": '"', "㎡": "m²", "，": ",", "：": ":",
                        "（": "(", "）": ")", "×": "x"})  # fmt: skip
# Lines of dimensions: shortest length and largest width as shares of the longer side, and reach of marks across them.
_SHORTEST, _WIDEST, _MARK_PX = 0.02, 0.006, 4
_MAX_LINES, _MAX_MARKS = 1500, 40
Pixels = UInt8[np.ndarray, "_ _ 3"]
# Corners of a text in pixels, and with its outline and its part of the picture. A horizontal line: its ends, its middle
# row and its height.
Corners = Float[np.ndarray, "4 2"]
_Part = tuple[shapely.Polygon, Corners, Pixels]
_Run = tuple[float, float, float, int]


@dataclass(frozen=True)
class PictureTexts:
    """Texts of a picture and the thin lines near them, from its middle, with y up.

    Attributes:
        drawing: texts and lines.
        size: width and height of the picture, in the same unit: pixels, or points of a page.
        outlines: corners of each text.
    """

    drawing: Drawing = field(default_factory=Drawing)
    size: tuple[float, float] = (0.0, 0.0)
    outlines: list[Corners] = field(default_factory=list)

    def scaled(self, factor: float) -> PictureTexts:
        """Return the texts in another unit."""
        width, height = self.size
        outlines = [corners * factor for corners in self.outlines]
        return PictureTexts(self.drawing.scaled(factor, flip_y=False), (width * factor, height * factor), outlines)

    def placed(self, factor: float) -> list[Lettering]:
        """Return the texts in another unit, from the picture's lower left corner, as `sketch_picture` places rooms."""
        corner = 0.5 * factor * np.array(self.size)
        texts = self.drawing.scaled(factor, flip_y=False).letterings
        return [replace(text, position=point_xy(text.position + corner)) for text in texts]


def read_texts(gray: Gray, builder: ReportBuilder, budget: Budget, *, straighten: bool = True) -> PictureTexts:
    """Return the texts of a picture whose rows are from the top; none if the extra `ocr` is not installed.

    The picture is straightened by the skew of its lines unless told not to.
    """
    rows, columns = gray.shape
    found = PictureTexts(size=(float(columns), float(rows)))
    if find_spec("rapidocr") is None:
        builder.notes.append(f"texts were not read: name the rooms, or run {install_command('ocr')}")
        return found
    budget.begin("reading texts")
    try:
        factor, ink = _resized_ink(gray, _TILE_PX, straighten=straighten)
        has_letters = _has_letters(ink)
        parts = _boxes(ink, builder, budget) if has_letters else []
        is_small = has_letters and min((_height(box) for _, box, _ in parts), default=0.0) < _LEGIBLE_PX
        if max(rows, columns) > _TILE_PX and is_small and _share_of_time(budget) < _SHARE_OF_TIME / 3.0:
            finer_factor, finer = _resized_ink(gray, READ_PX, straighten=straighten)
            if len(finer_parts := _boxes(finer, builder, budget)) >= len(parts):
                factor, ink, parts = finer_factor, finer, finer_parts
        boxes = _texts(parts, builder, budget)
    except MemoryError:
        builder.warnings.append(
            "texts were not read for lack of memory: name the rooms, or raise the limit (LALALOC_IMPORT_MEMORY_BYTES)"
        )
        return found
    middle = 0.5 * np.array(ink.mask.shape[::-1])

    def from_middle(points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        return (points - middle) * [1.0, -1.0] / factor

    for text, box in boxes:
        place = point_xy(from_middle(box.mean(axis=0)))
        found.drawing.letterings.append(Lettering(text, place, height=_height(box) / factor, is_ocr=True))
        found.outlines.append(from_middle(box))
    if boxes:
        lines = _thin_lines(ink, [box for _, box in boxes])
        found.drawing.strokes += [Stroke(shapely.transform(line, from_middle), "", None, 0.0) for line in lines]
        budget.check_time()
    builder.notes.append(f"{len(boxes)} texts of the picture were read")
    return found


def _resized_ink(gray: Gray, longest_px: int, *, straighten: bool) -> tuple[float, Ink]:
    """Return the factor between a picture and its ink, whose longer side is at most `longest_px`."""
    rows, columns = gray.shape
    factor = float(np.clip(max(rows, columns), _SMALLEST_PX, longest_px)) / max(rows, columns)
    size = (max(1, round(columns * factor)), max(1, round(rows * factor)))
    resized = cv2.resize(gray, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC)
    return factor, read_ink(resized.astype(np.uint8), _ASSUMED_M / max(size), straighten=straighten)


def _has_letters(ink: Ink) -> bool:
    """Return whether anything in a picture has the size of letters; looking for texts takes seconds."""
    # Texts can be upright.
    short, long = np.sort(boxes_of_parts(ink.lines)[:, 2:], axis=1).T
    return bool(((short >= _LETTER_PX[0]) & (short <= _LETTER_PX[1]) & (long <= _WORD_WIDTH * short)).any())


def _height(box: Corners) -> float:
    return min(float(np.hypot(*(box[1] - box[0]))), float(np.hypot(*(box[2] - box[1]))))


class _Reader:
    """Detection and recognition of texts with the models that their package contains, on one thread."""

    def __init__(self) -> None:
        import rapidocr
        from onnxruntime.capi.onnxruntime_pybind11_state import Fail, RuntimeException
        from rapidocr.inference_engine.onnxruntime import ONNXRuntimeError

        self._failures = (Fail, RuntimeException, ONNXRuntimeError, cv2.error)
        folder = Path(rapidocr.__file__).parent / "models"
        self._engine: Any = rapidocr.RapidOCR(
            params={
                # A model that is named is not searched for or downloaded.
                "Det.model_path": str(folder / "PP-OCRv6_det_small.onnx"),
                "Cls.model_path": str(folder / "ch_ppocr_mobile_v2.0_cls_mobile.onnx"),
                "Rec.model_path": str(folder / "PP-OCRv6_rec_small.onnx"),
                "Det.limit_type": "max",
                "Det.limit_side_len": _TILE_PX,
                "Det.max_candidates": _MAX_TEXTS,
                "EngineConfig.onnxruntime.intra_op_num_threads": 1,
                "EngineConfig.onnxruntime.inter_op_num_threads": 1,
                "Global.use_vertical_padding": False,
                "Global.log_level": "critical",
            }
        )

    def boxes(self, tile: Pixels) -> list[tuple[Corners, Pixels]]:
        """Return the corners of the texts in a tile, each with its part of the picture, turned to be level."""
        with self._checked():
            found = self._engine(tile, use_cls=False, use_rec=False)
        if getattr(found, "boxes", None) is None:
            return []
        boxes = np.asarray(found.boxes, dtype=np.float32)
        return list(zip(boxes.astype(float), self._engine.crop_text_regions(tile, boxes), strict=True))

    def texts(self, crops: Sequence[Pixels]) -> list[str]:
        """Return the text of each part, empty if it is unsure. Parts may be upside down."""
        with self._checked():
            turned, _ = self._engine.cls_and_rotate(list(crops))
            read = self._engine.recognize_txt(turned)
        return [_clean(text) if score >= _MIN_SCORE else "" for text, score in zip(read.txts, read.scores, strict=True)]

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Raise MemoryError for the errors that a lack of memory causes in the libraries."""
        try:
            yield
        except self._failures as error:
            raise MemoryError from error


_reader = cache(_Reader)


def _texts(parts: Sequence[_Part], builder: ReportBuilder, budget: Budget) -> list[tuple[str, Corners]]:
    """Return the texts with their corners in pixels."""
    found: list[tuple[str, Corners]] = []
    for begin in range(0, len(parts), _BATCH):
        if begin and _share_of_time(budget) > _SHARE_OF_TIME:
            builder.warnings.append(
                f"{begin} of {len(parts)} texts were read, as reading them may take half of "
                f"{budget.limits.max_import_s:g} s (max_import_s); name the other rooms"
            )
            break
        batch = parts[begin : begin + _BATCH]
        texts = _reader().texts([crop for _, _, crop in batch])
        found += [(text, box) for text, (_, box, _) in zip(texts, batch, strict=True) if text]
    return found


def _boxes(ink: Ink, builder: ReportBuilder, budget: Budget) -> list[_Part]:
    """Return the texts of all tiles before they are read; one that a tile cuts is also in the next, as a whole."""
    rows, columns = ink.gray.shape
    parts: list[_Part] = []
    for index, (y, x) in enumerate((y, x) for y in _starts(rows) for x in _starts(columns)):
        tile = slice(y, y + _TILE_PX), slice(x, x + _TILE_PX)
        if not ink.mask[tile].any():
            continue
        if index and _share_of_time(budget) > 0.5 * _SHARE_OF_TIME:
            builder.warnings.append("texts in a part of the picture were not read, for lack of time; name its rooms")
            break
        for box, crop in _reader().boxes(cv2.cvtColor(ink.gray[tile], cv2.COLOR_GRAY2BGR)):
            placed = box + np.array([x, y])
            parts.append((shapely.Polygon(placed), placed, crop))
    return _whole_texts([part for part in parts if part[0].is_valid])[:_MAX_TEXTS]


def _share_of_time(budget: Budget) -> float:
    return budget.elapsed_s / budget.limits.max_import_s


def _starts(length: int) -> list[int]:
    """Return the beginnings of tiles that overlap and cover a length."""
    count = max(math.ceil((length - _OVERLAP_PX) / (_TILE_PX - _OVERLAP_PX)), 1)
    return np.linspace(0, max(length - _TILE_PX, 0), count).round().astype(int).tolist()


def _whole_texts(parts: Sequence[_Part]) -> list[_Part]:
    """Return the largest of parts that overlap, in the order of the picture."""
    order = sorted(range(len(parts)), key=lambda k: -parts[k][0].area)
    kept = without_overlaps([parts[index][0] for index in order], 0.5)
    return [parts[index] for index in sorted(order[place] for place in kept)]


def _clean(text: str) -> str:
    """Return the text without what lines beside it are read as; a single letter is a crossing of lines."""
    text = " ".join(text.translate(_ALIKE).split()).strip(" -–—_|*")[:_MAX_LENGTH]
    return text if sum(map(str.isalpha, text)) > 1 or any(map(str.isdigit, text)) else ""


def _thin_lines(ink: Ink, texts: Sequence[Corners]) -> list[shapely.LineString]:
    """Return thin horizontal and vertical lines, and short lines for the marks across them, in pixels.

    A line that a text interrupts is one line.
    """
    mask = ink.lines.astype(np.uint8)
    for box in texts:
        cv2.fillConvexPoly(mask, np.round(box).astype(np.int32), 0)
    lines: list[shapely.LineString] = []
    marks: list[shapely.LineString] = []
    # Columns and rows change places for vertical lines.
    for turned_mask, axes in ((mask, [0, 1]), (np.ascontiguousarray(mask.T), [1, 0])):
        spans = [np.concatenate([box.min(axis=0)[axes], box.max(axis=0)[axes]]) for box in texts]
        for x0, x1, y, height in _join_runs(_runs(turned_mask), spans):
            lines.append(shapely.LineString(np.array([(x0, y), (x1, y)])[:, axes]))
            marks += [
                shapely.LineString(np.array([(x, y - 2 * _MARK_PX), (x, y + 2 * _MARK_PX)])[:, axes])
                for x in _marks(turned_mask, x0, x1, round(y - 0.5 * height), height)
            ]
    # A tick is a line itself, and its mark is part of the line that it crosses.
    if not marks:
        return lines
    tree = shapely.STRtree(lines)
    mark, line = tree.query(marks, predicate="intersects")
    shared = shapely.intersection(np.array(marks)[mark], tree.geometries[line])
    along = set(mark[shapely.length(shared) > 0.0].tolist())
    return lines + [mark for index, mark in enumerate(marks) if index not in along]


def _runs(mask: Gray) -> list[_Run]:
    """Return the longest thin horizontal lines."""
    shortest, widest = (round(share * max(mask.shape)) for share in (_SHORTEST, _WIDEST))
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((1, shortest), np.uint8))
    boxes = boxes_of_parts(opened)
    longest = sorted(boxes[boxes[:, 3] <= widest], key=lambda box: -box[2])[:_MAX_LINES]
    return [(float(x), float(x + width), y + 0.5 * height, int(height)) for x, y, width, height in longest]


def _join_runs(runs: Sequence[_Run], texts: Sequence[Float[np.ndarray, "4"]]) -> list[_Run]:
    """Return the lines, with the two beside a text (x0, y0, x1, y1) that interrupts them as one."""
    runs = list(runs)
    for x0, y0, x1, y1 in texts:
        reach = 1.5 * (y1 - y0)
        level = [run for run in runs if y0 < run[2] < y1]
        left = [run for run in level if x0 - reach <= run[1] <= x0 + 0.5 * reach]
        right = [run for run in level if x1 - 0.5 * reach <= run[0] <= x1 + reach]
        # Lines can be within reach of both sides of a high, narrow text; the left one ends first.
        pairs = [(a, b) for a in left for b in right if abs(a[2] - b[2]) <= 2.0 and a[1] <= b[0]]
        if pairs:
            a, b = pairs[0]
            runs = [run for run in runs if run is not a and run is not b]
            runs.append((a[0], b[1], a[2], max(a[3], b[3])))
    return runs


def _marks(mask: Gray, x0: float, x1: float, top: int, height: int) -> list[float]:
    """Return the columns where ink crosses a horizontal line: ticks, slashes and lines on both sides of it."""
    rows = top - _MARK_PX, top + height + _MARK_PX - 1
    if rows[0] < 0 or rows[1] >= mask.shape[0]:
        return []
    reach = np.ones((1, 2 * _MARK_PX + 1), np.uint8)
    begin, end = max(int(x0) - 2 * _MARK_PX, 0), min(int(x1) + 2 * _MARK_PX, mask.shape[1])
    above, below = (cv2.dilate(mask[row : row + 1, begin:end], reach)[0] for row in rows)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], above & below, [0]])))
    spans = edges.reshape(-1, 2)[:_MAX_MARKS]
    middles = [begin + 0.5 * (first + last) for first, last in spans if last - first <= 6 * _MARK_PX]
    return [float(np.clip(middle, x0, x1)) for middle in middles]
