"""OpenAPI document: the framework's description of the routes, completed by hand-written schemas, errors and scopes."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.http import admission_control as admission
from service.http.problems import add_problems
from service.schemas import (
    EarthPoint,
    FloorPlanDocument,
    PlanEvent,
    PlanPoint,
    Problem,
    StatedMotion,
    VenueChangeDocument,
    VenueDocument,
)
from service.schemas.oscp import OscpRequest
from service.security import access_control
from service.security.permissions import NEEDED

_KEY = "api_key"
# Models that only hand-written parts of the description use.
_BY_HAND = (
    EarthPoint,
    FloorPlanDocument,
    OscpRequest,
    PlanEvent,
    PlanPoint,
    Problem,
    StatedMotion,
    VenueDocument,
    VenueChangeDocument,
)


def describe_api(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of the app; it is built once."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        for model in _BY_HAND:
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            schemas[model.__name__] = schema
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        for path, operations in document["paths"].items():
            if path not in admission.EXEMPT:
                for operation in operations.values():
                    add_problems(operation, *admission.REFUSALS)
        _describe_keys(document)
        app.openapi_schema = document
    return app.openapi_schema


def _describe_keys(document: dict[str, Any]) -> None:
    """Add the scope of each operation, and its errors about keys."""
    document["components"]["securitySchemes"] = {
        _KEY: {
            "type": "http",
            "scheme": "bearer",
            "bearerFormat": "lalaloc_<id>_<secret>",
            "description": "API key, required if `LALALOC_API_KEYS=on`. Each operation names the scope that the key "
            "needs: `read`, `localise` or `write`. A key sees the floor plans of its own tenant only.",
        }
    }
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            needed = NEEDED.get((method.upper(), path))
            if needed is not None:
                operation["security"] = [{_KEY: [needed.value]}]
                add_problems(operation, *access_control.REFUSALS)
