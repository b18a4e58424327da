"""Keys, scopes and refusals in the API description."""

from __future__ import annotations

from typing import Any

from service.http.problems import add_problems
from service.security.access import NEEDED
from service.security.middleware import REFUSALS

_NAME = "api_key"


def describe_security(document: dict[str, Any]) -> None:
    """Add to an OpenAPI document what each operation needs while keys are on, and how it refuses."""
    document["components"]["securitySchemes"] = {
        _NAME: {
            "type": "http",
            "scheme": "bearer",
            "bearerFormat": "lalaloc_<id>_<secret>",
            "description": "An API key, where they are switched on (`LALALOC_API_KEYS`). Operations name the scope "
            "that the key needs: `read`, `localise` or `write`. Floor plans belong to the key's tenant; those of "
            "another are as if they did not exist.",
        }
    }
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            needed = NEEDED.get((method.upper(), path))
            if needed is not None:
                operation["security"] = [{_NAME: [needed.value]}]
                add_problems(operation, *REFUSALS)
