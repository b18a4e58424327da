"""Query parameters that a route does not know are refused, as parts of forms are: what is ignored looks like done."""

from __future__ import annotations

from collections import Counter

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute

from service.errors import InvalidRequestError


async def check_parameters(request: Request) -> None:
    """A dependency of every route.

    Raises:
        InvalidRequestError: names every query parameter that the route does not know, or that is given more than once
            where one is meant.
    """
    given = Counter(name for name, _ in request.query_params.multi_items())
    if not given:
        return
    known = _parameters_of(request.scope.get("route"))
    faults = [(name[:50], _unknown(known)) for name in given if name not in known]
    once = [name for name, repeatable in known.items() if not repeatable]
    faults += [(name, "given more than once") for name in once if given[name] > 1]
    if faults:
        raise InvalidRequestError(faults)


def _parameters_of(route: object) -> dict[str, bool]:
    """The query parameters of a route, and whether each may be given more than once."""
    if not isinstance(route, APIRoute):
        return {}
    found: dict[str, bool] = {}
    waiting: list[Dependant] = [route.dependant]
    while waiting:
        dependant = waiting.pop()
        waiting += dependant.dependencies
        found |= {field.alias: "list[" in str(field.field_info.annotation) for field in dependant.query_params}
    return found


def _unknown(known: dict[str, bool]) -> str:
    if not known:
        return "unknown query parameter, there are none"
    return f"unknown query parameter, known are {', '.join(sorted(known))}"
