"""Command line of the service: `serve`, `keys`, `tenants`, `audit`, `compact`, `backup` and `restore`.

Keys, tenants and the audit log are in the database of the settings, so these commands also work while the service runs.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import sys
import threading
import uuid
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import ConfigError, LaLaLocError
from service.capacity.cores import limit_arenas, usable_cores
from service.cli.command_parts import audit, configured_store, duration, tenant_name, text_table
from service.cli.data_commands import add_audit_commands, add_backup_commands, add_tenant_commands
from service.schemas.admin import MAX_LIFETIME_S, MAX_OVERLAP_S, MAX_RATE
from service.security import Permission, check_address
from service.security.keys import hash_of, key_text, new_secret
from service.settings import Settings
from service.storage import Store, open_store
from service.storage.records import DEFAULT_TENANT, ApiKey, NewPlan, Original
from service.telemetry.tracing import otlp_exporter

# Connections that the kernel accepts while the service is busy.
_BACKLOG = 1024
_MAX_NAME = 200
# The page offers it too.
_EXAMPLE = Path(__file__).resolve().parents[1] / "web" / "example-flat.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0, or 1 after an error; a usage error exits with 2."""
    parsed = build_parser().parse_args(arguments)
    try:
        return parsed.run(parsed)
    except LaLaLocError as error:
        print(f"lalaloc-service: {error}", file=sys.stderr)
        return 1


def add_serve_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `serve`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on, 0 for a free one (default: 8000)")
    parser.add_argument("--example", action="store_true", help="store the example plan, unless there are plans already")
    parser.add_argument("--lan", action="store_true", help="let phones of this network in, over TLS with an API key")


def serve(arguments: argparse.Namespace) -> int:
    """Bind, print the address, and serve until stopped.

    Raises:
        ConfigError: an invalid setting, or a public address without keys.
    """
    _end_with_terminal()
    settings = Settings.load()
    if arguments.lan:
        settings = settings.with_values(api_keys=True)
    limit_arenas(usable_cores())
    with ExitStack() as cleanup:
        listener = cleanup.enter_context(_listener("0.0.0.0" if arguments.lan else arguments.host, arguments.port))
        host, port = listener.getsockname()[:2]
        check_address(host, settings)
        _check_parts(settings, example=arguments.example)
        certificate, text = None, f"http://{f'[{host}]' if ':' in host else host}:{port}"
        if arguments.lan:
            # Imported late, because only this needs cryptography.
            from service.cli.lan_access import NOTICE, lan_access

            link, certificate = cleanup.enter_context(lan_access(settings.data_dir, port))
            text = f"{link}\n{NOTICE}"
        # The socket is bound, so clients can connect now; they are answered after the start.
        print(text, flush=True)
        # Imported late, because it takes a second that help and keys do not need.
        from service.app import create_app
        from service.http.server import Server, server_config

        app = create_app(settings)
        Server(server_config(app, settings, certificate), app, settings).run(sockets=[listener])
    return 0


def _end_with_terminal() -> None:
    """Stop in order when the terminal closes, so that links for phones end too; not if that is ignored, as by nohup."""

    def watch() -> None:
        closed = select.poll()
        closed.register(0, 0)
        closed.poll()
        os.kill(os.getpid(), signal.SIGTERM)

    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL and os.isatty(0):
        # Its signal does not reach all processes: with `ssh -t` only make, which waits for this one.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        threading.Thread(target=watch, daemon=True).start()


def _check_parts(settings: Settings, *, example: bool) -> None:
    """Check model, database and exporter before the start, so that errors are one line and not a log.

    With `example`, store the example plan in an empty database.
    """
    if settings.otlp_endpoint is not None:
        otlp_exporter(settings.otlp_endpoint).shutdown()
    Bundle.open(settings.bundle).check()
    with closing(open_store(settings)) as store:
        if example:
            store_example(store, settings)


def store_example(store: Store, settings: Settings) -> str | None:
    """Store the example plan for callers without API keys, and return its name; None if any plan is stored.

    The service computes its pose grid after the start.
    """
    # Imported late, as importers are.
    from lalaloc_core.importers import import_plan
    from service.plan_files.convert_worker import report_of

    if store.plans.any_stored():
        return None
    content = _EXAMPLE.read_bytes()
    imported = import_plan(content)
    plan = imported.plan()
    new = NewPlan(plan, Original(content, report=report_of(imported)))
    store.plans.add(DEFAULT_TENANT, uuid.uuid4().hex, new, limit=settings.plans.max_floorplans)
    return plan.name


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"cannot listen on {host} port {port}: {error}") from error


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="lalaloc-service", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    serving = commands.add_parser("serve", help="run the service")
    add_serve_arguments(serving)
    serving.set_defaults(run=serve)
    _add_key_commands(commands)
    add_tenant_commands(commands)
    add_audit_commands(commands)
    add_backup_commands(commands)
    return parser


def _add_key_commands(commands: Any) -> None:
    keys = commands.add_parser("keys", help="create, list, rotate and revoke API keys").add_subparsers(required=True)

    create = keys.add_parser("create", help="create a key and print it; it cannot be shown again")
    create.add_argument(
        "--tenant", required=True, type=tenant_name, help="tenant whose floor plans the key gives access to"
    )
    create.add_argument("--name", required=True, type=_name, help="name of the key, for your own records")
    create.add_argument(
        "--scope",
        dest="scopes",
        action="append",
        required=True,
        choices=[str(permission) for permission in Permission],
        help="scope of the key; repeat the option for several",
    )
    create.add_argument(
        "--rate-per-minute",
        type=_rate,
        help="rate limit in requests per minute; 0: no limit (default: LALALOC_RATE_PER_MINUTE)",
    )
    create.add_argument(
        "--expires-in", type=_lifetime, metavar="DURATION", help="lifetime of the key, such as 90d (default: no end)"
    )
    create.set_defaults(run=_create)

    rotate = keys.add_parser("rotate", help="replace a key and print its successor; it cannot be shown again")
    rotate.add_argument("id", help="id of the key: the part between the underscores")
    rotate.add_argument(
        "--overlap",
        type=_overlap,
        default="7d",
        metavar="DURATION",
        help="time for which the old key stays valid beside the new one (default: %(default)s)",
    )
    rotate.set_defaults(run=_rotate)

    listing = keys.add_parser("list", help="list all keys, including revoked and expired ones, without secrets")
    listing.add_argument("--tenant", type=tenant_name, help="list only the keys of this tenant")
    listing.add_argument("--json", action="store_true", help="print JSON instead of a table")
    listing.set_defaults(run=_list)

    revoke = keys.add_parser("revoke", help="revoke a key; it is rejected within 5 s")
    revoke.add_argument("id", help="id of the key: the part between the underscores")
    revoke.set_defaults(run=_revoke)


def _create(arguments: argparse.Namespace) -> int:
    secret = new_secret()
    with configured_store() as store:
        key = store.keys.create(
            arguments.tenant,
            arguments.name,
            hash_of(secret),
            arguments.scopes,
            rate_per_minute=arguments.rate_per_minute,
            lifetime=arguments.expires_in,
        )
        audit(store, key.tenant, "keys create", key.id, name=key.name, scopes=sorted(key.scopes), end=key.expires_at)
    _print_new(key, secret)
    return 0


def _rotate(arguments: argparse.Namespace) -> int:
    secret = new_secret()
    with configured_store() as store:
        key = store.keys.rotate(arguments.id, hash_of(secret), overlap=arguments.overlap)
        if key is None:
            print(f"lalaloc-service: no valid key '{arguments.id[:64]}'; see `keys list`", file=sys.stderr)
            return 1
        audit(store, key.tenant, "keys rotate", arguments.id, successor=key.id, end=key.expires_at)
        replaced = store.keys.get(arguments.id)
    if replaced is not None:
        print(f"key {replaced.id} expires at {_moment(replaced.expires_at)}", file=sys.stderr)
    _print_new(key, secret)
    return 0


def _print_new(key: ApiKey, secret: str) -> None:
    # Only the key goes to standard output, so that it can be piped.
    print(f"key {key.id} of tenant '{key.tenant}'; it is shown only once:", file=sys.stderr)
    print(key_text(key.id, secret))


def _list(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        keys = store.keys.list_keys(arguments.tenant)
    if arguments.json:
        print(json.dumps([asdict(key) | {"scopes": sorted(key.scopes)} for key in keys], default=str, indent=2))
    else:
        print(_table(keys))
    return 0


def _revoke(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        key = store.keys.revoke(arguments.id)
        if key is None:
            print(f"lalaloc-service: no active key '{arguments.id[:64]}'", file=sys.stderr)
            return 1
        audit(store, key.tenant, "keys revoke", key.id, name=key.name)
    print(f"revoked {arguments.id}")
    return 0


def _table(keys: Sequence[ApiKey]) -> str:
    head = ("ID", "TENANT", "NAME", "SCOPES", "RATE", "CREATED", "LAST USED", "EXPIRES", "REVOKED")
    rows = [
        (
            key.id,
            key.tenant,
            key.name,
            ",".join(sorted(key.scopes)),
            "-" if key.rate_per_minute is None else str(key.rate_per_minute),
            _moment(key.created_at),
            _moment(key.last_used_at),
            _moment(key.expires_at),
            _moment(key.revoked_at),
        )
        for key in keys
    ]
    return text_table(head, rows)


def _moment(moment: datetime | None) -> str:
    return "-" if moment is None else moment.isoformat(timespec="seconds")


def _name(given: str) -> str:
    if not 0 < len(given) <= _MAX_NAME or not given.isprintable():
        raise argparse.ArgumentTypeError(f"1 to {_MAX_NAME} printable characters")
    return given


def _rate(given: str) -> int:
    if not given.isascii() or not given.isdigit() or int(given) > MAX_RATE:
        raise argparse.ArgumentTypeError(f"a whole number from 0 to {MAX_RATE}")
    return int(given)


def _lifetime(given: str) -> timedelta:
    if not 1 <= (lifetime := duration(given)).total_seconds() <= MAX_LIFETIME_S:
        raise argparse.ArgumentTypeError(f"1s to {MAX_LIFETIME_S // 86400}d")
    return lifetime


def _overlap(given: str) -> timedelta:
    if (overlap := duration(given)).total_seconds() > MAX_OVERLAP_S:
        raise argparse.ArgumentTypeError(f"0s to {MAX_OVERLAP_S // 86400}d")
    return overlap
