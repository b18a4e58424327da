"""What the service tells of itself: metrics, log lines as JSON, and, when asked for, OpenTelemetry spans.

Begin with `metrics.py`. `log_fields.py` is what is told of one request; `service.http.middleware.telemetry` tells it.
"""

from service.telemetry.log_fields import RequestLogFields, add_log_fields, request_id_of
from service.telemetry.logs import LOGGER_NAME, configure_logging
from service.telemetry.metrics import Telemetry

__all__ = [
    "LOGGER_NAME",
    "RequestLogFields",
    "Telemetry",
    "add_log_fields",
    "configure_logging",
    "request_id_of",
]
