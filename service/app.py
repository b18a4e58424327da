"""The application: `uvicorn service.app:app`.

Making the app does no work; settings are read, the model loaded and the LPO pool started when it starts.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from lalaloc_core import __version__
from service.errors import HTTP_PROBLEMS, PROBLEMS
from service.http.admission import EXEMPT, REFUSALS, AdmissionMiddleware
from service.http.headers import SecurityHeadersMiddleware
from service.http.problems import add_problems, install_problem_handlers
from service.routes import floorplans, health, limits, localise, pages, plan_events, plan_files
from service.runtime import start_runtime
from service.schemas import FloorPlanDocument, PlanEvent, Problem
from service.security.description import describe_security
from service.security.middleware import GateMiddleware
from service.settings import Settings
from service.telemetry import Telemetry, TelemetryMiddleware, configure_logging

_DESCRIPTION = (
    "Localises 360° panoramas in floor plans. Lengths are metres in the plan frame (x to the right, y up on the "
    "drawing), headings are degrees clockwise from the plan's +y. Errors are `application/problem+json` (RFC 9457)."
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """Make an application.

    Args:
        settings: by default read from the environment when the application starts.
    """
    telemetry = Telemetry()
    # Shown as 0 from the start, so that the first one is a rise.
    for kind in (*PROBLEMS.values(), *HTTP_PROBLEMS.values()):
        telemetry.rejections.labels(kind.slug)
    app = FastAPI(
        title="LaLaLoc",
        version=__version__,
        description=_DESCRIPTION,
        lifespan=partial(_lifespan, settings, telemetry),
        # The stock documentation pages load their scripts from elsewhere; `routes.pages` has one that does not.
        docs_url=None,
        redoc_url=None,
    )
    install_problem_handlers(app)
    rooms = (floorplans, plan_files, plan_events, localise, health, limits, pages)
    routers = [room.router for room in rooms]
    for router in routers:
        app.include_router(router)
    app.openapi = partial(_openapi, app)
    routes = [route for router in routers for route in router.routes]
    app.build_middleware_stack = partial(_layers, app, telemetry, routes)
    return app


def _layers(app: FastAPI, telemetry: Telemetry, routes: list[BaseRoute]) -> ASGIApp:
    """The app's layers, outermost first: ids and log, security headers, admission, keys, then the framework's.

    Middleware that is added to an app lies inside the layer that answers unexpected errors, and never sees those.
    """
    admitted = AdmissionMiddleware(GateMiddleware(FastAPI.build_middleware_stack(app)))
    named = [route for route in routes if isinstance(route, Route)]
    return TelemetryMiddleware(SecurityHeadersMiddleware(admitted), telemetry, named)


@asynccontextmanager
async def _lifespan(settings: Settings | None, telemetry: Telemetry, app: FastAPI) -> AsyncIterator[None]:
    settings = settings or Settings.load()
    logger = configure_logging(settings.log_level)
    with ExitStack() as cleanup:
        runtime = app.state.runtime = await asyncio.to_thread(start_runtime, settings, telemetry, cleanup)
        app.state.admission = runtime.admission
        app.state.gate = runtime.gate
        yield
        logger.info("service stops")
    logger.info("service stopped")


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The API description, with the models that only hand-written parts of it refer to."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        for model in (FloorPlanDocument, PlanEvent, Problem):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            schemas[model.__name__] = schema
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        for path, operations in document["paths"].items():
            if path not in EXEMPT:
                for operation in operations.values():
                    add_problems(operation, *REFUSALS)
        describe_security(document)
        app.openapi_schema = document
    return app.openapi_schema


app = create_app()
