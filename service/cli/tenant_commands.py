"""Commands about tenants and their data: `lalaloc-service tenants list|limit|purge` and `compact`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from service.cli.command_parts import audit, configured_store, tenant_name, text_table
from service.storage.records import OperatorLimits

_DEFAULT = "default"


def add_tenant_commands(commands: Any) -> None:
    """Add the group `tenants` to the commands."""
    tenants = commands.add_parser("tenants", help="list, limit and purge tenants").add_subparsers(required=True)

    listing = tenants.add_parser("list", help="list the tenants that stored data or have limits of their own")
    listing.add_argument("--json", action="store_true", help="print JSON instead of a table")
    listing.set_defaults(run=_list)

    limit = tenants.add_parser("limit", help="set limits of a tenant; in effect within LALALOC_SWEEP_S")
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
        store.give_back()
        audit(store, arguments.tenant, "tenants purge", arguments.tenant, floorplans=count)
    print(f"deleted {count} floor plans of tenant '{arguments.tenant}', and all else that it stored")
    return 0


def _compact(_arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        store.compact()
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
