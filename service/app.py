"""The application: `uvicorn service.app:app`.

Making the app does no work; settings are read, the model loaded and the LPO pool started when it starts.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from functools import partial

from fastapi import Depends, FastAPI
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from lalaloc_core import __version__
from service.http.api_description import describe_api
from service.http.middleware import (
    AdmissionMiddleware,
    AuthorisationMiddleware,
    CorsMiddleware,
    FramingMiddleware,
    HeadMiddleware,
    SecurityHeadersMiddleware,
    TelemetryMiddleware,
)
from service.http.fields import check_parameters
from service.http.problems import install_problem_handlers
from service.problem_kinds import HTTP_PROBLEMS, PROBLEMS
from service.routes import ROUTERS
from service.runtime import LOCAL_BACKENDS, Backends, start_runtime
from service.settings import Settings
from service.telemetry import Telemetry, configure_logging

_DESCRIPTION = (
    "Localises 360° panoramas in floor plans. Lengths are metres in the plan frame (x to the right, y up on the "
    "drawing), headings are degrees clockwise from the plan's +y. Errors are `application/problem+json` (RFC 9457). "
    "Every GET may be a HEAD as well. What a route does not know, part of a form or query parameter, is refused by its "
    "name."
)


def create_app(settings: Settings | None = None, backends: Backends = LOCAL_BACKENDS) -> FastAPI:
    """Make an application.

    Args:
        settings: by default read from the environment when the application starts.
        backends: what may be in other processes.
    """
    telemetry = Telemetry()
    # Shown as 0 from the start, so that the first one is a rise.
    for kind in (*PROBLEMS.values(), *HTTP_PROBLEMS.values()):
        telemetry.rejections.labels(kind.slug)
    app = FastAPI(
        title="LaLaLoc",
        version=__version__,
        description=_DESCRIPTION,
        dependencies=[Depends(check_parameters)],
        lifespan=partial(_lifespan, settings, telemetry, backends),
        # The stock documentation pages load their scripts from elsewhere; `routes.pages` has one that does not.
        docs_url=None,
        redoc_url=None,
    )
    install_problem_handlers(app)
    for router in ROUTERS:
        app.include_router(router)
    app.openapi = partial(describe_api, app)
    routes = [route for router in ROUTERS for route in router.routes]
    app.build_middleware_stack = partial(_layers, app, telemetry, routes)
    return app


def _layers(app: FastAPI, telemetry: Telemetry, routes: list[BaseRoute]) -> ASGIApp:
    """The app's layers, outermost first: log, headers, CORS, framing, HEAD, keys, admission, the framework's.

    Middleware that is added to an app lies inside the layer that answers unexpected errors, and never sees those.
    """
    # Keys first: it is tenants that slots are shared between.
    admitted = HeadMiddleware(AuthorisationMiddleware(AdmissionMiddleware(FastAPI.build_middleware_stack(app))))
    named = [route for route in routes if isinstance(route, Route)]
    return TelemetryMiddleware(SecurityHeadersMiddleware(CorsMiddleware(FramingMiddleware(admitted))), telemetry, named)


@asynccontextmanager
async def _lifespan(
    settings: Settings | None, telemetry: Telemetry, backends: Backends, app: FastAPI
) -> AsyncIterator[None]:
    settings = settings or Settings.load()
    logger = configure_logging(settings.log_level)
    with ExitStack() as cleanup:
        runtime = app.state.runtime = await asyncio.to_thread(start_runtime, settings, telemetry, cleanup, backends)
        app.state.cors_origins = settings.access.cors_origin_set
        app.state.admission = runtime.admission
        app.state.access_control = runtime.access_control
        yield
        logger.info("service stops")
    logger.info("service stopped")


app = create_app()
