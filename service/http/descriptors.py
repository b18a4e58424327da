"""File descriptors: as many as are needed and allowed, and no more connections than leave some for everything else."""

from __future__ import annotations

import logging
import resource

from lalaloc_core.errors import ConfigError
from service.settings import Settings
from service.telemetry import LOGGER_NAME

# Pipes of workers, listeners, files of the model and of the interpreter.
_OTHERS = 192
# SQLite has the database, its log and their index open.
_PER_DATABASE_CONNECTION = 3
_MIN_CONNECTIONS = 16


def max_connections_of(wanted: int, settings: Settings) -> int:
    """How many connections there may be; first the process is allowed as many descriptors as the system lets it have.

    Raises:
        ConfigError: the system allows so few descriptors that hardly any is left for a connection.
    """
    others = _OTHERS + _PER_DATABASE_CONNECTION * settings.database.connections
    allowed = _raised_to(wanted + others)
    if allowed - others < _MIN_CONNECTIONS:
        raise ConfigError(
            f"the system allows {allowed} file descriptors, at least {others + _MIN_CONNECTIONS} are needed; see "
            "`ulimit -n`"
        )
    if allowed - others < wanted:
        fields = {"max_connections": allowed - others, "wanted": wanted, "descriptors": allowed}
        logging.getLogger(LOGGER_NAME).warning("fewer connections than set", extra={"fields": fields})
    return min(wanted, allowed - others)


def _raised_to(needed: int) -> int:
    """The limit of descriptors, raised as far as is needed and may be."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return needed
    if soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return soft
