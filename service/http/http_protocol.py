"""HTTP/1.1 protocol that bounds connections, heads of requests, events, and bodies of refused requests.

Events cost more than bytes: one read of 256 KiB can hold 40,000 chunks of a body, and parsing them at once would keep
the event loop from all other connections. So a connection parses a bounded number of events at a time.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from time import monotonic, thread_time
from typing import Any

import h11
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.h11_impl import STATUS_PHRASES, H11Protocol

from service.capacity.cpu_accounts import CpuAccounts
from service.security.permissions import client_of

# Events of one connection in a turn of the event loop.
EVENTS_PER_TURN = 64
# Time (s) per event of connections that have more than that, of all of them together: a few percent of the loop.
_EVENT_S = 2e-4
# CPU time (s) of parsing that is charged at once; a client is active when it is charged, which one request is not for.
_CHARGED_S = 1e-3
# Bytes parsed at a time: an upload of megabytes in pieces of 16 KiB would take 5 ms of the event loop.
_PIECE_BYTES = 256 * 1024
# Unparsed bytes of a connection: that of a few reads, which can arrive although reading is paused.
_MAX_WAITING_BYTES = 2**20


# Heads of requests, and their lines; larger ones get a 431.
MAX_HEAD_BYTES, _MAX_HEADERS = 16 * 1024, 100
_TOO_LARGE = 431
# Bodies in more chunks than this must have this many bytes per chunk on average.
_MANY_CHUNKS, _MIN_CHUNK_BYTES = 1024, 64
# A chunk smaller than that counts as this many events, and the rest of a body of more of them is not read after the
# answer: a client that opens connections for a few chunks each would keep the event loop busy, too.
_SMALL_CHUNK_EVENTS, _FEW_CHUNKS = 8, 4
# Time (s) for which the next connections of a client's address are not read after such a body, and the longest.
_PENALTY_S, _MAX_PENALTY_S = 0.01, 0.5
# Time (s) per byte at which bodies of refused requests arrive, of all connections together. They are dropped, so that
# clients read the refusal; at the speed of a local network they would occupy the event loop.
_DROPPING_S = 5e-9


class Pace:
    """Pace of bytes or events that arrive on several connections."""

    def __init__(self, each_s: float) -> None:
        self._each_s, self._free_at = each_s, 0.0

    def wait_s(self, count: int) -> float:
        """Return the time (s) until more may arrive on a connection, after the next `count`."""
        now = monotonic()
        self._free_at = max(self._free_at, now) + count * self._each_s
        return self._free_at - now


EVENTS = Pace(_EVENT_S)


class PacedParser:
    """Feeder of a protocol's parser.

    Attributes:
        events_left: events that may be handled in this turn of the event loop.

    Args:
        transport: of the connection; it is not read while bytes wait.
        parse: handles a piece; an empty one handles what the parser holds already.
        piece_bytes: maximum size of a piece. A piece is parsed as a whole if the parser does not count its events.
        may_read: tells whether the protocol itself wants more bytes.
        spent: receives the CPU time (s) of each turn.
    """

    def __init__(
        self,
        transport: asyncio.Transport,
        parse: Callable[[bytes], None],
        piece_bytes: int,
        may_read: Callable[[], bool],
        spent: Callable[[float], None],
    ) -> None:
        self.events_left, self._transport, self._parse = EVENTS_PER_TURN, transport, parse
        self._piece_bytes, self._may_read, self._spent = piece_bytes, may_read, spent
        self._waiting = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self._is_blocked = False

    @property
    def held(self) -> bool:
        """True while bytes wait, so that nothing may be read."""
        return self._timer is not None or self._is_blocked

    def feed(self, data: bytes) -> None:
        """Parse bytes, now or later."""
        self._waiting += data
        if not self.held:
            self._run()
        elif len(self._waiting) > _MAX_WAITING_BYTES:
            self._transport.abort()
        else:
            self._transport.pause_reading()

    def block(self) -> None:
        """Parse nothing until `unblock`."""
        self._is_blocked = True
        self._transport.pause_reading()

    def unblock(self) -> None:
        """Go on."""
        self._is_blocked = False
        if self._timer is None:
            self._go_on()

    def settle(self) -> None:
        """Go on in a later turn if the events of this one are used up."""
        if self._transport.is_closing():
            self.close()
        elif self.events_left <= 0 and self._timer is None:
            self._transport.pause_reading()
            self._timer = asyncio.get_running_loop().call_later(EVENTS.wait_s(EVENTS_PER_TURN), self._go_on)

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
        while self._waiting and self.events_left > 0 and not self._is_blocked and not self._transport.is_closing():
            self._parse(self._take())
        self._spent(thread_time() - begin_s)
        self.settle()

    def _go_on(self) -> None:
        self._timer = None
        if not self._is_blocked:
            self._run()
            self.resume()

    def _take(self) -> bytes:
        piece = bytes(self._waiting[: self._piece_bytes])
        del self._waiting[: self._piece_bytes]
        return piece


class _RefusedError(h11.RemoteProtocolError):
    """Request that this service refuses, although it is valid HTTP."""


class _CountedConnection(h11.Connection):
    """Parser that handles a bounded number of events in a turn, and checks each of them."""

    def __init__(self, parser: Callable[[], PacedParser]) -> None:
        super().__init__(h11.SERVER, MAX_HEAD_BYTES)
        self._parser = parser
        self._chunks = self._body_bytes = 0
        # Status and text of the answer to what was refused.
        self.refusal: tuple[int, str] | None = None

    def next_event(self) -> Any:
        """Return the next event; none if those of this turn are used up."""
        parser = self._parser()
        if parser.events_left <= 0:
            return h11.NEED_DATA
        try:
            event = super().next_event()
            if event is not h11.NEED_DATA and event is not h11.PAUSED:
                parser.events_left -= 1
            if isinstance(event, h11.Request):
                self._check_head(event)
            elif isinstance(event, h11.Data):
                self._check_chunks(event)
        except _RefusedError as error:
            self.refusal = (error.error_status_hint, str(error))
            raise
        except h11.RemoteProtocolError as error:
            if error.error_status_hint == _TOO_LARGE:
                self.refusal = (_TOO_LARGE, f"the limit of a request's head is {MAX_HEAD_BYTES} bytes")
            raise
        return event

    def _check_head(self, request: h11.Request) -> None:
        size = (
            len(request.method)
            + len(request.target)
            + sum(len(name) + len(value) + 4 for name, value in request.headers)
        )
        if size > MAX_HEAD_BYTES:
            raise _RefusedError(f"the head has {size} bytes; the limit is {MAX_HEAD_BYTES}", _TOO_LARGE)
        if len(request.headers) > _MAX_HEADERS:
            raise _RefusedError(f"the head has {len(request.headers)} lines; the limit is {_MAX_HEADERS}", _TOO_LARGE)
        if request.http_version not in (b"1.0", b"1.1"):
            raise _RefusedError("send HTTP/1.1 or HTTP/1.0", 505)
        self._chunks = self._body_bytes = 0

    def _check_chunks(self, data: h11.Data) -> None:
        self._chunks += data.chunk_start
        self._body_bytes += len(data.data)
        if data.chunk_start and data.chunk_end and len(data.data) < _MIN_CHUNK_BYTES:
            self._parser().events_left -= _SMALL_CHUNK_EVENTS - 1
        if self._has_small_chunks(_MANY_CHUNKS):
            raise _RefusedError(
                f"the body has {self._chunks} chunks of {self._body_bytes / self._chunks:.0f} bytes on average; "
                f"the minimum is {_MIN_CHUNK_BYTES}"
            )

    @property
    def is_answered_in_small_chunks(self) -> bool:
        """True while a body in small chunks arrives whose request is answered."""
        return self.our_state is h11.DONE and self.their_state is h11.SEND_BODY and self._has_small_chunks(_FEW_CHUNKS)

    def _has_small_chunks(self, many: int) -> bool:
        return self._chunks > many and self._body_bytes < _MIN_CHUNK_BYTES * self._chunks


class _Flow(FlowControl):
    """Flow control that reads nothing while bytes wait to be parsed."""

    def __init__(self, transport: asyncio.Transport, parser: PacedParser) -> None:
        super().__init__(transport)
        self._parser = parser

    def resume_reading(self) -> None:
        """Read again, now or when the waiting bytes are parsed."""
        if self._parser.held:
            self.read_paused = False
        else:
            super().resume_reading()


class _Bounds:
    """Limits and pace that the connections of a server share.

    Attributes:
        head_deadline_s: timeout for the head of a request, and for the rest of a refused body.
        max_connections: maximum number of open connections.
        dropping: pace of bodies of refused requests.
    """

    def __init__(self, head_deadline_s: float, max_connections: int) -> None:
        self.head_deadline_s, self.max_connections = head_deadline_s, max_connections
        self.dropping = Pace(_DROPPING_S)
        self._penalties: dict[str, Pace] = {}

    def penalise(self, address: str) -> None:
        """Let the next connections of an address wait."""
        if len(self._penalties) >= self.max_connections:
            self._penalties.clear()
        self._penalties.setdefault(address, Pace(_PENALTY_S)).wait_s(1)

    def penalty_s(self, address: str) -> float:
        """Return the time (s) for which a new connection of an address is not read."""
        penalty = self._penalties.get(address)
        return 0.0 if penalty is None else min(penalty.wait_s(0), _MAX_PENALTY_S)


def bounded_protocol(head_deadline_s: float, max_connections: int) -> type[asyncio.Protocol]:
    """Return an HTTP/1.1 protocol that bounds connections, heads, events and bodies of refused requests."""

    class BoundedProtocol(_BoundedProtocol):
        _bounds = _Bounds(head_deadline_s, max_connections)

    return BoundedProtocol


class _BoundedProtocol(H11Protocol):
    """Protocol that ends connections without a request in progress after a while, and reads refused bodies slowly.

    The server's own keep-alive timer stops at the first byte of a head; this one does not.
    """

    _bounds: _Bounds
    _limit: asyncio.TimerHandle | None = None
    _pause: asyncio.TimerHandle | None = None
    _idle_since = _owed_s = 0.0
    _parser: PacedParser
    conn: _CountedConnection

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        self.conn = _CountedConnection(lambda: self._parser)
        self._parser = PacedParser(
            transport, self._parse, _PIECE_BYTES, lambda: not self.flow.read_paused, self._charge
        )
        self.flow = _Flow(transport, self._parser)
        _send_at_once(transport)
        self._idle_since = monotonic()
        self._make_room()
        self._watch()
        if (penalty_s := self._bounds.penalty_s(self._address)) > 0.0:
            self._parser.block()
            self.loop.call_later(penalty_s, self._end_penalty)

    def data_received(self, data: bytes) -> None:
        self._unset_keepalive_if_required()
        self._parser.feed(data)
        if self.conn.our_state is h11.DONE and self.conn.their_state is h11.SEND_BODY:
            self.transport.pause_reading()
            self._pause = self.loop.call_later(self._bounds.dropping.wait_s(len(data)), self._parser.resume)
        self._watch()

    def _should_upgrade(self) -> bool:
        # There is no other protocol; the server would log each request for one.
        return False

    def send_400_response(self, msg: str) -> None:
        """Refuse what the client sent, and close the connection."""
        if self.cycle is not None and not self.cycle.response_complete:
            # The application reads the body, and its answer would follow this one.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            status, text = self.conn.refusal or (400, msg)
            headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
            for event in (
                h11.Response(status_code=status, headers=headers, reason=STATUS_PHRASES[status]),
                h11.Data(data=text.encode()),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._idle_since = monotonic()
        if self.conn.is_answered_in_small_chunks:
            self._bounds.penalise(self._address)
            self.transport.close()
        # Requests that were sent with the last one are handled outside the feeder.
        self._parser.settle()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._unwatch()
        self._parser.close()
        if self._pause is not None:
            self._pause.cancel()

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

    def _end_penalty(self) -> None:
        if not self.transport.is_closing():
            self._parser.unblock()

    def _charge(self, cpu_s: float) -> None:
        """Charge CPU time (s) of parsing to the client of the last request, or the address if it was not accepted."""
        self._owed_s += cpu_s
        # An app without its lifespan has no accounts.
        admission = getattr(getattr(self.config.app, "state", None), "admission", None)
        if self._owed_s >= _CHARGED_S and admission is not None:
            accounts: CpuAccounts = admission.cpu_accounts
            accounts.charge(client_of(self.scope or {}, self._address), self._owed_s, rests=True)
            self._owed_s = 0.0

    def _parse(self, piece: bytes) -> None:
        if piece:
            self.conn.receive_data(piece)
        self.handle_events()

    def _make_room(self) -> None:
        """Close the connection that is idle the longest if there are too many."""
        if len(self.connections) <= self._bounds.max_connections:
            return
        idle = [peer for peer in self.connections if isinstance(peer, _BoundedProtocol) and not peer._in_work]
        oldest = min(idle, key=lambda peer: peer._idle_since, default=self)
        if oldest is not self:
            # Removed now, because its end is only noted in the loop's next round.
            self.connections.discard(oldest)
            oldest.transport.abort()

    @property
    def _in_work(self) -> bool:
        cycle: Any = self.cycle
        return cycle is not None and not cycle.response_complete

    def _watch(self) -> None:
        if self._in_work:
            self._unwatch()
        elif self._limit is None:
            delay_s = self.timeout_keep_alive + self._bounds.head_deadline_s
            self._limit = self.loop.call_later(delay_s, self.transport.abort)

    def _unwatch(self) -> None:
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None


def _send_at_once(transport: asyncio.Transport) -> None:
    """Disable Nagle's algorithm, which delays bodies by up to 40 ms.

    asyncio disables it only for listening sockets that it created itself.
    """
    connection = transport.get_extra_info("socket")
    if connection is not None and connection.family in (socket.AF_INET, socket.AF_INET6):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
