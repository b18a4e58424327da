"""Commands about stored data: `lalaloc-service tenants`, `audit`, `compact`, `backup` and `restore`."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from service.cli.command_parts import audit, configured_store, tenant_name, text_table
from service.settings import Settings
from service.storage.backup import back_up, database_file, restore
from service.storage.records import OperatorLimits

_DEFAULT = "default"


def add_tenant_commands(commands: Any) -> None:
    """Add the group `tenants` to the commands."""
    tenants = commands.add_parser("tenants", help="list, limit and purge tenants").add_subparsers(required=True)

    listing = tenants.add_parser("list", help="list the tenants that stored data or have limits of their own")
    listing.add_argument("--json", action="store_true", help="print JSON instead of a table")
    listing.set_defaults(run=_list)

    limit = tenants.add_parser("limit", help="set limits of a tenant; in effect within 5 s")
    limit.add_argument("tenant", type=tenant_name, help="the tenant")
    for name, kind, meaning in (
        ("stored_bytes", _whole, "limit of stored bytes"),
        ("bytes_in_flight", _whole, "limit of the bytes of requests in progress"),
        ("cpu_share", _weight, "weight in queues: with 2 its CPU seconds count half"),
    ):
        option = "--" + name.replace("_", "-")
        text = f"{meaning}, or '{_DEFAULT}' for the limit in the settings"
        limit.add_argument(option, dest=name, type=_or_default(kind), default=argparse.SUPPRESS, help=text)
    limit.set_defaults(run=_limit)

    purge = tenants.add_parser("purge", help="delete all that a tenant stored; its API keys and limits stay")
    purge.add_argument("tenant", type=tenant_name, help="the tenant")
    purge.add_argument("--yes", action="store_true", required=True, help="confirm the deletion")
    purge.set_defaults(run=_purge)

    compact = commands.add_parser(
        "compact",
        help="write an SQLite file anew, so that it returns space to the disk; once for files of earlier versions",
    )
    compact.set_defaults(run=_compact)


def _list(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        accounts, limits = store.quota.accounts(), store.tenants.limits()
    listed = [
        {"tenant": tenant, "used_bytes": accounts[tenant].used.total, **asdict(limits.get(tenant, OperatorLimits()))}
        for tenant in sorted(accounts)
    ]
    if arguments.json:
        print(json.dumps(listed, indent=2))
        return 0
    head = ("TENANT", "USED BYTES", "STORED BYTES", "BYTES IN FLIGHT", "CPU SHARE")
    print(text_table(head, [[row["tenant"], *map(_text, list(row.values())[1:])] for row in listed]))
    return 0


def _purge(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        count = store.purge_tenant(arguments.tenant)
        store.database.give_back()
        audit(store, arguments.tenant, "tenants purge", arguments.tenant, floorplans=count)
    print(f"deleted {count} floor plans of tenant '{arguments.tenant}', and all else that it stored")
    return 0


def _compact(_arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        store.database.compact()
    return 0


def _limit(arguments: argparse.Namespace) -> int:
    given = {name: value for name, value in vars(arguments).items() if name not in ("run", "tenant")}
    with configured_store() as store:
        limits = store.tenants.change_limits(arguments.tenant, **given)
        audit(store, arguments.tenant, "tenants limit", arguments.tenant, **given)
    for name, value in asdict(limits).items():
        print(f"{name}: {_text(value)}")
    return 0


def _text(value: float | None) -> str:
    return _DEFAULT if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _or_default(kind: Callable[[str], float]) -> Callable[[str], float | None]:
    return lambda given: None if given == _DEFAULT else kind(given)


def _whole(given: str) -> int:
    if not given.isascii() or not given.isdigit() or int(given) >= 2**63:
        raise argparse.ArgumentTypeError(f"a whole number of bytes from 0 to 2^63 - 1, or '{_DEFAULT}'")
    return int(given)


def _weight(given: str) -> float:
    try:
        weight = float(given)
    except ValueError:
        weight = 0.0
    if not 0.01 <= weight <= 100.0:
        raise argparse.ArgumentTypeError(f"a number from 0.01 to 100, or '{_DEFAULT}'")
    return weight


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


def add_backup_commands(commands: Any) -> None:
    """Add `backup` and `restore` to the commands."""
    saving = commands.add_parser("backup", help="copy an SQLite database to a new file, also while the service runs")
    saving.add_argument("file", type=Path, help="the new file")
    saving.set_defaults(run=_back_up)

    restoring = commands.add_parser(
        "restore", help="replace an SQLite database by a backup, also of an earlier version; stop the service first"
    )
    restoring.add_argument("file", type=Path, help="the backup")
    restoring.add_argument("--yes", action="store_true", required=True, help="confirm the replacement")
    restoring.set_defaults(run=_restore)


def _back_up(arguments: argparse.Namespace) -> int:
    database = database_file(Settings.load().database_url)
    size = back_up(database, arguments.file)
    print(f"copied '{database}' to '{arguments.file}' ({size} bytes)")
    return 0


def _restore(arguments: argparse.Namespace) -> int:
    database = database_file(Settings.load().database_url)
    earlier = restore(arguments.file, database)
    print(f"restored '{database}' from '{arguments.file}'")
    if earlier is not None:
        print(f"the database before is '{earlier}'; delete it when nothing is missing")
    return 0
