"""The app's own middlewares, outermost first: what happens to every request before its route, and to every answer.

telemetry         ids, metrics, log line, span
security_headers  what browsers may do with an answer
admission         a slot, or 503 at once
access_control    a caller with a tenant, or 401 and 403

`service.app` stacks them. What they decide by stands in `service.telemetry`, `service.http.admission` and
`service.security`.
"""

from service.http.middleware.access_control import AccessControlMiddleware
from service.http.middleware.admission import AdmissionMiddleware
from service.http.middleware.security_headers import SecurityHeadersMiddleware
from service.http.middleware.telemetry import TelemetryMiddleware

__all__ = ["AccessControlMiddleware", "AdmissionMiddleware", "SecurityHeadersMiddleware", "TelemetryMiddleware"]
