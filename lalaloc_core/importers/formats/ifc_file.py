"""IFC files, checked before the library computes with them."""

from __future__ import annotations

import re
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError

# End of a complete file; some tools append white space or comments.
_END, _TAIL_BYTES = b"END-ISO-10303-21", 4096
# Placements in a chain; a model has about ten. Numbers of a hundred digits are beyond all that is measured, and larger
# ones end the reading of their instance.
_MAX_PLACEMENTS = 64
# Schema in the head of a file, and by its beginning the version that is read in its place.
_SCHEMA, _HEAD = re.compile(r"(FILE_SCHEMA\s*\(\s*\(\s*')([^']{0,50})"), 65_536
_SCHEMAS = {"IFC2X3": "IFC2X3", "IFC4X": "IFC4X3_ADD2", "IFC4": "IFC4"}
_LARGE_NUMBER = re.compile(rb"[(,]\s*([-+]?\d+\.?\d*[Ee]\+?\d{3,}|[-+]?\d{101,}\.\d*)\s*[,)]")


def open_model(content: bytes) -> Any:
    """Open a model with ifcopenshell.

    Raises:
        InvalidFloorPlanError: the file is truncated or damaged, or has a number or a placement that cannot be used.
    """
    import ifcopenshell

    if (large := _LARGE_NUMBER.search(content)) is not None:
        raise InvalidFloorPlanError(
            f"the IFC model has the number {large[1][:50].decode('ascii', 'replace')}; the limit is 1.E100; correct "
            "it, and export the model again"
        )
    # ifcopenshell reads a truncated file without an error, and the rest is missing.
    if _END not in content[-_TAIL_BYTES:]:
        raise InvalidFloorPlanError(
            f"the IFC file is truncated: it does not end with {_END.decode()}; export or upload it again"
        )
    # The format is ASCII and escapes other characters, so nothing is lost by "replace".
    text = content.decode("utf-8", "replace")
    stated = _SCHEMA.search(text, 0, _HEAD)
    schema = stated[2] if stated is not None else ""
    # The library knows one version of each schema.
    known = next((known for start, known in _SCHEMAS.items() if schema.upper().startswith(start)), schema)
    try:
        model = ifcopenshell.file.from_string(_SCHEMA.sub(rf"\g<1>{known}", text, 1) if known != schema else text)
        schema = str(model.schema)
    except (RuntimeError, ValueError, TypeError, AttributeError, OSError) as error:
        raise InvalidFloorPlanError(
            "the IFC model is damaged, so that it cannot be read; export it again as IFC4"
        ) from error
    if not schema.startswith(("IFC2X3", "IFC4")):
        raise InvalidFloorPlanError(f"the model's schema is {schema[:50]}; export it as IFC2X3 or IFC4")
    _check_placements(model)
    return model


def _check_placements(model: Any) -> None:
    """Check that placements are relative to few others, and not to themselves, which the library follows forever."""
    depths: dict[int, int] = {}
    for placement in model.by_type("IfcLocalPlacement"):
        chain: list[Any] = []
        inside: set[int] = set()
        while placement is not None and placement.id() not in depths and placement.is_a("IfcLocalPlacement"):
            if placement.id() in inside or len(chain) >= _MAX_PLACEMENTS:
                break
            inside.add(placement.id())
            chain.append(placement)
            placement = placement.PlacementRelTo
        depth = 0 if placement is None else depths.get(placement.id(), 0)
        if placement is not None and placement.id() in inside:
            raise InvalidFloorPlanError(
                f"the IfcLocalPlacement #{placement.id()} is relative to itself; export the model again"
            )
        if depth + len(chain) >= _MAX_PLACEMENTS:
            raise InvalidFloorPlanError(
                f"the IfcLocalPlacement #{chain[0].id()} is relative to more than {_MAX_PLACEMENTS} others in a chain, "
                "the limit; export the model again"
            )
        depths |= {link.id(): depth + len(chain) - index for index, link in enumerate(chain)}
