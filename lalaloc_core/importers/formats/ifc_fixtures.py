"""Fixtures among the elements of an IFC model."""

from __future__ import annotations

from typing import Any

from lalaloc_core.importers.common.fixtures import fixture_from_name

# Classes with fixtures among their elements: sanitary terminals are flow terminals, furniture is furnishing.
FURNISHINGS = ("IfcFlowTerminal", "IfcFurnishingElement", "IfcStair", "IfcStairFlight")


def fixture_kind(element: Any) -> str | None:
    """Return the kind of fixture that an element is, by its class, predefined type and names; None if it is none."""
    if not any(element.is_a(name) for name in FURNISHINGS):
        return None
    if element.is_a("IfcStair") or element.is_a("IfcStairFlight"):
        # A stair without a shape of its own consists of flights.
        return "stairs" if element.Representation is not None else None
    relations = (*(getattr(element, "IsTypedBy", None) or ()), *(getattr(element, "IsDefinedBy", None) or ()))
    types = [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
    parts = (element, *types)
    names = (getattr(part, key, None) for key in ("PredefinedType", "ObjectType", "Name") for part in parts)
    return fixture_from_name(*(str(name or "")[:200] for name in names))
