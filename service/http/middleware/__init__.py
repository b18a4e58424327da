"""Middlewares of the app, outermost first.

telemetry      request ids, metrics, log line, span
heads          security headers, cross-origin requests of allowed pages, 400 for a request with two body lengths, HEAD
authorisation  caller and tenant, or 401, 403 and 429
admission      slot for the request, or 503

Begin with `telemetry.py`. `service.app` stacks them; their rules are in `service.telemetry`,
`service.capacity.admission_control` and `service.security`.
"""

from service.http.middleware.admission import AdmissionMiddleware
from service.http.middleware.authorisation import AuthorisationMiddleware
from service.http.middleware.heads import CorsMiddleware, FramingMiddleware, HeadMiddleware, SecurityHeadersMiddleware
from service.http.middleware.telemetry import TelemetryMiddleware
