"""Metrics, logs as JSON, and optional OpenTelemetry spans.

Begin with `metrics.py`. `log_fields.py` holds the fields of a request's log line, written by
`service.http.middleware.telemetry`.
"""

from service.telemetry.log_fields import RequestLogFields, add_log_fields, request_id_of
from service.telemetry.logs import LOGGER_NAME, configure_logging
from service.telemetry.metrics import Telemetry
