"""Command about the audit log: `lalaloc-service audit export`."""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from service.cli.command_parts import configured_store, tenant_name


def add_audit_commands(commands: Any) -> None:
    """Add the group `audit` to the commands."""
    audit = commands.add_parser("audit", help="export the audit log").add_subparsers(required=True)
    export = audit.add_parser("export", help="print the entries as lines of JSON, oldest first")
    export.add_argument("--tenant", type=tenant_name, help="only entries of this tenant")
    export.add_argument(
        "--since", type=_moment, metavar="TIME", help="only entries from this time on: 2026-01-31T12:00Z"
    )
    export.add_argument("--until", type=_moment, metavar="TIME", help="only entries before this time")
    export.set_defaults(run=_export)


def _export(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        entries = store.audit_log.export(tenant=arguments.tenant, since=arguments.since, until=arguments.until)
        try:
            for entry in entries:
                detail = None if entry.detail is None else json.loads(entry.detail)
                line = asdict(entry) | {"created_at": entry.created_at.isoformat(), "detail": detail}
                print(json.dumps(line))
            sys.stdout.flush()
        except BrokenPipeError:
            # A reader such as `head` has enough; the interpreter must not write the rest at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _moment(given: str) -> datetime:
    try:
        moment = datetime.fromisoformat(given)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{given[:64]}' is no time such as 2026-01-31T12:00Z") from error
    # Without a time zone it is UTC, as in the entries.
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    if not 1970 <= moment.year < 9999:
        raise argparse.ArgumentTypeError(f"the year is {moment.year}; give one from 1970 to 9998")
    return moment
