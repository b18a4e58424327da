"""Metrics, logs as JSON, and optional OpenTelemetry spans.

Begin with `metrics.py`. `logs.py` holds the fields of a request's log line, written by
`service.http.middleware.telemetry`, and the trace context of its header.
"""

from service.telemetry.logs import LOGGER_NAME, RequestLogFields, add_log_fields, configure_logging, request_id_of
from service.telemetry.metrics import Telemetry
