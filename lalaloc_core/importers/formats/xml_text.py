"""XML that was sent by somebody: without entities, external references and more depth than a drawing has."""

from __future__ import annotations

from xml.etree.ElementTree import Element, ParseError

import defusedxml
from defusedxml import ElementTree

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.model.limits import Budget


def read_xml(content: bytes, budget: Budget) -> Element:
    """The root of an XML document; every element is counted.

    Raises:
        InvalidFloorPlanError: no well-formed XML, entities of its own, or too many elements or levels.
    """
    try:
        root = ElementTree.fromstring(content, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except defusedxml.EntitiesForbidden as error:
        raise InvalidFloorPlanError(
            "the XML declares entities, which are not read; save the drawing without them (plain SVG)"
        ) from error
    except defusedxml.DefusedXmlException as error:
        raise InvalidFloorPlanError(f"the XML refers to other files, which are not read: {error}") from error
    except (ParseError, ValueError, LookupError) as error:
        raise InvalidFloorPlanError(f"the XML is not well-formed: {error}") from error
    waiting = [(root, 1)]
    while waiting:
        element, depth = waiting.pop()
        if depth > budget.limits.max_depth:
            raise InvalidFloorPlanError(
                f"elements are nested more than {budget.limits.max_depth} deep (max_depth); ungroup the drawing"
            )
        budget.spend()
        waiting.extend((child, depth + 1) for child in element)
    return root
