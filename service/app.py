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

from lalaloc_core import __version__
from service.problems import install_problem_handlers
from service.routes import floorplans, health, localise, pages
from service.runtime import start_runtime
from service.schemas import FloorPlanDocument, Problem
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
    app = FastAPI(
        title="LaLaLoc",
        version=__version__,
        description=_DESCRIPTION,
        lifespan=partial(_lifespan, settings, telemetry),
        # The stock documentation pages load their scripts from elsewhere; `routes.pages` has one that does not.
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(TelemetryMiddleware, telemetry=telemetry)
    install_problem_handlers(app)
    for router in (floorplans.router, localise.router, health.router, pages.router):
        app.include_router(router)
    app.openapi = partial(_openapi, app)
    return app


@asynccontextmanager
async def _lifespan(settings: Settings | None, telemetry: Telemetry, app: FastAPI) -> AsyncIterator[None]:
    settings = settings or Settings.load()
    configure_logging(settings.log_level)
    with ExitStack() as cleanup:
        app.state.runtime = await asyncio.to_thread(start_runtime, settings, telemetry, cleanup)
        yield


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The API description, with the models that only hand-written parts of it refer to."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        for model in (FloorPlanDocument, Problem):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            schemas[model.__name__] = schema
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        app.openapi_schema = document
    return app.openapi_schema


app = create_app()
