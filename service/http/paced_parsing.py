"""Bytes of a connection that are parsed a bounded number of events at a time.

Events cost more than bytes: one read of 256 KiB can hold 40,000 chunks of a body, and parsing them at once would
keep the event loop from all other connections.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from time import monotonic, thread_time
from typing import Any

from service.capacity.cpu_accounts import CpuAccounts
from service.security.permissions import client_of

# Events of one connection in a turn of the event loop.
EVENTS_PER_TURN = 64
# Time (s) per event of connections that have more than that, of all of them together: a few percent of the loop.
_EVENT_S = 2e-4
# CPU time (s) of parsing that is charged at once; a client is active when it is charged, which one request is not for.
_CHARGED_S = 1e-3
# Unparsed bytes of a connection: that of a few reads, which can arrive although reading is paused.
_MAX_WAITING_BYTES = 2**20


class Pace:
    """Pace of bytes or events that arrive on several connections."""

    def __init__(self, each_s: float) -> None:
        self._each_s = each_s
        self._free_at = 0.0

    def wait_s(self, count: int) -> float:
        """Return the time (s) until more may arrive on a connection, after the next `count`."""
        now = monotonic()
        self._free_at = max(self._free_at, now) + count * self._each_s
        return self._free_at - now


EVENTS = Pace(_EVENT_S)


class ParsingAccount:
    """CPU time of parsing on one connection, charged to the client of its last request.

    Requests that were not accepted have none: their parsing is charged to the client address.
    """

    def __init__(self, app: Any, scope: Callable[[], Mapping[str, Any] | None], address: str) -> None:
        """Create an account for a connection from an address; `app` has `Admission` while it runs."""
        self._app = app
        self._scope = scope
        self._address = address
        self._owed_s = 0.0

    def add(self, cpu_s: float) -> None:
        """Add CPU time (s)."""
        self._owed_s += cpu_s
        # An app without its lifespan has no accounts.
        admission = getattr(getattr(self._app, "state", None), "admission", None)
        if self._owed_s >= _CHARGED_S and admission is not None:
            accounts: CpuAccounts = admission.cpu_accounts
            accounts.charge(client_of(self._scope() or {}, self._address), self._owed_s, rests=True)
            self._owed_s = 0.0


class PacedParser:
    """Feeder of a protocol's parser.

    Attributes:
        events_left: events that may be handled in this turn of the event loop.
    """

    def __init__(
        self,
        transport: asyncio.Transport,
        parse: Callable[[bytes], None],
        piece_bytes: int,
        may_read: Callable[[], bool],
        spent: Callable[[float], None],
    ) -> None:
        """Create a feeder.

        Args:
            transport: of the connection; it is not read while bytes wait.
            parse: handles a piece; an empty one handles what the parser holds already.
            piece_bytes: maximum size of a piece. A piece is parsed as a whole if the parser does not count its events.
            may_read: tells whether the protocol itself wants more bytes.
            spent: receives the CPU time (s) of each turn.
        """
        self.events_left = EVENTS_PER_TURN
        self._transport = transport
        self._parse = parse
        self._piece_bytes = piece_bytes
        self._may_read = may_read
        self._spent = spent
        self._waiting = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self._blocked = set[str]()

    @property
    def held(self) -> bool:
        """True while bytes wait, so that nothing may be read."""
        return self._timer is not None or bool(self._blocked)

    def feed(self, data: bytes) -> None:
        """Parse bytes, now or later."""
        self._waiting += data
        if not self.held:
            self._run()
        elif len(self._waiting) > _MAX_WAITING_BYTES:
            self._transport.abort()
        else:
            self._transport.pause_reading()

    def block(self, reason: str) -> None:
        """Parse nothing until `unblock` with the same reason."""
        self._blocked.add(reason)
        self._transport.pause_reading()

    def unblock(self, reason: str) -> None:
        """Go on, unless there is another reason not to."""
        if reason in self._blocked:
            self._blocked.remove(reason)
            if self._timer is None:
                self._go_on()

    def settle(self) -> None:
        """Go on in a later turn if the events of this one are used up."""
        if self._transport.is_closing():
            self.close()
        elif self.events_left <= 0 and self._timer is None:
            self._transport.pause_reading()
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(EVENTS.wait_s(EVENTS_PER_TURN), self._go_on)

    def close(self) -> None:
        """Drop what waits."""
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def resume(self) -> None:
        """Read from the connection again if it is time."""
        if not self.held and self._may_read() and not self._transport.is_closing():
            self._transport.resume_reading()

    def _run(self) -> None:
        self.events_left = EVENTS_PER_TURN
        begin_s = thread_time()
        self._parse(self._take())
        while self._waiting and self.events_left > 0 and not self._blocked and not self._transport.is_closing():
            self._parse(self._take())
        self._spent(thread_time() - begin_s)
        self.settle()

    def _go_on(self) -> None:
        self._timer = None
        if not self._blocked:
            self._run()
            self.resume()

    def _take(self) -> bytes:
        piece = bytes(self._waiting[: self._piece_bytes])
        del self._waiting[: self._piece_bytes]
        return piece
