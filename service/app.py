"""The application: `uvicorn service.app:app`.

Creating the app does no work; at start-up it reads the settings, loads the model and starts the worker processes.
"""

from __future__ import annotations

import asyncio
import gc
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from functools import partial

from fastapi import Depends, FastAPI
from starlette.routing import Route
from starlette.types import ASGIApp

from lalaloc_core import __version__
from service.errors import HTTP_PROBLEMS, PROBLEMS
from service.http.api_description import describe_api, operation_id
from service.http.fields import check_parameters
from service.http.middleware import (
    AdmissionMiddleware,
    AuthorisationMiddleware,
    CorsMiddleware,
    FramingMiddleware,
    HeadMiddleware,
    SecurityHeadersMiddleware,
    TelemetryMiddleware,
)
from service.http.problems import install_problem_handlers
from service.http.server import ServedApp, bound_uvicorn
from service.query_components import LOCAL_BACKENDS, Backends
from service.routes import ROUTERS
from service.runtime import start_runtime
from service.settings import Settings
from service.telemetry import Telemetry, configure_logging

_DESCRIPTION = (
    "Localises photographs in floor plans: 360° spheres and, by models with an encoder of views, ordinary, fisheye and "
    "phone photographs. Lengths are metres in the plan frame (x to the right, y up on the drawing), headings are "
    "degrees clockwise from the plan's +y. Errors are `application/problem+json` (RFC 9457). Every GET route also "
    "answers HEAD. Unknown form fields and query parameters are refused."
)


def create_app(settings: Settings | None = None, backends: Backends = LOCAL_BACKENDS) -> FastAPI:
    """Create an application.

    Without settings, those in the environment are read at start-up.
    """
    telemetry = Telemetry()
    # Exported as 0 from the start, so that the first one shows as an increase.
    for kind in (*PROBLEMS.values(), *HTTP_PROBLEMS.values()):
        telemetry.rejections.labels(kind.slug)
    app = ServedApp(
        title="LaLaLoc",
        version=__version__,
        description=_DESCRIPTION,
        dependencies=[Depends(check_parameters)],
        lifespan=partial(_lifespan, settings, telemetry, backends),
        # The framework's documentation pages load scripts from a CDN; `routes.pages` has one that does not.
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=operation_id,
    )
    install_problem_handlers(app)
    for router in ROUTERS:
        app.include_router(router)
    routes = [route for router in ROUTERS for route in router.routes if isinstance(route, Route)]
    app.openapi = partial(describe_api, app, routes)
    app.build_middleware_stack = partial(_layers, app, telemetry, routes)
    return app


def _layers(app: FastAPI, telemetry: Telemetry, routes: list[Route]) -> ASGIApp:
    """Return the app with its middlewares, outermost first: log, headers, CORS, framing, HEAD, keys, admission.

    `FastAPI.add_middleware` would put them inside the layer that answers unexpected errors.
    """
    # Keys come before admission, because slots are shared between tenants.
    admitted = HeadMiddleware(AuthorisationMiddleware(AdmissionMiddleware(FastAPI.build_middleware_stack(app), routes)))
    return TelemetryMiddleware(
        SecurityHeadersMiddleware(CorsMiddleware(FramingMiddleware(admitted))), telemetry, routes
    )


# Allocations before a collection of the youngest objects, and collections of each age before one of the next age. With
# Python's own (700, 10, 10), loading a large plan walks through all objects several times, 0.3 s without a pause each.
_COLLECTION_THRESHOLDS = (10_000, 10, 100)


@asynccontextmanager
async def _lifespan(
    settings: Settings | None, telemetry: Telemetry, backends: Backends, app: FastAPI
) -> AsyncIterator[None]:
    gc.set_threshold(*_COLLECTION_THRESHOLDS)
    settings = settings or Settings.load()
    bound_uvicorn(app, settings)
    logger = configure_logging(settings.log_level)
    with ExitStack() as cleanup:
        runtime = app.state.runtime = await asyncio.to_thread(start_runtime, settings, telemetry, cleanup, backends)
        app.state.cors_origins = settings.access.cors_origin_set
        app.state.admission = runtime.admission
        app.state.access_control = runtime.access_control
        app.state.audit_trail = runtime.audit_trail
        solving = asyncio.create_task(runtime.albums.run())
        try:
            yield
        finally:
            solving.cancel()
            await asyncio.wait({solving})
        logger.info("service is stopping")
    logger.info("service stopped")


app = create_app()
