"""IndoorGML documents."""

from __future__ import annotations

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, detect_format, import_plan, import_plans
from tests.importers.conftest import lines, names_and_types, shapes

Box = tuple[float, float, float, float]


def _face(points: list[tuple[float, float, float]]) -> str:
    positions = " ".join(f"{value}" for point in [*points, points[0]] for value in point)
    ring = f'<gml:LinearRing><gml:posList srsDimension="3">{positions}</gml:posList></gml:LinearRing>'
    return f"<gml:surfaceMember><gml:Polygon><gml:exterior>{ring}</gml:exterior></gml:Polygon></gml:surfaceMember>"


def _solid(box: Box, low: float, high: float) -> str:
    x0, y0, x1, y1 = box
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    faces = [_face([(x, y, z) for x, y in corners]) for z in (low, high)]
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        faces.append(_face([(ax, ay, low), (bx, by, low), (bx, by, high), (ax, ay, high)]))
    shell = f"<gml:Shell>{''.join(faces)}</gml:Shell>"
    return f"<core:Geometry3D><gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid></core:Geometry3D>"


def _surface(box: Box) -> str:
    x0, y0, x1, y1 = box
    places = "".join(f"<gml:pos>{x} {y}</gml:pos>" for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)))
    ring = f"<gml:exterior><gml:LinearRing>{places}</gml:LinearRing></gml:exterior>"
    return f"<core:Geometry2D><gml:Polygon>{ring}</gml:Polygon></core:Geometry2D>"


def _cell(name: str, geometry: str, kind: str = "core:CellSpace") -> str:
    geometry = f"<core:cellSpaceGeometry>{geometry}</core:cellSpaceGeometry>" if geometry else ""
    member = f'<{kind} gml:id="{name.replace(" ", "-")}"><gml:name>{name}</gml:name>{geometry}</{kind}>'
    return f"<core:cellSpaceMember>{member}</core:cellSpaceMember>"


def _boundary(key: str, geometry: str, kind: str = "core:CellSpaceBoundary") -> str:
    inside = f"<core:cellSpaceBoundaryGeometry>{geometry}</core:cellSpaceBoundaryGeometry>"
    return f'<core:cellSpaceBoundaryMember><{kind} gml:id="{key}">{inside}</{kind}></core:cellSpaceBoundaryMember>'


def _line(*points: tuple[float, float, float]) -> str:
    positions = " ".join(f"{value}" for point in points for value in point)
    return f"<gml:LineString><gml:posList>{positions}</gml:posList></gml:LineString>"


def _transition(line: str, dual: str = "") -> str:
    duality = f'<core:duality xlink:href="#{dual}"/>' if dual else ""
    return (
        f"<core:transitionMember><core:Transition>{duality}<core:geometry>{line}</core:geometry></core:Transition>"
        "</core:transitionMember>"
    )


def _document(*members: str, srs: str = "") -> bytes:
    spaces = ' '.join(
        f'xmlns:{prefix}="{address}"'
        for prefix, address in (
            ("core", "http://www.opengis.net/indoorgml/1.0/core"),
            ("navi", "http://www.opengis.net/indoorgml/1.0/navigation"),
            ("gml", "http://www.opengis.net/gml/3.2"),
            ("xlink", "http://www.w3.org/1999/xlink"),
        )
    )  # fmt: skip
    name = f'<gml:boundedBy><gml:Envelope srsName="{srs}"/></gml:boundedBy>' if srs else ""
    inside = f"{name}<core:primalSpaceFeatures><core:PrimalSpaceFeatures>{''.join(members)}"
    end = "</core:PrimalSpaceFeatures></core:primalSpaceFeatures></core:IndoorFeatures>"
    return f'<?xml version="1.0" encoding="UTF-8"?><core:IndoorFeatures {spaces}>{inside}{end}'.encode()


ROOMS = (_cell("Kitchen", _solid((0, 0, 4, 3), 0, 2.6)), _cell("Corridor", _solid((4.2, 0, 9, 3), 0, 2.6)))
DOOR = _boundary("B1", _face([(4.1, 1, 0), (4.1, 1.8, 0), (4.1, 1.8, 2.05), (4.1, 1, 2.05)]))
PATH = _line((2, 1.5, 0), (4.1, 1.4, 0), (6, 1.5, 0))


def test_solids_become_rooms_and_boundaries_doors():
    content = _document(*ROOMS, DOOR, _transition(PATH, "B1"))
    assert detect_format(content) == "indoorgml"
    plan = import_plan(content)
    assert names_and_types(plan) == [("Kitchen", "kitchen"), ("Corridor", "corridor")]
    assert [room.area for room in shapes(plan.document)] == pytest.approx([12.0, 14.4])
    assert plan.document["ceiling_height_m"] == pytest.approx(2.6)
    (door,) = lines(plan.document, "door")
    assert sorted(door.coords) == [pytest.approx((4.1, 1.0)), pytest.approx((4.1, 1.8))]
    assert plan.document["openings"][0]["head_m"] == pytest.approx(2.05)
    assert 0.3 < plan.document["opening_trust"]["door"] < 1.0
    assert not [guess for guess in plan.report.unsure if "taken to be drawn" not in guess]


def test_boundary_without_a_transition_is_a_wall():
    assert lines(import_plan(_document(*ROOMS, DOOR)).document, "door") == []
    connection = DOOR.replace("core:CellSpaceBoundary ", "navi:ConnectionBoundary ").replace(
        "</core:CellSpaceBoundary>", "</navi:ConnectionBoundary>"
    )
    assert len(lines(import_plan(_document(*ROOMS, connection)).document, "door")) == 1


def test_transition_without_a_boundary_is_a_door_of_usual_width():
    plan = import_plan(_document(*ROOMS, _transition(PATH)))
    (door,) = lines(plan.document, "door")
    assert door.length == pytest.approx(0.9, abs=1e-3)
    assert door.centroid.coords[0] == pytest.approx((4.1, 1.4), abs=0.02)
    assert plan.report.unsure == ("1 doors are transitions without a boundary; 0.9 m is assumed",)


def test_surfaces_become_rooms():
    door = _cell("Door 1", _surface((4, 1, 4.2, 1.9)), "navi:ConnectionSpace")
    cells = (_cell("Kitchen", _surface((0, 0, 4, 3))), _cell("Hall", _surface((4.2, 0, 9, 3)), "navi:GeneralSpace"))
    plan = import_plan(_document(*cells, door), ImportOptions(ceiling_height_m=2.4))
    assert [room["name"] for room in plan.document["rooms"]] == ["Kitchen", "Hall"]
    (found,) = lines(plan.document, "door")
    assert found.length == pytest.approx(0.9, abs=1e-3)


def test_storeys_are_levels():
    upper = (_cell("Study", _solid((0, 0, 4, 3), 3.0, 5.6)), _transition(_line((2, 1, 3), (3, 1, 3))))
    plans = import_plans(_document(*ROOMS, DOOR, _transition(PATH, "B1"), *upper), building="House")
    assert [plan.plan().name for plan in plans] == ["House – Level 0", "House – Level 1"]
    assert [len(plan.document.get("openings", [])) for plan in plans] == [1, 0]
    assert plans[1].level is not None
    assert plans[1].level.elevation_m == 3.0


def test_units_option_scales_the_coordinates():
    content = _document(_cell("Kitchen", _solid((0, 0, 400, 300), 0, 260)))
    assert shapes(import_plan(content, ImportOptions(units="cm")).document)[0].area == pytest.approx(12.0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_document(), "no CellSpace of the IndoorGML file has a geometry"),
        (_document(_cell("Kitchen", "")), "no CellSpace of the IndoorGML file has a geometry"),
        (_document(*ROOMS, srs="EPSG:4326"), r"are degrees \(EPSG:4326\); export it in metres"),
        (_document(*ROOMS).replace(b"2.6", b"high"), "a position .* is '.*'; positions must be numbers"),
        (_document(*ROOMS).replace(b"2.6", b"1e300"), "the coordinate 1e.300; the limit is 1e.10"),
    ],
)
def test_invalid_document_is_rejected(content: bytes, words: str):
    with pytest.raises(InvalidFloorPlanError, match=words):
        import_plan(content)
