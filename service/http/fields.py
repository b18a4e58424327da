"""Checks of request fields: error messages, JSON bodies, and query parameters."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import read_json
from service.errors import InvalidRequestError

# Characters of a value in a message, levels of a JSON text, and faults of an answer.
_MAX_SHOWN, _MAX_DEPTH, _MAX_FAULTS = 100, 8, 20
Model = TypeVar("Model", bound=BaseModel)


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# Messages by pydantic's error type; other types keep pydantic's message.
_WORDS = tomllib.loads(Path(__file__).with_name("fault_words.toml").read_text(encoding="utf-8"))


def describe_fault(fault: Mapping[str, Any]) -> tuple[str, str]:
    """Return (field, message) of a pydantic error; the message states the value."""
    parts = [str(part) for part in fault.get("loc", ())]
    if parts and parts[0] in ("body", "query", "path"):
        parts = parts[1:]
    kind, context = fault.get("type", ""), fault.get("ctx", {})
    field = ".".join(parts) or "body"
    if kind == "missing":
        return field, "is missing"
    if kind in ("too_short", "too_long"):
        limit = context.get("min_length", context.get("max_length"))
        return field, f"is given {context.get('actual_length')} times, {limit} are needed"
    words = str(fault.get("msg", "invalid"))
    if kind in _WORDS:
        words = _WORDS[kind].format(**{name: _number(value) for name, value in context.items()})
    value = fault.get("input")
    shown = f"is '{str(value)[:_MAX_SHOWN]}': " if isinstance(value, str | int | float) else ""
    return field, shown + words


def validate_fields(model: type[Model], fields: Mapping[str, str], context: Mapping[str, object]) -> Model:
    """Return the fields of a form as a model; empty fields count as left out."""
    try:
        return model.model_validate({name: value for name, value in fields.items() if value.strip()}, context=context)
    except ValidationError as error:
        raise InvalidRequestError([describe_fault(fault) for fault in error.errors()]) from error


def faults_of(
    model: type[BaseModel], fields: Mapping[str, str], context: Mapping[str, object]
) -> list[tuple[str, str]]:
    """Return the faults for which `validate_fields` would raise."""
    try:
        validate_fields(model, fields, context)
    except InvalidRequestError as error:
        return error.faults
    return []


def parse_document(model: type[Model], content: bytes, max_values: int) -> Model:
    """Parse a JSON text as a model; `max_values` as for `read_json`."""
    try:
        value = read_json(content, _MAX_DEPTH, max_values)
    except InvalidFloorPlanError as error:
        # `read_json` is the reader of plans; only its error type is specific to them.
        raise InvalidRequestError([("body", str(error))]) from error
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise InvalidRequestError([describe_fault(fault) for fault in error.errors()[:_MAX_FAULTS]]) from error


async def check_parameters(request: Request) -> None:
    """Refuse unknown query parameters, except of pages; a dependency of every route."""
    counts = Counter(name for name, _ in request.query_params.multi_items())
    route = request.scope.get("route")
    # Messengers and mail programs add parameters to links to pages, which are not in the schema.
    if not counts or not getattr(route, "include_in_schema", True):
        return
    known = _parameters_of(route)
    unknown = _unknown(known, is_form=_takes_form(route))
    faults = [(name[:50], unknown) for name in counts if name not in known]
    faults += [(name, "given more than once") for name, many in known.items() if counts[name] > 1 and not many]
    if faults:
        raise InvalidRequestError(faults)


def _parameters_of(route: object) -> dict[str, bool]:
    """Return the query parameters of a route; True for those that can be repeated."""
    if not isinstance(route, APIRoute):
        return {}
    found: dict[str, bool] = {}
    waiting: list[Dependant] = [route.dependant]
    while waiting:
        dependant = waiting.pop()
        waiting += dependant.dependencies
        found |= {field.alias: "list[" in str(field.field_info.annotation) for field in dependant.query_params}
    return found


def _takes_form(route: object) -> bool:
    """Return whether the body of a route is a form of several parts."""
    described = route.openapi_extra or {} if isinstance(route, APIRoute) else {}
    return "multipart/form-data" in described.get("requestBody", {}).get("content", {})


def _unknown(known: dict[str, bool], *, is_form: bool) -> str:
    names = f"known: {', '.join(sorted(known))}" if known else "this route has none"
    advice = "; send fields in the body, which is multipart/form-data" if is_form else ""
    return f"unknown query parameter; {names}{advice}"
