"""The app's own middlewares, outermost first: what happens to every request before its route, and to every answer.

telemetry         ids, metrics, log line, span
security_headers  what browsers may do with an answer
cors              which pages of other sites may ask, where the settings name any
framing           one length of a body, or 400
head              HEAD as GET without a body
authorisation     a caller with a tenant, or 401 and 403
admission         a slot of what tenants share, or 503 at once

Begin with `telemetry.py`. `service.app` stacks them. What they decide by stands in `service.telemetry`,
`service.http.admission_control` and `service.security`.
"""

from service.http.middleware.admission import AdmissionMiddleware
from service.http.middleware.authorisation import AuthorisationMiddleware
from service.http.middleware.cors import CorsMiddleware
from service.http.middleware.framing import FramingMiddleware
from service.http.middleware.head import HeadMiddleware
from service.http.middleware.security_headers import SecurityHeadersMiddleware
from service.http.middleware.telemetry import TelemetryMiddleware

__all__ = [
    "AdmissionMiddleware",
    "AuthorisationMiddleware",
    "CorsMiddleware",
    "FramingMiddleware",
    "HeadMiddleware",
    "SecurityHeadersMiddleware",
    "TelemetryMiddleware",
]
