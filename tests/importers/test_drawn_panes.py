"""Windows of drawings whose layers and elements do not name them."""

from __future__ import annotations

from pathlib import Path

import pytest

from lalaloc_core.importers import ImportedPlan, ImportOptions, import_plan


def _svg(*elements: str) -> ImportedPlan:
    """Import a drawing in centimetres of a hall of 8 m x 4 m between filled walls of 20 cm."""
    head = '<svg xmlns="http://www.w3.org/2000/svg" width="90cm" height="50cm" viewBox="0 0 900 500">'
    return import_plan(f"{head}{''.join(elements)}</svg>".encode(), ImportOptions(metres_per_pixel=0.01))


def _wall(x: float, y: float, width: float, height: float) -> str:
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="black"/>'


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<path d="M{x0} {y0}L{x1} {y1}" fill="none" stroke="black" stroke-width="1"/>'


# The upper wall has a gap of 4 m.
HALL = [
    _wall(20, 20, 220, 20), _wall(640, 20, 220, 20), _wall(20, 440, 840, 20), _wall(20, 20, 20, 440),
    _wall(840, 20, 20, 440),
]  # fmt: skip
PANES = [_line(240, y, 640, y) for y in (20, 30, 40)]


def _windows(plan: ImportedPlan) -> list[list[list[float]]]:
    return [opening["line"] for opening in plan.document.get("openings", []) if opening["kind"] == "window"]


@pytest.mark.parametrize(
    "symbol",
    [PANES, PANES[::2], ['<rect x="240" y="20" width="400" height="20" fill="none" stroke="black"/>', PANES[1]]],
    ids=["three lines", "two lines", "outline"],
)
def test_wide_window_without_a_name_closes_the_wall(symbol: list[str]) -> None:
    plan = _svg(*HALL, *symbol)
    (room,) = plan.plan().rooms
    assert room.area_m2 == pytest.approx(8.0 * 4.0, rel=1e-2)
    ((start, end),) = _windows(plan)
    assert sorted([start[0], end[0]]) == pytest.approx([2.4, 6.4], abs=0.02)


def test_steps_across_a_room_are_no_windows() -> None:
    steps = [_line(x, 40, x, 440) for x in range(300, 600, 28)]
    closed = [*HALL, _wall(240, 20, 400, 20)]
    assert _windows(_svg(*closed, *steps[:2])) == []
    assert _windows(_svg(*closed, *steps)) == []


def test_lines_beside_a_wall_are_no_window() -> None:
    closed = [*HALL, _wall(240, 20, 400, 20)]
    counter = [_line(40, 60, 840, 60), _line(40, 100, 840, 100)]
    plan = _svg(*closed, *counter)
    assert _windows(plan) == []


# A wall across the middle with a gap of 2.6 m.
DIVIDER = [_wall(430, 40, 20, 70), _wall(430, 370, 20, 70)]


def _name(x: float, y: float, text: str) -> str:
    return f'<text x="{x}" y="{y}" font-size="20">{text}</text>'


def test_names_tell_rooms_apart_that_a_wide_passage_joins() -> None:
    walls = [*HALL, *PANES, *DIVIDER]
    named = _svg(*walls, _name(200, 250, "Kitchen"), _name(600, 250, "Living room"))
    found = {(room.name, room.type) for room in named.plan().rooms}
    assert found == {("Kitchen", "kitchen"), ("Living room", "living")}
    assert any(opening["kind"] == "passage" for opening in named.document["openings"])


@pytest.mark.parametrize("text", ["", "3.20 m"])
def test_one_name_is_that_of_one_room(text: str) -> None:
    (room,) = _svg(*HALL, *PANES, *DIVIDER, _name(200, 250, "Living room"), _name(600, 250, text)).plan().rooms
    assert room.type == "living"


# A home of two rooms, a door and two windows by format and style, named in one of twelve languages each.
DRAWN = sorted((Path(__file__).parent / "drawn").iterdir())


@pytest.mark.parametrize("path", DRAWN, ids=lambda path: path.name)
def test_drawn_home_is_imported_untouched(path: Path) -> None:
    plan = import_plan(path.read_bytes(), ImportOptions(scale=None if path.suffix == ".dxf" else 100.0))
    areas = sorted(room.area_m2 for room in plan.plan().rooms)
    assert areas == pytest.approx([4.5 * 4.0, 4.8 * 4.0], rel=0.03)
    assert sorted(opening["kind"] for opening in plan.document["openings"]) == ["door", "window", "window"]
    assert {room.type for room in plan.plan().rooms} == {"kitchen", "bedroom"}
