"""What the service tells of itself: metrics, log lines as JSON, and, when asked for, OpenTelemetry spans.

Begin with `metrics.py`. `facts.py` is what is told of one request; `service.http.middleware.telemetry` tells it.
"""

from service.telemetry.facts import RequestFacts, note, request_id_of
from service.telemetry.logs import LOGGER_NAME, configure_logging
from service.telemetry.metrics import Telemetry

__all__ = [
    "LOGGER_NAME",
    "RequestFacts",
    "Telemetry",
    "configure_logging",
    "note",
    "request_id_of",
]
