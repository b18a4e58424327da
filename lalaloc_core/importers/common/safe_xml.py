"""XML files, parsed without entities and external references."""

from __future__ import annotations

from xml.etree.ElementTree import Element, ParseError

import defusedxml
from defusedxml import ElementTree as SafeElementTree

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.import_limits import Budget


def local_name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def read_xml(content: bytes, budget: Budget) -> Element:
    """Parse XML without entities and external references, and return its root."""
    try:
        root = SafeElementTree.fromstring(content, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except defusedxml.EntitiesForbidden as error:
        raise InvalidFloorPlanError(
            "the XML declares entities, which are not supported; save the file without them (a drawing as plain SVG)"
        ) from error
    except defusedxml.DefusedXmlException as error:
        raise InvalidFloorPlanError(
            "the XML refers to other files, which are not read; save a drawing as plain SVG"
        ) from error
    except ParseError as error:
        line, column = error.position
        raise InvalidFloorPlanError(
            f"the XML is not well-formed in line {line}, column {column + 1}; save the file again"
        ) from error
    except (ValueError, LookupError) as error:
        raise InvalidFloorPlanError("the XML has an unknown encoding; save the file as UTF-8") from error
    pending = [(root, 1)]
    while pending:
        element, depth = pending.pop()
        if depth > budget.limits.max_depth:
            raise InvalidFloorPlanError(
                f"elements are nested more than {budget.limits.max_depth} deep (max_depth); ungroup a drawing"
            )
        budget.spend()
        pending.extend((child, depth + 1) for child in element)
    return root
