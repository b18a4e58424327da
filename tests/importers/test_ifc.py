"""IFC: a generated model, and buildingSMART's sample model if it is available."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportedPlan, ImportOptions, import_plan, import_plans
from tests.importers.conftest import lines, names_and_types, shapes

ifcopenshell = pytest.importorskip("ifcopenshell")

_NAME = Path("shared", "plans", "Ifc2x3_Duplex_Architecture.ifc")
DUPLEX = next((parent / _NAME for parent in Path(__file__).parents if (parent / _NAME).exists()), None)


class _Model:
    """IFC 4 model in millimetres."""

    def __init__(self) -> None:
        self.file: Any = ifcopenshell.file(schema="IFC4")
        make = self.file.create_entity
        units = make("IfcUnitAssignment", [make("IfcSIUnit", None, "LENGTHUNIT", "MILLI", "METRE")])
        self.context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, self.placement((0, 0, 0)))
        self.project = make("IfcProject", ifcopenshell.guid.new(), UnitsInContext=units)
        self.project.RepresentationContexts = [self.context]
        self.begin_storey("EG", 0.0)

    def begin_storey(self, name: str, elevation: float) -> None:
        """Add a storey, which further elements belong to."""
        make = self.file.create_entity
        self.storey = make("IfcBuildingStorey", ifcopenshell.guid.new(), Name=name, Elevation=elevation)
        make("IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=self.project, RelatedObjects=[self.storey])

    def placement(self, origin: tuple[float, float, float]) -> Any:
        point = self.file.create_entity("IfcCartesianPoint", [float(value) for value in origin])
        return self.file.create_entity("IfcAxis2Placement3D", point)

    def prism(self, kind: str, ring: list[tuple[float, float]], low: float, height: float, **attributes: object) -> Any:
        """Return an element made by extruding an outline."""
        make = self.file.create_entity
        points = [make("IfcCartesianPoint", [float(x), float(y)]) for x, y in [*ring, ring[0]]]
        profile = make("IfcArbitraryClosedProfileDef", "AREA", None, make("IfcPolyline", points))
        up = make("IfcDirection", [0.0, 0.0, 1.0])
        solid = make("IfcExtrudedAreaSolid", profile, self.placement((0, 0, low)), up, float(height))
        shape = make("IfcShapeRepresentation", self.context, "Body", "SweptSolid", [solid])
        element = make(kind, ifcopenshell.guid.new(), **attributes)
        element.Representation = make("IfcProductDefinitionShape", None, None, [shape])
        element.ObjectPlacement = make("IfcLocalPlacement", None, self.placement((0, 0, 0)))
        return element

    def spaces(self, *spaces: Any) -> None:
        self.file.create_entity(
            "IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=self.storey, RelatedObjects=list(spaces)
        )

    def contain(self, *elements: Any) -> None:
        relation = {"RelatedElements": list(elements), "RelatingStructure": self.storey}
        self.file.create_entity("IfcRelContainedInSpatialStructure", ifcopenshell.guid.new(), **relation)

    def content(self) -> bytes:
        return self.file.to_string().encode()


def _box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def ifc_flat() -> _Model:
    model = _Model()
    model.spaces(
        model.prism("IfcSpace", _box(0, 0, 4000, 3000), 0, 2600, LongName="Küche"),
        model.prism("IfcSpace", _box(4100, 0, 9000, 3000), 0, 2600, LongName="Wohnen"),
        model.prism("IfcSpace", _box(500, 2500, 900, 2900), 0, 2600, LongName="Schacht"),
    )
    hole = model.prism("IfcOpeningElement", _box(4000, 1000, 4100, 1900), 0, 2100)
    door = model.file.create_entity("IfcDoor", ifcopenshell.guid.new(), Name="T1")
    model.file.create_entity(
        "IfcRelFillsElement", ifcopenshell.guid.new(), RelatingOpeningElement=hole, RelatedBuildingElement=door
    )
    window = model.prism("IfcWindow", _box(6000, -300, 7500, 0), 900, 1200)
    column = model.prism("IfcColumn", _box(7000, 2000, 7300, 2300), 0, 2600)
    model.contain(door, window, column)
    return model


def ifc_house() -> _Model:
    """Return the flat with a storey above it, and a roof that has a space without a floor."""
    model = ifc_flat()
    model.begin_storey("Obergeschoss", 3000.0)
    model.spaces(model.prism("IfcSpace", _box(0, 0, 9000, 3000), 3000, 2400, LongName="Atelier"))
    model.begin_storey("Dach", 6000.0)
    model.spaces(model.prism("IfcSpace", _box(0, 0, 200, 200), 6000, 2400, LongName="Schacht"))
    return model


def test_levels_without_a_room_are_left_out():
    plans = import_plans(ifc_house().content(), building="Haus")
    assert [plan.plan().name for plan in plans] == ["Haus – EG", "Haus – Obergeschoss"]
    assert any(line.startswith("level 'Dach' was left out: ") for line in plans[0].report.warnings)


def test_ifc_elements_give_rooms_openings_and_holes():
    plan = import_plan(ifc_flat().content())
    assert names_and_types(plan) == [("Küche", "kitchen"), ("Wohnen", "living")]
    assert [room.area for room in shapes(plan.document)] == pytest.approx([12.0 - 0.16, 14.7 - 0.09], abs=1e-3)
    assert plan.document["ceiling_height_m"] == pytest.approx(2.6)
    (door,), (window,) = lines(plan.document, "door"), lines(plan.document, "window")
    assert sorted(door.coords) == [(4.05, 1.0), (4.05, 1.9)]
    assert sorted(window.coords) == [(6.0, 0.0), (7.5, 0.0)]
    glass = next(opening for opening in plan.document["openings"] if opening["kind"] == "window")
    assert (glass["sill_m"], glass["head_m"]) == (0.9, 2.1)
    assert plan.report.metres_per_unit == pytest.approx(1e-3)
    plan.plan()


def test_map_conversion_gives_anchor_and_north():
    model = ifc_flat()
    make = model.file.create_entity
    crs = make("IfcProjectedCRS", "EPSG:25832")
    # The model is rotated by 30° counter-clockwise against the grid.
    turn = np.radians(30.0)
    make("IfcMapConversion", model.context, crs, 691000.0, 5334000.0, 510.0, float(np.cos(turn)), float(np.sin(turn)))
    plan = import_plan(model.content())
    lon, lat = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(691000.0, 5334000.0)
    assert plan.anchor is not None
    assert (plan.anchor.longitude, plan.anchor.latitude) == pytest.approx((lon, lat), abs=1e-9)
    assert plan.anchor.altitude_m == 510.0
    convergence = pyproj.Proj("EPSG:25832").get_factors(lon, lat).meridian_convergence
    assert plan.document["north_deg"] == pytest.approx(30.0 - convergence, abs=0.01)


def _loose_space(model: _Model) -> Any:
    return model.prism("IfcSpace", _box(0, 0, 4000, 3000), 0, 2600, LongName="Küche")


def test_space_that_a_storey_contains_as_an_element_is_a_room():
    model = _Model()
    model.contain(_loose_space(model))
    assert [room["name"] for room in import_plan(model.content()).document["rooms"]] == ["Küche"]


def test_spaces_of_no_storey_belong_to_the_one_at_their_height():
    model = _Model()
    model.begin_storey("OG", 3000.0)
    _loose_space(model)
    model.prism("IfcSpace", _box(0, 0, 4000, 3000), 3000, 2600, LongName="Bad")
    model.prism("IfcSpace", _box(0, 0, 4000, 3000), -9000, 2600, LongName="Keller")
    plans = import_plans(model.content())
    found = [(plan.level and plan.level.name, plan.document["rooms"][0]["name"]) for plan in plans]
    assert found == [("EG", "Küche"), ("OG", "Bad")]
    assert any(use.layer == "IfcSpace" and "ignored" in use.used_as for use in plans[0].report.layers)


def test_building_without_storeys_is_one_level():
    model = _Model()
    model.file.remove(model.storey)
    model.file.create_entity("IfcBuilding", ifcopenshell.guid.new(), Name="Haus")
    _loose_space(model)
    plan = import_plan(model.content())
    assert plan.level is not None
    assert plan.level.name == "Haus"
    assert [room["name"] for room in plan.document["rooms"]] == ["Küche"]


def test_model_without_spaces_is_rejected_with_a_remedy():
    with pytest.raises(InvalidFloorPlanError, match=r"no IfcSpace .* export it with rooms"):
        import_plan(_Model().content())


def test_truncated_model_is_rejected():
    content = _Model().content()
    with pytest.raises(InvalidFloorPlanError, match="truncated: it does not end with END-ISO-10303-21"):
        import_plan(content[: len(content) - 30])


@pytest.fixture(scope="module")
def duplex() -> tuple[ImportedPlan, ...]:
    if DUPLEX is None:
        pytest.skip("the sample model is not available")
    return import_plans(DUPLEX.read_bytes())


def test_duplex_has_a_plan_per_storey(duplex: tuple[ImportedPlan, ...]):
    assert [plan.level.name for plan in duplex] == ["Level 1", "Level 2"]  # type: ignore[union-attr]
    assert [plan.level.number for plan in duplex] == [0.0, 1.0]  # type: ignore[union-attr]
    assert [len(plan.document["rooms"]) for plan in duplex] == [10, 10]
    assert "level 'Roof' was left out: it is a roof (set level to read it)" in duplex[0].report.warnings
    ground, first = duplex[0], duplex[1]
    assert (len(lines(ground.document, "door")), len(lines(ground.document, "window"))) == (6, 4)
    assert len(lines(first.document, "door")) == 8
    # Kitchen and living room of both flats are open to each other.
    assert sum(line.length > 5.0 for line in lines(ground.document, "passage")) == 2
    assert ground.anchor is not None
    assert (ground.anchor.latitude, ground.anchor.longitude) == pytest.approx((41.8744, -87.6394), abs=1e-4)
    for plan in duplex:
        plan.plan()


def test_level_option_selects_a_storey_of_the_duplex(duplex: tuple[ImportedPlan, ...]):
    assert DUPLEX is not None
    assert import_plan(DUPLEX.read_bytes(), ImportOptions(level="Level 2")).document == duplex[1].document


def _mapped(levels: int, copies: int) -> bytes:
    """Return a model of one space whose shape is repeated `copies` times at each of some levels."""
    model = _Model()
    make = model.file.create_entity
    space = model.prism("IfcSpace", _box(0, 0, 4000, 3000), 0, 2600, LongName="Küche")
    shape = space.Representation.Representations[0]
    origin = make("IfcCartesianPoint", [0.0, 0.0, 0.0])
    unmoved = make("IfcCartesianTransformationOperator3D", None, None, origin, None, None)
    for _ in range(levels):
        source = make("IfcRepresentationMap", model.placement((0, 0, 0)), shape)
        items = [make("IfcMappedItem", source, unmoved) for _ in range(copies)]
        shape = make("IfcShapeRepresentation", model.context, "Body", "MappedRepresentation", items)
    space.Representation = make("IfcProductDefinitionShape", None, None, [shape])
    model.spaces(space)
    return model.content()


def test_mapped_items_are_read():
    assert [shape.area for shape in shapes(import_plan(_mapped(2, 2)).document)] == pytest.approx([12.0])


def test_nested_mapped_items_are_refused():
    content = _mapped(12, 10)
    assert len(content) < 10_000
    with pytest.raises(InvalidFloorPlanError, match="IfcSpace '' has more than 300000 entities"):
        import_plan(content)


def test_parts_of_a_high_curtain_wall_belong_to_the_storey_at_their_height():
    model = ifc_house()
    wall = model.file.create_entity("IfcCurtainWall", ifcopenshell.guid.new())
    windows = [
        model.prism("IfcWindow", _box(1000, -100, 2500, 0), low, 1500, Name=name)
        for low, name in ((900, "below"), (3900, "above"))
    ]
    model.file.create_entity("IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=wall, RelatedObjects=windows)
    ground, upper = import_plans(model.content())
    names = [opening.get("name") for opening in ground.document["openings"] if opening["kind"] == "window"]
    assert names == [None, "below"]
    assert [opening["name"] for opening in upper.document["openings"]] == ["above"]


def test_crawl_spaces_areas_and_spaces_drawn_twice_are_left_out_and_named():
    model = ifc_flat()
    model.spaces(model.prism("IfcSpace", _box(0, 3000, 4000, 5000), 0, 800, LongName="Kriechkeller"))
    for ring in (_box(-200, -200, 9000, 3300), _box(-50, -50, 4050, 3050)):
        model.spaces(model.prism("IfcSpace", ring, 0, 2600, LongName="Area"))
    plan = import_plan(model.content())
    assert [room["name"] for room in plan.document["rooms"]] == ["Küche", "Wohnen"]
    assert plan.document["openings"] == import_plan(ifc_flat().content()).document["openings"]
    assert sum("was left out as an area" in line for line in plan.report.warnings) == 2
    assert any("room 'Kriechkeller' (8.0 m²" in line and "0.80 m high" in line for line in plan.report.warnings)


def test_building_of_low_spaces_alone_is_refused():
    model = _Model()
    model.spaces(model.prism("IfcSpace", _box(0, 0, 4000, 5000), 0, 1300, LongName="Eaves"))
    with pytest.raises(InvalidFloorPlanError, match=r"no room is higher than a camera, 1.5 m: room 'Eaves'"):
        import_plan(model.content())


def test_terminals_furniture_and_stairs_become_fixtures() -> None:
    model = _Model()
    model.spaces(
        model.prism("IfcSpace", _box(0, 0, 4000, 3000), 0, 2500, Name="1"),
        model.prism("IfcSpace", _box(4200, 0, 6200, 3000), 0, 2500, Name="2"),
    )
    elements = [
        model.prism("IfcSanitaryTerminal", _box(200, 200, 600, 800), 0, 450, Name="A1", PredefinedType="TOILETPAN"),
        model.prism("IfcFurniture", _box(1500, 500, 2400, 1400), 0, 450, Name="Chair"),
        model.prism("IfcStairFlight", _box(4300, 100, 5300, 2900), 0, 2600, Name="S"),
    ]
    model.contain(*elements)
    plan = import_plan(model.content())
    assert [fixture["kind"] for fixture in plan.document["fixtures"]] == ["toilet", "stairs"]
    assert {room["name"]: room.get("type") for room in plan.document["rooms"]} == {"1": "bathroom", "2": "stairs"}
