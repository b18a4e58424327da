"""Small JSON documents in request bodies: read strictly, with every field at fault named."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_text import read_json
from service.errors import InvalidRequestError
from service.http.faults import describe_fault

Model = TypeVar("Model", bound=BaseModel)

_MAX_DEPTH = 8
_MAX_FAULTS = 20


def parse_document(model: type[Model], content: bytes) -> Model:
    """A JSON text as a model.

    Raises:
        InvalidRequestError: it is not JSON, has a key twice, or fields at fault, the first twenty of which are named.
    """
    try:
        value = read_json(content, _MAX_DEPTH)
    except InvalidFloorPlanError as error:
        # What reads plans reads any JSON; only its error says plan.
        raise InvalidRequestError([("body", str(error))]) from error
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise InvalidRequestError([describe_fault(fault) for fault in error.errors()[:_MAX_FAULTS]]) from error
