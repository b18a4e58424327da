"""Scales that are estimated from the sizes of the parts of a drawing."""

from __future__ import annotations

import math
from unittest.mock import Mock

import pytest
import shapely

from lalaloc_core.importers import ImportOptions, ImportStep, import_plan
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import SketchedRoom
from lalaloc_core.importers.drawing.drawing_scale import check_areas, sides_m, without_sizes
from lalaloc_core.importers.drawing.scale_guess import Measures, combine, guess_scale, tread_spacings
from tests.importers.test_lettering import LIMITS, PrintedPlan
from tests.strategies import present


def _flight(treads: int, spacing: float, width: float = 1.0) -> list[shapely.LineString]:
    return [shapely.LineString([(0.0, spacing * k), (width, spacing * k)]) for k in range(treads + 1)]


def test_more_doors_make_the_scale_more_certain():
    few, many = (present(combine(Measures(leaves=[81.0, 86.0] * count), 0.012)) for count in (1, 4))
    assert many.metres_per_unit == pytest.approx(0.0101, rel=0.03)
    assert many.std < few.std < 0.12


def test_written_areas_outweigh_doors():
    areas = [(12.0, 12.0e4), (20.0, 20.4e4), (9.0, 8.9e4), (7.0, 70.0e4)]
    guess = present(combine(Measures(leaves=[88.0, 90.0, 91.0], areas=areas), 0.012))
    assert guess.metres_per_unit == pytest.approx(0.01, rel=0.015)
    assert guess.std < 0.03
    assert {clue.kind: clue.count for clue in guess.clues} == {"leaf": 3, "area": 3}


def test_a_kind_that_disagrees_is_listed_and_not_used():
    guess = combine(Measures(areas=[(m2, m2 * 1e4) for m2 in (8.0, 12.0, 20.0, 31.0)], leaves=[40.0] * 6), 0.01)
    assert guess is not None
    assert {clue.kind: clue.is_used for clue in guess.clues} == {"leaf": False, "area": True}
    assert "not used, as they disagree: 6 door leaves" in guess.assumption


@pytest.mark.parametrize("measures", [Measures(), Measures(wall=16.0), Measures(leaves=[84.0])])
def test_too_few_parts_give_no_scale(measures: Measures):
    assert guess_scale(lambda scale: measures, 0.01, Budget()) is None


def test_drawing_is_read_again_at_the_scale_that_was_found():
    sketch, on_step = Mock(return_value=Measures(leaves=[82.0, 84.0, 88.0, 90.0])), Mock()
    guess = present(guess_scale(sketch, 0.02, Budget(on_step=on_step)))
    on_step.assert_called_once_with(ImportStep("estimating the scale"))
    assert sketch.call_count == 2
    assert abs(math.log(sketch.call_args.args[0] / guess.metres_per_unit)) < 0.04


def test_other_first_scales_are_tried_where_nothing_is_found():
    guess = guess_scale(lambda scale: Measures(leaves=[84.0] * 4 if 0.009 < scale < 0.011 else []), 0.016, Budget())
    assert present(guess).metres_per_unit == pytest.approx(0.01, rel=0.03)


def test_estimate_ends_with_the_time_of_the_import():
    sketch = Mock(side_effect=lambda scale: Measures(leaves=[1.5 / scale] * 3))
    guess_scale(sketch, 0.02, Budget())
    assert sketch.call_count == 4
    clock = iter(range(1000))
    budget = Budget(ImportLimits(max_import_s=10.0), lambda: float(next(clock)))
    guess_scale(sketch, 0.02, budget)
    assert sketch.call_count < 4 + 4


def test_stairs_are_parallel_lines_at_equal_distances():
    assert tread_spacings(_flight(9, 28.0, 100.0)) == pytest.approx([28.0])
    turned = [shapely.LineString([(y, x) for x, y in line.coords]) for line in _flight(9, 28.0, 100.0)]
    assert tread_spacings(turned) == pytest.approx([28.0])
    # A hatch is finer than it is wide, and shelves are few.
    assert tread_spacings(_flight(40, 5.0, 100.0)) == []
    assert tread_spacings(_flight(3, 28.0, 100.0)) == []
    uneven = [shapely.LineString([(0.0, y), (100.0, y)]) for y in (0, 28, 70, 90, 140, 155, 210)]
    assert tread_spacings(uneven) == []


def test_several_stairs_of_a_home_tell_what_one_does():
    one, three = (present(combine(Measures(leaves=[84.0] * 6, treads=[24.5] * count), 0.01)) for count in (1, 3))
    assert three.metres_per_unit == pytest.approx(one.metres_per_unit, rel=1e-6)


def test_written_areas_of_a_picture_give_its_scale():
    page = PrintedPlan(dimensions=False)
    report = import_plan(page.file(), limits=LIMITS).report
    assert report.metres_per_unit * page.px_per_m == pytest.approx(1.0, abs=0.02)
    assert report.scale_source.startswith("estimated from the thickness of walls, 3 written areas (±")


@pytest.mark.parametrize(
    ("text", "sides"),
    [
        ("11'5\" x 12'9\"", (3.48, 3.89)), ("11’5” × 12’9”", (3.48, 3.89)), ("13' X 8'6", (3.96, 2.59)),
        ("14'6″x 117\"", (4.42, 3.53)), ("12'-5\"w x 15'-0\"d", (3.78, 4.57)), ("Bed 2 9 ft 6 in by 13ft", (2.9, 3.96)),
        ("13'2\" (4.01m) x 10' (3.05m)", (4.01, 3.05)), ("11ft6inx12ft", (3.51, 3.66)), ("10.5' x 12'", (3.2, 3.66)),
        ("12 x 14", (3.66, 4.27)), ("5.0x3.6", (5.0, 3.6)), ("5.5mx2.8m", (5.5, 2.8)), ("6.28.4", (6.2, 8.4)),
        ("4,84m х 5,52m", (4.84, 5.52)), ("4.49m (max) x 3m", (4.49, 3.0)), ("3,48 x 3,89 (11'5 x 12'9)", (3.48, 3.89)),
        ("425 x 385", (4.25, 3.85)), ("3593x 900", (3.593, 0.9)), ("160 x 200", None), ("850 x 2100", None),
        ("30 48", None), ("12.11.2024", None), ("88,5/2,01", None),
    ],
)  # fmt: skip
def test_sides_of_rooms_are_read_as_agents_write_them(text: str, sides: tuple[float, float] | None):
    assert sides_m(text) == (sides and pytest.approx(sides, abs=0.006))
    assert sides is None or without_sizes(text).strip() in ("", "Bed 2")


def test_sizes_that_contradict_the_others_or_the_scale_are_named():
    rooms = [SketchedRoom(shapely.box(5.0 * k, 0.0, 5.0 * k + 4.0, 3.0), name) for k, name in enumerate("ABCD")]
    texts = [["5.0 x 3.75"], ["18.75 m² / 202 sq ft"], ["28.5 m²"], ["5.0m x 7.9m"]]
    builder = ReportBuilder(metres_per_unit=0.02, scale_source="option metres_per_pixel")
    check_areas(rooms, texts, ["19' x 11'"], builder)
    area, shape, scale = builder.warnings
    assert area.startswith("28.5 m² was read as the area of a room of 12.0 m² ('C'), against 2 sizes that agree")
    assert shape.startswith("'5.0m x 7.9m' was read as the size of a room, but does not fit its room")
    assert scale.startswith("the areas and sides written in 2 rooms give 0.02501 m per unit, and 0.02 is used (option")
    assert builder.scale_factor == pytest.approx(1.25, rel=0.01)
    assert builder.rejected_texts == ["'19' x 11'' was read as the size of a room, but is in no room"]


def test_written_sides_of_rooms_give_the_scale_of_a_picture_with_a_title():
    page = PrintedPlan(margin_m=4.0, areas=False, dimensions=False)
    page._text((4.6, 9.0), "12 EXAMPLE STREET, SAMPLE TOWN, TWO BEDROOMS, FOR ILLUSTRATION ONLY, NOT TO SCALE")
    for place, text in (((2.1, 2.9), "12'10\" x 19'8\""), ((6.7, 4.4), "2.90m x 4.80m"), ((6.7, 1.3), "3.75m x 6.20m")):
        page._text(place, text)
    report = import_plan(page.file(), limits=LIMITS).report
    assert report.metres_per_unit * page.px_per_m == pytest.approx(1.0, abs=0.02)
    assert any("23.25 m² was read as the area of a room of 13." in warning for warning in report.warnings)


@pytest.mark.slow
def test_false_scale_is_corrected_by_the_factor_of_the_report():
    page = PrintedPlan()
    first = import_plan(page.file(), ImportOptions(metres_per_pixel=0.02), LIMITS).report
    assert first.scale_factor == pytest.approx(1.0 / 70.0 / 0.02, rel=0.02)
    assert any(f"multiply={first.scale_factor:.3f}" in warning for warning in first.warnings)
    options = ImportOptions(metres_per_pixel=0.02, multiply=round(first.scale_factor or 0.0, 3))
    second = import_plan(page.file(), options, LIMITS).report
    assert second.metres_per_unit * page.px_per_m == pytest.approx(1.0, rel=0.02)
    assert second.scale_factor is None
    assert "option multiply" in second.scale_source


@pytest.mark.slow
def test_texts_that_are_not_believed_are_listed():
    page = PrintedPlan()
    page._text((1.5, 1.0), "7.77")
    page._line((0.6, 0.75, 2.4, 0.75))
    page._line((0.6, 0.65, 0.6, 0.85))
    page._line((2.4, 0.65, 2.4, 0.85))
    report = import_plan(page.file(), limits=LIMITS).report
    assert report.metres_per_unit * page.px_per_m == pytest.approx(1.0, rel=0.02)
    assert any(line.startswith("'7.77' was read as a dimension of 7.77 m") for line in report.rejected_texts)
