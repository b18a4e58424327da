"""Logging as JSON on standard error, with the ids of the request."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime

from service.telemetry.log_fields import current_log_fields

LOGGER_NAME = "lalaloc"
# The HTTP server's access log contains query strings and adds nothing to ours.
_SERVER, _SERVER_ACCESS = "uvicorn", "uvicorn.access"
# The warnings about client input are already in the answers and in the log line of the request.
_FORMS = "python_multipart"


class JsonFormatter(logging.Formatter):
    """Formatter with one JSON object per line: time (UTC), level, message, ids, and fields.

    Fields are given as `extra={"fields": ...}`; `request_id` and `trace_id` are null outside requests.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the line in ASCII."""
        log_fields = current_log_fields.get()
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
            "request_id": log_fields and log_fields.request_id,
            "trace_id": log_fields and log_fields.trace.trace_id,
        }
        line.update(getattr(record, "fields", {}))
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: str) -> logging.Logger:
    """Log to standard error, libraries included; a second call only changes the level."""
    logger = logging.getLogger(LOGGER_NAME)
    logger.setLevel(level.upper())
    if not any(isinstance(handler.formatter, JsonFormatter) for handler in logger.handlers):
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
        logger.addHandler(handler)
        logger.propagate = False
        server = logging.getLogger(_SERVER)
        server.handlers, server.propagate = [handler], False
        # Library logs, unless the application has a handler of its own.
        if not logging.getLogger().handlers:
            logging.getLogger().addHandler(handler)
    access = logging.getLogger(_SERVER_ACCESS)
    access.handlers, access.propagate = [], False
    logging.getLogger(_FORMS).setLevel(logging.ERROR)
    return logger
