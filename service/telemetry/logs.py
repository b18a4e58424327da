"""Log lines as JSON on standard error, each with the ids of the request that it belongs to."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime

from service.telemetry.log_fields import current_log_fields

LOGGER_NAME = "lalaloc"
# The HTTP server's own: its log of accesses holds query strings, and says nothing that ours does not.
_SERVER, _SERVER_ACCESS = "uvicorn", "uvicorn.access"
# Warns of what clients send; they are told, and the line of their request says so.
_FORMS = "python_multipart"


class JsonFormatter(logging.Formatter):
    """One JSON object per line: time (UTC), level, message, ids, and the fields given as `extra={"fields": ...}`.

    `request_id` and `trace_id` are null on lines that belong to no request.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line, plain ASCII."""
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
    """Send the service's log, and those of libraries, to standard error; calling it again only changes the level."""
    logger = logging.getLogger(LOGGER_NAME)
    logger.setLevel(level.upper())
    if not any(isinstance(handler.formatter, JsonFormatter) for handler in logger.handlers):
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
        logger.addHandler(handler)
        logger.propagate = False
        server = logging.getLogger(_SERVER)
        server.handlers, server.propagate = [handler], False
        # What libraries say, unless whoever runs the app listens already.
        if not logging.getLogger().handlers:
            logging.getLogger().addHandler(handler)
    access = logging.getLogger(_SERVER_ACCESS)
    access.handlers, access.propagate = [], False
    logging.getLogger(_FORMS).setLevel(logging.ERROR)
    return logger
