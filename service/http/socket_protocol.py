"""WebSocket protocol that bounds frames, the fragments of a message, and answers that are not read."""

from __future__ import annotations

from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from service.http.paced_parsing import PacedParser, ParsingAccount

# Fragments of a message; a photograph is sent in several messages.
_MAX_FRAGMENTS = 1024
# Messages that the application has not received.
_MAX_MESSAGES = 16
# Frames of a piece are parsed at once: at most 170 empty ones.
_PIECE_BYTES = 1024


class BoundedSocket(WebSocketsSansIOProtocol):
    """WebSocket protocol that bounds its work and memory, whatever the client sends or does not read."""

    _parser: PacedParser

    def connection_made(self, transport: Any) -> None:
        """Prepare the connection."""
        super().connection_made(transport)
        account = ParsingAccount(
            self.config.app, lambda: getattr(self, "scope", None), self.client[0] if self.client else ""
        )
        self._parser = PacedParser(transport, self._parse, _PIECE_BYTES, lambda: not self.read_paused, account.add)

    def connection_lost(self, exc: Exception | None) -> None:
        """Drop what waits."""
        self._parser.close()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse frames, now or later."""
        self._parser.feed(data)

    def pause_writing(self) -> None:
        """Read nothing while the client does not read: every ping is answered, and answers would pile up."""
        super().pause_writing()
        self._parser.block("writing")

    def resume_writing(self) -> None:
        """Read again."""
        super().resume_writing()
        self._parser.unblock("writing")

    async def receive(self) -> Any:
        """Return the next message."""
        message = await super().receive()
        self._parser.unblock("messages")
        if self._parser.held:
            # The server resumed reading.
            self.transport.pause_reading()
        return message

    async def send(self, message: Any) -> None:
        """Send a message."""
        await super().send(message)
        if self.initial_response is not None and self.close_sent:
            # A refused handshake is complete, and no error.
            self.handshake_complete = True

    def handle_events(self) -> None:
        """Handle the frames of a piece."""
        before = len(self.conn.events)
        super().handle_events()
        self._parser.events_left -= before

    def handle_cont(self, event: Frame) -> None:
        """Add a fragment; their list would grow even if they are empty."""
        if len(self.frames) < _MAX_FRAGMENTS:
            super().handle_cont(event)
        else:
            self._refuse(CloseCode.MESSAGE_TOO_BIG, f"a message has more than {_MAX_FRAGMENTS} fragments")

    def send_receive_event_to_app(self) -> None:
        """Pass a message on; the server would log a text that is not UTF-8 as its own error."""
        try:
            if self.curr_msg_data_type == "text":
                b"".join(self.frames).decode()
        except UnicodeDecodeError:
            self._refuse(CloseCode.INVALID_DATA, "a text message is not UTF-8")
        else:
            super().send_receive_event_to_app()

    def handle_parser_exception(self) -> None:
        """Close; before the handshake is answered no frame can say why, which the server would log as its own error."""
        if self.conn.close_sent is not None:
            super().handle_parser_exception()
        else:
            self.queue.put_nowait({"type": "websocket.disconnect", "code": CloseCode.PROTOCOL_ERROR})
            self.transport.close()

    def _parse(self, piece: bytes) -> None:
        if piece:
            super().data_received(piece)
        if self.queue.qsize() > _MAX_MESSAGES:
            self._parser.block("messages")

    def _refuse(self, code: CloseCode, reason: str) -> None:
        self.frames = []
        self.conn.fail(code, reason)
        self.handle_parser_exception()
