"""Scale of drawings: read from the options, the file, or its dimensions, which are lengths written at lines.

Without any, `scale_guess.py` estimates it; the assumption is reported.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import extent_of, lines_of, segments_of, side_lengths
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import SketchedRoom
from lalaloc_core.importers.drawing.vector_drawing import Drawing, Lettering

_WRITTEN = re.compile(r"(?<![\d.,])(?<!\d:)1\s?[:/]\s?(\d{1,4})(?![\d:]|[.,]\d)")
# 1/4" = 1'-0", 1" = 20'.
_INCHES = re.compile(
    r"(?<![\d./])(?<!\d[ -])([1-9]\d?)(?:/([1-9]\d?))?\s?(?:[\"″”“]|''|in\b\.?)\s?=\s?"
    r"(\d{1,3})\s?(?:['′’]|ft\b\.?)(?:\s?-?\s?0\s?(?:[\"″”“]|''|in\b\.?))?"
)
# Longer sides of sheets (m), and a scale that is for one of them: "1:50 @ A1", "1:100 (A3)", "Scale at A1: 1:50".
_SHEETS_M = {"A0": 1.189, "A1": 0.841, "A2": 0.594, "A3": 0.42, "A4": 0.297, "ARCH D": 0.914, "ARCH E": 1.219,
             "ARCH C": 0.61, "ARCH B": 0.457, "ANSI A": 0.279, "ANSI B": 0.432, "ANSI C": 0.559, "ANSI D": 0.864,
             "ANSI E": 1.118, "11 X 17": 0.432, "18 X 24": 0.61, "22 X 34": 0.864, "24 X 36": 0.914, "30 X 42": 1.067,
             "36 X 48": 1.219}  # fmt: skip
_SCALE, _FOR = (
    r"1\s?[:/]\s?(\d{1,4})\b",
    r"\W{0,3}(?:(?:at|on|auf|sur|en|su|in|im|op|din|iso|format|formato|original|papier|paper|sheet|size|half|full|print|"
    r"blatt|plotted|printed)\b\W{0,3}){0,4}",
)
_SHEET = rf"\b({'|'.join(_SHEETS_M)})(?!\w|[.-]\w)".replace(" X ", "\\W{0,3}X\\W{0,2}")
_AT_SHEET = re.compile(rf"{_SCALE}{_FOR}{_SHEET}|(?:{_SHEET}{_FOR}{_SCALE}|(?:scale|@){_FOR}{_SHEET})", re.IGNORECASE)
# Common scales of building drawings.
_USUAL = {10, 20, 24, 25, 32, 33, 48, 50, 64, 75, 96, 100, 120, 125, 128, 150, 192, 200, 240, 250, 300, 400, 500, 1000}
# "4.20", "4,205 m", "420", "4200 mm".
_METRIC = re.compile(r"(\d{1,3}[.,]\d{1,3}|\d{1,5})\s*(m|cm|mm|)")
_IMPERIAL = re.compile(r"(\d{1,3})\s*['′]\s*-?\s*(?:(\d{1,2})\s*[\"″]?)?")
# Sides of a room: "11'5\" x 12'9\"", "9 ft 6 in by 13 ft", "13' X 8'6", "4.84m (max) x 5.52m", "5,0x3,6", "425 x 385".
# Small print loses marks: "117\"" is 11'7", and "6.28.4" is 6.2 x 8.4.
_UNIT_ENDS = r"(?![^\W\dxх])\.?"
_FEET = (
    rf"(\d{{1,2}}|\d{{1,2}}[.,]\d{{1,2}}(?=\s?['′’]))\s?(?:(?:['′’‘`´]|f(?:oo|ee)?t{_UNIT_ENDS})\s?[-,]?\s?)?"
    rf"(?:(1[01]|\d)(?!\d)\s?(?:[¼½¾]|\d/\d)?\s?(?:[\"″”“]|''|in(?:ch(?:es)?)?{_UNIT_ENDS})?)?(?!\s?[cm]?m\b)"
)
_METRES = rf"(\d{{1,2}}[.,]\d{{1,3}}|\d{{1,5}})\s?(?:(mm|cm|m|м)(?:trs?|ts|et(?:re|er)s?)?{_UNIT_ENDS})?"
_MAX = r"(?:\s?(?:\([^()]{1,15}\)|(?:max|min|[wldbht])\b\.?))?"
_TIMES = rf"{_MAX}\s?(?:[x×х✕*]|by\b|par\b){_MAX}\s?"
_JOINED = r"(?<=[.,]\d)(?=\d{1,2}[.,]\d\b)|(?<=[.,]\d\d)(?=\d{1,2}[.,]\d\d\b)"
_IN_FEET, _IN_METRES = (
    re.compile(rf"\(?(?<![\d.,]){side}(?:{times}){side}(?![.,]?\d){_MAX}\)?", re.IGNORECASE)
    for side, times in ((_FEET, _TIMES), (_METRES, f"{_TIMES}|{_JOINED}"))
)
# Whole numbers without a mark are feet in this range; other ones are sides only if they are longer (m) than beds and
# doors, whose sizes are written alike.
_MARK_OF_FEET = re.compile(r"['′’‘`´\"″”“]|f(?:oo|ee)?t|(?<!m)in", re.IGNORECASE)
_WHOLE_FEET, _LONGER_THAN_BEDS_M = {str(feet) for feet in range(5, 31)}, 2.2
# Whole numbers without a unit are millimetres from here on, and centimetres or millimetres below it.
_SURELY_MM = 1000
_LENGTH_M = (0.2, 200.0)
# A dimension is written nearer to its line than this share of the drawing, and away from the ends of the line.
_NEAR, _ENDS = 0.02, 0.15
# The distance can also be this multiple of its height.
_NEAR_HEIGHTS = 1.0
_MAX_TEXTS, _MAX_LINES_PER_TEXT, _MAX_PIECES = 1000, 12, 60_000
# Ratios within this share agree. So many dimensions of different lengths must agree, and twice as many as on any other
# ratio.
_AGREE, _MIN_AGREEING, _MIN_LENGTHS, _MARGIN = 0.01, 3, 2, 2
# Area written in a room, and its range (m²). Russian is read in Latin letters.
_AREA = re.compile(
    r"\(?(?:\b(?:ca|approx|a)\b\s?[.:=]?\s?|(?<![\d.,x×]))(\d{1,4}(?:[.,]\d{1,2})?)\s*"
    r"([mм][²2]|qm|kvm|[kкκ][bв]\.? ?[mм]|sq\.? ?m(?:et(?:re|er)s?)?|(?:sq\.? ?(?:ft|feet)|sf|ft[²2]))(?![a-zа-я])\)?",
    re.IGNORECASE,
)
_SQUARE_FOOT_M2, _AREA_M2 = 0.3048**2, (0.5, 2000.0)
# Range of sides of rooms (m), difference of the logs of ratios of sides of one shape, and the share by which an area in
# two units differs.
_SIDE_M, _SAME_RATIO, _SAME_AREA = (0.6, 40.0), 0.15, 0.08
# Rooms whose areas or sides must be written for a warning.
_MIN_AREAS = 2
_TOLERANCE, _AREA_TOLERANCE = 0.05, 0.25
# Usual size of a drawing (m).
_EXTENT_M = (3.0, 300.0)
# Length of a unit of any drawing (m).
_METRES_PER_UNIT = (1e-9, 1e4)

# Text of a dimension, and the lengths in units of the drawing that it may be about; metres per unit and their source.
Dimension, Scale = tuple[str, Sequence[float]], tuple[float, str]


def drawing_scale(
    options: ImportOptions,
    subject: str,
    drawings: Sequence[Drawing] = (),
    check_time: CheckTime = lambda: None,
    *,
    paper_m_per_unit: float | None = None,
    paper_m: float | None = None,
    own: Scale | None = None,
    guess: Callable[[Sequence[Scale]], Scale | None] = lambda written: None,
) -> Scale:
    """Return metres per unit of a drawing, and the source of that value.

    The options take precedence, then the file's `own` value with its source, then "1:100" in a text of the drawings if
    a unit has a length on paper (also "1:50 @ A1", on a page whose longer side is `paper_m`), then the dimensions of
    the first drawing that has them, then the `guess`, which is given the scales that are written if they are several.
    `subject` names the file in the error message, and `check_time` raises an exception to stop. The option `multiply`
    multiplies any of them.
    """

    def checked(metres_per_unit: float, source: str) -> Scale:
        low, high = _METRES_PER_UNIT
        if not low <= metres_per_unit <= high:
            raise InvalidFloorPlanError(
                f"{subject} has {metres_per_unit:g} m per unit ({source}); the limits are {low:g} and {high:g}; "
                "correct its size, or set metres_per_pixel"
            )
        return metres_per_unit, source

    def given() -> Scale:
        if options.known_distance is not None:
            return options.known_distance.metres_per_unit, "option known_distance"
        if options.metres_per_pixel is not None:
            return options.metres_per_pixel, "option metres_per_pixel"
        if options.scale is not None:
            if paper_m_per_unit is None:
                raise InvalidFloorPlanError(
                    f"{subject} has no size on paper, so scale=1:{options.scale:g} cannot be used; "
                    "set metres_per_pixel or known_distance instead"
                )
            return checked(options.scale * paper_m_per_unit, "option scale")
        if options.units is not None:
            return METRES_PER_UNIT[options.units], "option units"
        if own is not None:
            return checked(*own)
        texts = [lettering.text for drawing in drawings for lettering in drawing.letterings]
        written = _written_scales(texts, paper_m or math.inf)
        on_paper = [(ratio * paper_m_per_unit, source) for ratio, source in written if paper_m_per_unit is not None]
        if on_paper and max(on_paper)[0] <= (1.0 + _TOLERANCE) * min(on_paper)[0]:
            return checked(*on_paper[0])
        drawn = (drawing for drawing in drawings if drawing.shapes)
        by_dimensions = (scale_by_dimensions(written_dimensions(part, check_time), part.extent) for part in drawn)
        if found := next(filter(None, by_dimensions), None) or guess(on_paper):
            return checked(*found)
        hint = f" ({written[0][1]}, but it has no size on paper)" if written and not on_paper else ""
        hint = f" ({' and '.join(source for _, source in on_paper)})" if on_paper else hint
        if sizes := [text for text in texts if _has_size(text)]:
            hint += f" ({len(sizes)} texts such as '{sizes[0][:50]}' are sizes of rooms, but no two rooms have these)"
        raise InvalidFloorPlanError(
            f"{subject} gives no scale{hint}, and too few doors, stairs, areas or dimensions are found to estimate it: "
            "set scale (1:100), metres_per_pixel (metres per unit of the drawing) or known_distance (x0, y0, x1, y1, "
            "metres)"
        )

    factor, source = given()
    if options.multiply is None:
        return factor, source
    return checked(factor * options.multiply, f"{source}, times {options.multiply:g} (option multiply)")


def _written_scales(texts: Sequence[str], paper_m: float) -> list[Scale]:
    """Return the denominators of the scales written, for a page with the longer side `paper_m`, and their sources."""

    def ratio(inches: re.Match[str]) -> str:
        return f"1:{12 * int(inches[3]) * int(inches[2] or 1) / int(inches[1]):g}"

    texts = [_INCHES.sub(ratio, text) for text in texts]
    scales = {int(match) for text in texts for match in _WRITTEN.findall(text)} & _USUAL
    # A page of no sheet's size is a part of one.
    is_sheet = any(abs(size_m / paper_m - 1.0) <= _TOLERANCE for size_m in _SHEETS_M.values())
    sheets: dict[int, tuple[str, float]] = {}
    for_sheets = [found for text in texts if is_sheet for found in _AT_SHEET.findall(text)]
    for number, first, second, other, third in for_sheets:
        name = re.sub(r"(?<=\d)\W*X\W*", " X ", " ".join((first or second or third).upper().split()))
        for scale in scales & {int(number or other)} if number or other else scales:
            sheets.setdefault(scale, (name, _SHEETS_M[name] / paper_m))
    own = {scale for scale, (_, larger) in sheets.items() if abs(larger - 1.0) <= _TOLERANCE}
    sizes = [scale * larger for scale, (_, larger) in sheets.items()]
    # "1:50 @ A1 / 1:100 @ A3" is one scale.
    if len(scales) > 1 and sheets.keys() == scales and (own or max(sizes) <= (1.0 + _TOLERANCE) * min(sizes)):
        scales = own or {min(scales)}
    found = []
    for scale in sorted(scales):
        name, larger = ("", 1.0) if scale in own else sheets.get(scale, ("", 1.0))
        source = f"1:{scale}, written in the drawing" + (f" for {name}, {larger:.3g} times the page" if name else "")
        found.append((scale * larger, source))
    return found


def scale_by_dimensions(dimensions: Sequence[Dimension], extent: float) -> Scale | None:
    """Return metres per unit that most dimensions agree on, and their number in words; None if too few agree.

    `extent` is the size of the drawing in its units.
    """
    votes = [
        (math.log(value_m / length), index, value_m)
        for index, (text, lengths) in enumerate(dimensions)
        for value_m in values_m(text)
        for length in lengths
        if length > 0.0 and _EXTENT_M[0] <= extent * value_m / length <= _EXTENT_M[1]
    ]
    best = _agreeing_votes(votes)
    middle = float(np.median([vote[0] for vote in best])) if best else 0.0
    count = len({index for _, index, _ in best})
    others = _agreeing_votes([vote for vote in votes if abs(vote[0] - middle) > 3.0 * _AGREE])
    lengths = {round(value_m, 2) for _, _, value_m in best}
    if count < max(_MIN_AGREEING, _MARGIN * len({index for _, index, _ in others})) or len(lengths) < _MIN_LENGTHS:
        return None
    return math.exp(middle), f"{count} dimensions written in the drawing"


def check_scale(metres_per_unit: float, source: str, measured: Scale | None, builder: ReportBuilder) -> None:
    """Warn if a scale differs from that of the sizes that are written in the drawing, `measured`."""
    if measured is not None and abs(metres_per_unit / measured[0] - 1.0) > _TOLERANCE:
        builder.scale_factor = measured[0] / metres_per_unit
        builder.warnings.append(
            f"{measured[1]} give {measured[0]:.4g} m per unit, and {metres_per_unit:.4g} is used ({source}); check "
            f"both, or set multiply={builder.scale_factor:.3f} to believe what is written"
        )


def reject_dimensions(dimensions: Sequence[Dimension], metres_per_unit: float, builder: ReportBuilder) -> None:
    """Report the texts that look like dimensions and are not as long as a line beside them, at the scale in use."""
    for text, lengths in dimensions:
        values = values_m(text)
        # Whole numbers without a unit can be anything.
        is_length = not text.strip().isdigit()
        lines_m = [length * metres_per_unit for length in lengths]
        if is_length and not any(abs(line_m / value - 1.0) <= _TOLERANCE for line_m in lines_m for value in values):
            nearest = min(lines_m, key=lambda line_m: min(abs(math.log(line_m / value)) for value in values))
            builder.rejected_texts.append(
                f"'{text[:50]}' was read as a dimension of {values[0]:.4g} m; the likeliest line beside it is "
                f"{nearest:.2f} m long"
            )


def check_areas(
    rooms: Sequence[SketchedRoom], texts: Sequence[Sequence[str]], outside: Sequence[str], builder: ReportBuilder
) -> None:
    """Compare the sizes of rooms with those written in them, `texts` of every room; `outside` are texts in no room."""
    areas = _written_areas([room.shape for room in rooms], texts)
    shares = {index: area_m2 / written_m2 for index, (written_m2, area_m2) in areas.items()}
    middle = float(np.median([*shares.values()] or [1.0]))
    agreeing = [index for index, share in shares.items() if abs(share / middle - 1.0) <= _AREA_TOLERANCE]
    is_sure, length = len(agreeing) >= _MIN_AREAS, math.sqrt(middle)
    # Without sizes that agree, the scale is believed.
    usual, tolerance = (middle, _AREA_TOLERANCE) if is_sure else (1.0, 0.1)
    against = {
        f"{areas[index][0]:.4g} m² was read as the area of a room of {areas[index][1]:.1f} m²"
        + (f" ('{rooms[index].name}')" if rooms[index].name else ""): rooms[index].shape
        for index, share in shares.items()
        if abs(share / usual - 1.0) > tolerance
    }
    for index, written in enumerate([*texts, outside]):
        # Open rooms have the sizes of their parts; a single size that does not fit is a contradiction.
        unused = [f"'{text[:50]}'" for text in written if index not in areas and _has_size(text)]
        reason = "does not fit its room" if len(unused) == 1 else "is one of several in a room"
        reason = reason if index < len(rooms) else "is in no room"
        lines = [f"{text} was read as the size of a room, but {reason}" for text in unused]
        placed = dict.fromkeys(lines, rooms[index].shape) if index < len(rooms) else {}
        builder.places |= placed
        if len(placed) == 1:
            against |= placed
        else:
            builder.rejected_texts += lines
    if not is_sure:
        builder.rejected_texts += against
        builder.places |= against
        return
    agreed = f"against {len(agreeing)} sizes that agree; check its walls"
    against = {f"{text}, {agreed}": place for text, place in against.items()}
    builder.warnings += against
    builder.places |= against
    if abs(length - 1.0) <= _TOLERANCE:
        builder.notes.append(f"the areas written in {len(shares)} rooms agree with the scale")
    measured = builder.metres_per_unit / length, f"the areas and sides written in {len(agreeing)} rooms"
    check_scale(builder.metres_per_unit, builder.scale_source, measured, builder)


def areas_of_rooms(shapes: Sequence[shapely.Polygon], written: Sequence[Lettering]) -> dict[int, tuple[float, float]]:
    """Return the area (m²) that is written in each room, and the room's area, by the index of the room."""
    texts, _ = texts_of_rooms(shapes, written)
    return _written_areas(shapes, [[lettering.text for lettering in found] for found in texts])


def texts_of_rooms(
    shapes: Sequence[shapely.Polygon], letterings: Sequence[Lettering]
) -> tuple[list[list[Lettering]], list[Lettering]]:
    """Return the texts in each room, those in several rooms with the smallest, and the texts in none."""
    tree, outside = shapely.STRtree(shapes), list[Lettering]()
    inside: list[list[Lettering]] = [[] for _ in shapes]
    for lettering in letterings:
        around = tree.query(shapely.Point(lettering.position), predicate="within")
        texts = inside[min(around, key=lambda index: shapes[index].area)] if len(around) else outside
        texts.append(lettering)
    return inside, outside


def _written_areas(shapes: Sequence[shapely.Polygon], texts: Sequence[Sequence[str]]) -> dict[int, tuple[float, float]]:
    """Return the area (m²) that is written in each room, and the room's; sides are those of the box around a room."""
    found: dict[int, tuple[float, float]] = {}
    for index, (shape, written) in enumerate(zip(shapes, texts, strict=True)):
        areas = [area for text in written for area in _areas_m2(text)]
        pairs = [pair for text in written if (pair := sides_m(text))]
        short, long = side_lengths(shape)
        like = [short > 0.0 and abs(math.log(max(a, b) / min(a, b) * short / long)) <= _SAME_RATIO for a, b in pairs]
        sizes = areas or ([math.prod(pair) for pair in pairs] if all(like) else [])
        # A room with several sizes is several rooms, or one is that of the flat; two can be one in two units.
        if 1 <= len(sizes) <= 2 and max(sizes) <= (1.0 + _SAME_AREA) * min(sizes):
            found[index] = float(np.mean(sizes)), shape.area if areas else short * long
    return found


def sides_m(text: str) -> tuple[float, float] | None:
    """Return the two sides (m) of a room that a text states, such as 11'5" x 12'9", or "4.84m x 5.52m"."""
    sides: list[float] = []
    match = _IN_FEET.search(text)
    if match and (
        _MARK_OF_FEET.search(match[0]) or ({match[2], match[4]} == {None} and {match[1], match[3]} <= _WHOLE_FEET)
    ):
        sides = [METRES_PER_UNIT["ft"] * (_number(match[k]) + int(match[k + 1] or 0) / 12) for k in (1, 3)]
    elif match := _IN_METRES.search(text):
        unit = (match[4] or match[2] or "").casefold().replace("м", "m")
        values = [values_m(match[k] + unit) for k in (1, 3)]
        # "850" is in millimetres beside "2100".
        sides = [value_m[-1 if min(map(len, values)) == 1 else 0] for value_m in values if value_m]
        if not unit and (match[1] + match[3]).isdigit() and max(sides, default=0.0) <= _LONGER_THAN_BEDS_M:
            return None
    is_room = len(sides) == 2 and _SIDE_M[0] <= min(sides) and max(sides) <= _SIDE_M[1]
    return (sides[0], sides[1]) if is_room else None


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def without_sizes(text: str) -> str:
    """Return a text without the area and the sides of a room that it states."""
    for pattern in (_AREA, _IN_FEET, _IN_METRES) if sides_m(text) else (_AREA,):
        text = pattern.sub("", text)
    return text


def _has_size(text: str) -> bool:
    return bool(_areas_m2(text) or sides_m(text))


def _areas_m2(text: str) -> tuple[float, ...]:
    """Return the areas (m²) that are written in a text."""
    found = [(_number(number), unit) for number, unit in _AREA.findall(text)]
    areas = [value * (_SQUARE_FOOT_M2 if "f" in unit.casefold() else 1.0) for value, unit in found]
    return tuple(area for area in areas if _AREA_M2[0] <= area <= _AREA_M2[1])


def written_dimensions(drawing: Drawing, check_time: CheckTime) -> list[Dimension]:
    """Return the texts of a drawing that can be dimensions, with the lengths of the lines that they are written at."""
    texts = [lettering for lettering in drawing.letterings if values_m(lettering.text)][:_MAX_TEXTS]
    segments = segments_of([stroke.line for stroke in drawing.strokes])
    if not texts or not 0 < len(segments) <= _MAX_PIECES:
        return []
    pieces = lines_of(segments)
    tree = shapely.STRtree(pieces)
    reach = _NEAR * extent_of(pieces)
    found: list[Dimension] = []
    for lettering in texts:
        check_time()
        place = shapely.Point(lettering.position)
        near = tree.query(place, predicate="dwithin", distance=max(reach, _NEAR_HEIGHTS * lettering.height))
        nearest = sorted(near, key=lambda index: pieces[index].distance(place))[:_MAX_LINES_PER_TEXT]
        lengths = [length for index in nearest for length in _lengths_at(place, pieces[index], tree)]
        if lengths:
            found.append((lettering.text, lengths))
    return found


def _lengths_at(place: shapely.Point, line: shapely.LineString, tree: shapely.STRtree) -> list[float]:
    """Return the length of a line, and that between the marks across it on both sides of a place."""
    at = line.project(place)
    is_inside = _ENDS * line.length <= at <= (1.0 - _ENDS) * line.length
    whole = [line.length] if is_inside else []
    crossing = tree.geometries[tree.query(line, predicate="intersects")]
    marks = shapely.get_coordinates(shapely.intersection(crossing, line))
    along = np.unique(np.round(shapely.line_locate_point(line, shapely.points(marks)), 6))
    below, above = along[along < at], along[along > at]
    between = [float(above[0] - below[-1])] if len(below) and len(above) else []
    return [*whole, *(length for length in between if not whole or abs(length - whole[0]) > 1e-6)]


def values_m(text: str) -> tuple[float, ...]:
    """Return the lengths (m) that a text can mean."""
    values: list[float] = []
    if match := _IMPERIAL.fullmatch(text.strip()):
        values = [METRES_PER_UNIT["ft"] * int(match[1]) + METRES_PER_UNIT["in"] * int(match[2] or 0)]
    elif match := _METRIC.fullmatch(text.strip()):
        number, unit = _number(match[1]), match[2]
        usual = ("mm",) if number >= _SURELY_MM else ("cm", "mm")
        units = (unit,) if unit else usual if match[1].isdigit() else ("m",)
        values = [number * METRES_PER_UNIT[unit] for unit in units]
    return tuple(value for value in values if _LENGTH_M[0] <= value <= _LENGTH_M[1])


def _agreeing_votes(votes: Sequence[tuple[float, int, float]]) -> list[tuple[float, int, float]]:
    """Return the votes in the window of ratios that has most dimensions."""
    ordered = sorted(votes)
    inside: Counter[int] = Counter()
    first, best, window = 0, 0, (0, 0)
    for last, (ratio, index, _) in enumerate(ordered):
        inside[index] += 1
        while ratio - ordered[first][0] > _AGREE:
            left = ordered[first][1]
            inside[left] -= 1
            if not inside[left]:
                del inside[left]
            first += 1
        if len(inside) > best:
            best, window = len(inside), (first, last + 1)
    return ordered[slice(*window)]
