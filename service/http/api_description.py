"""OpenAPI document: the framework's description of the routes, completed by hand-written schemas, errors and scopes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from starlette.routing import Route

from service.capacity.admission_control import PROBE, REFUSALS, declared_class
from service.http.problems import add_problems
from service.schemas import EarthPoint, SessionDocument
from service.schemas.admin import KeyDocument, RotationDocument, TenantLimitsDocument
from service.schemas.albums import AlbumDocument, AlbumEvent, PhotographChangeDocument
from service.schemas.fields import Problem
from service.schemas.native_plan import FloorPlanDocument
from service.schemas.photographs import StatedIntrinsics
from service.schemas.plan_import import ImportLine
from service.schemas.query_fields import PlanPoint
from service.schemas.stored_plans import PlanEvent
from service.schemas.venues import VenueChangeDocument, VenueDocument
from service.security import access_control
from service.security.permissions import NEEDED

_KEY = "api_key"
# The first server is the one that sends the description; a client made from the file needs an address.
_SERVERS = [
    {"url": "/", "description": "The service that sends this description"},
    {"url": "http://127.0.0.1:8000", "description": "A service on this machine, with default settings"},
]
# Models that only hand-written parts of the description use.
_BY_HAND = (
    AlbumDocument, AlbumEvent, PhotographChangeDocument, EarthPoint, FloorPlanDocument, ImportLine, KeyDocument,
    PlanEvent, PlanPoint, Problem, RotationDocument, StatedIntrinsics, SessionDocument, TenantLimitsDocument,
    VenueDocument, VenueChangeDocument,
)  # fmt: skip


def operation_id(route: APIRoute) -> str:
    """Return the name of a route's function in camel case, such as `createFloorplan`.

    Generated clients name their methods by it, so renaming the function breaks them.
    """
    first, *rest = route.name.split("_")
    return first + "".join(word.title() for word in rest)


def describe_api(app: FastAPI, routes: Sequence[Route]) -> dict[str, Any]:
    """Return the OpenAPI document of the app with these routes; it is built once."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes, servers=_SERVERS
        )
        schemas = document["components"]["schemas"]
        for model in _BY_HAND:
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            schemas[model.__name__] = schema
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        probes = {route.path for route in routes if declared_class(route.endpoint) == PROBE}
        for path, operations in document["paths"].items():
            if path not in probes:
                for operation in operations.values():
                    add_problems(operation, *REFUSALS)
        _describe_keys(document)
        _sort_properties(document)
        app.openapi_schema = document
    return app.openapi_schema


def _describe_keys(document: dict[str, Any]) -> None:
    """Add the scope of each operation, and its errors about keys."""
    document["components"]["securitySchemes"] = {
        _KEY: {
            "type": "http",
            "scheme": "bearer",
            "bearerFormat": "lalaloc_<id>_<secret>",
            "description": "API key, or token of the OpenID Connect issuer; required if `LALALOC_API_KEYS=on`. Each "
            "operation names the scope that it needs: `metrics`, `read`, `localise`, `write` or `admin`. Callers see "
            "the floor plans of their own tenant only.",
        }
    }
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            needed = NEEDED.get((method.upper(), path))
            if needed is not None:
                operation["security"] = [{_KEY: [needed.value]}]
                add_problems(operation, *access_control.REFUSALS)


def _sort_properties(part: Any) -> None:
    """Put required properties of all schemas first, since generated constructors take arguments in this order."""
    if isinstance(part, list):
        for item in part:
            _sort_properties(item)
    elif isinstance(part, dict):
        properties, required = part.get("properties"), part.get("required")
        if isinstance(properties, dict) and isinstance(required, list):
            part["properties"] = dict(sorted(properties.items(), key=lambda item: item[0] not in required))
        for item in part.values():
            _sort_properties(item)
