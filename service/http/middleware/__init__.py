"""Middlewares of the app, outermost first.

telemetry         request ids, metrics, log line, span
security_headers  security headers of answers
cors              cross-origin requests of allowed pages
framing           400 for a request with two body lengths
head              HEAD as GET without a body
authorisation     caller and tenant, or 401, 403 and 429
admission         slot for the request, or 503

Begin with `telemetry.py`. `service.app` stacks them; their rules are in `service.telemetry`,
`service.capacity.admission_control` and `service.security`.
"""

from service.http.middleware.admission import AdmissionMiddleware
from service.http.middleware.authorisation import AuthorisationMiddleware
from service.http.middleware.cors import CorsMiddleware
from service.http.middleware.framing import FramingMiddleware
from service.http.middleware.head import HeadMiddleware
from service.http.middleware.security_headers import SecurityHeadersMiddleware
from service.http.middleware.telemetry import TelemetryMiddleware
