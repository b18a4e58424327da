"""Parts that the commands of `lalaloc-service` share."""

from __future__ import annotations

import argparse
import getpass
import json
import os
import re
from collections.abc import Sequence
from contextlib import closing
from datetime import timedelta

from service.schemas.admin import TENANT
from service.settings import Settings
from service.storage import Store, open_store
from service.storage.records import AuditEntry

_UNITS_S = {"d": 86400, "h": 3600, "m": 60, "s": 1}
_DURATION = re.compile(r"([0-9]{1,9})([dhms])", re.ASCII)


def configured_store() -> closing[Store]:
    """Open the store of the settings in the environment."""
    return closing(open_store(Settings.load()))


def audit(store: Store, tenant: str, action: str, resource: str, **facts: object) -> None:
    """Add what a command did to a tenant to the audit log. Never pass secrets."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        # A container's user can lack a name.
        user = str(os.getuid())
    detail = json.dumps(facts, default=str) if facts else None
    store.audit_log.add(
        [AuditEntry(actor=f"cli:{user[:64]}", tenant=tenant, action=action, resource=resource, detail=detail)]
    )


def duration(given: str) -> timedelta:
    """Return a duration such as `90d`, `12h`, `30m` or `45s`."""
    found = _DURATION.fullmatch(given)
    if found is None:
        raise argparse.ArgumentTypeError("a whole number and a unit: 90d, 12h, 30m or 45s")
    return timedelta(seconds=int(found[1]) * _UNITS_S[found[2]])


def tenant_name(given: str) -> str:
    """Return the name of a tenant."""
    if not TENANT.fullmatch(given):
        raise argparse.ArgumentTypeError("1 to 64 letters, digits, '.', '_' and '-', beginning with a letter or digit")
    return given


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text, with columns as wide as their longest cell."""
    widths = [max(len(row[column]) for row in (head, *rows)) for column in range(len(head))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows))
    return "\n".join(line.rstrip() for line in lines)
