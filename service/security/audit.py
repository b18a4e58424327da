"""Entries of the audit log: who did what to which resource with which result.

Changes that succeed have an entry each, which is stored before the answer is sent. Refusals, failed changes and reads
of administrators are counted per minute, with few entries per actor, so that a flood of requests cannot fill the disk.
Queries and other reads are in the request log only.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections import Counter, deque
from collections.abc import MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

from starlette.requests import Request

from service.errors import StoreUnavailableError
from service.security.access_control import REFUSALS, routed_path
from service.security.permissions import Caller, Permission, permissions_needed, template_of
from service.storage.audit_log import AuditLog
from service.storage.records import ANONYMOUS, DONE, AuditEntry
from service.telemetry import LOGGER_NAME
from service.telemetry.logs import log_fields_of

# Refusals that are audited, besides those of changes.
AUDITED_REFUSALS = tuple(error for error in REFUSALS if error is not StoreUnavailableError)
# Statuses of refusals by routes that are not audited otherwise: photographs where features are required, or too many.
REFUSED = frozenset({403, 429})
# nginx's status for a client that disconnected before the answer; a change may have been made.
CLIENT_CLOSED = 499
READING = frozenset({"GET", "HEAD"})
_METHODS = frozenset({"GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_DETAIL = "lalaloc.audit_detail"
# Interval (s) at which counted entries are stored.
_FLUSH_S = 60.0
# Different entries per actor and minute, and of all actors; further ones are counted without resource and address.
_MAX_PER_ACTOR, _MAX_COUNTED = 20, 1000
VARIOUS = "various"
# Entries that wait for the database.
_MAX_WAITING = 10_000
# Time (s) that an answer waits for its entry.
_WAIT_S = 5.0
_MAX_RESOURCE, _MAX_ADDRESS = 300, 64
_NO_TIME = datetime.min.replace(tzinfo=UTC)


def is_audited(scope: MutableMapping[str, Any]) -> bool:
    """Return True for the routes of administrators, changes of stored plans and venues, and deletions."""
    method = "GET" if scope["method"] == "HEAD" else scope["method"]
    needed = permissions_needed(routed_path(scope)).get(method)
    return needed in (Permission.ADMIN, Permission.WRITE) or (method == "DELETE" and needed is not None)


def add_audit_detail(request: Request, tenant: str, **facts: object) -> None:
    """Note what an administrator did to a tenant, for the entry of the request. Never pass secrets."""
    request.scope[_DETAIL] = (tenant, json.dumps(facts, default=str))


def entry_of(
    scope: MutableMapping[str, Any], status: int, *, caller: Caller | None = None, location: str | None = None
) -> AuditEntry:
    """Return the entry of a request that was answered.

    Requests that were refused have no caller; the location is that of a created resource.
    """
    fields = log_fields_of(scope)
    path = routed_path(scope)
    method = "GET" if scope["method"] == "HEAD" else scope["method"]
    client = scope.get("client")
    tenant, detail = scope.get(_DETAIL, (None, None))
    known_tenant = caller.tenant if caller is not None else fields.tenant if fields is not None else None
    return AuditEntry(
        actor=(fields.key if fields is not None else None) or ANONYMOUS,
        tenant=tenant or known_tenant or "",
        address="".join(filter(str.isprintable, client[0]))[:_MAX_ADDRESS] if client else "",
        action=f"{method if method in _METHODS else 'OTHER'} {template_of(path) or 'unmatched'}",
        resource=(location or quote(path[:_MAX_RESOURCE], safe="/"))[:_MAX_RESOURCE],
        status=status,
        result=_result(status, None if fields is None else fields.rejection),
        request_id=None if fields is None else fields.request_id,
        detail=detail,
    )


def _result(status: int, rejection: str | None) -> str:
    if status < 400:
        return DONE
    return rejection or ("unanswered" if status == CLIENT_CLOSED else "failed")


class AuditTrail:
    """Writer of the entries of one replica."""

    def __init__(self, log: AuditLog) -> None:
        self._log, self._lock = log, threading.Lock()
        self._counted: dict[AuditEntry, AuditEntry] = {}
        self._per_actor = Counter[str]()
        self._waiting: deque[AuditEntry] = deque()
        self._lost, self._stop = 0, threading.Event()
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="lalaloc-audit")
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)

    def start(self) -> None:
        """Start to store counted entries at intervals."""
        self._thread.start()

    def close(self) -> None:
        """Store what is left."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._writer.shutdown(wait=True)
        self.flush()

    async def record(self, entry: AuditEntry) -> None:
        """Store an entry; if the database is away, it is stored later."""
        # The writer goes on after the timeout, and after the end of the request.
        stored = asyncio.get_running_loop().run_in_executor(self._writer, self._store, [entry])
        with suppress(TimeoutError):
            await asyncio.wait_for(asyncio.shield(stored), _WAIT_S)

    def count(self, entry: AuditEntry) -> None:
        """Count an entry, which is stored at the end of the minute."""
        # Counted entries are equal in the rest.
        same = replace(entry, count=1, request_id=None, detail=None, created_at=_NO_TIME)
        with self._lock:
            if same not in self._counted:
                same = self._new(same)
            before = self._counted.get(same)
            self._counted[same] = (
                replace(entry, resource=same.resource, address=same.address, action=same.action, actor=same.actor)
                if before is None
                else replace(before, count=before.count + 1)
            )

    def flush(self) -> None:
        """Store the counted entries now, and those that waited for the database."""
        with self._lock:
            entries = [*self._waiting, *self._counted.values()]
            self._waiting.clear()
            self._counted.clear()
            self._per_actor.clear()
        self._store(entries)

    def _new(self, same: AuditEntry) -> AuditEntry:
        """Return the entry that a new one is counted as: itself, or one without resource and address."""
        self._per_actor[same.actor] += 1
        if len(self._counted) >= _MAX_COUNTED:
            return replace(same, actor=VARIOUS, tenant="", resource="", address="", action=VARIOUS)
        if self._per_actor[same.actor] > _MAX_PER_ACTOR:
            return replace(same, resource="", address="", action=VARIOUS)
        return same

    def _store(self, entries: Sequence[AuditEntry]) -> None:
        with self._lock:
            lost, self._lost = self._lost, 0
        note = AuditEntry(actor="service", tenant="", action="audit", resource="", result="lost", count=lost)
        try:
            self._log.add([*entries, note] if lost else entries)
        except StoreUnavailableError:
            self._keep(entries, lost, _MAX_WAITING)
        except Exception:
            # Entries that the database refuses would be refused again.
            logging.getLogger(LOGGER_NAME).exception("storing audit entries failed")
            self._keep(entries, lost, 0)

    def _keep(self, entries: Sequence[AuditEntry], lost: int, limit: int) -> None:
        """Keep entries for the next attempt, and count those beyond a limit as lost."""
        with self._lock:
            room = max(limit - len(self._waiting), 0)
            self._waiting.extend(entries[:room])
            self._lost += lost + sum(entry.count for entry in entries[room:])
            fields = {"waiting": len(self._waiting), "lost": self._lost}
        logging.getLogger(LOGGER_NAME).error("audit entries are not stored", extra={"fields": fields})

    def _run(self) -> None:
        while not self._stop.wait(_FLUSH_S):
            self.flush()
