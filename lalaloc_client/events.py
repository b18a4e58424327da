"""Following a plan: what a caller is told of a stream of server-sent events, and of those that come after it."""

from __future__ import annotations

import httpx
from httpx_sse import ServerSentEvent

from lalaloc_client.errors import MalformedAnswerError, NotFoundError
from lalaloc_client.model import PlanEvent
from lalaloc_client.operations import Wait, plan_event

# Until the service has said how long, as it does at the beginning of each stream.
_ASK_AGAIN_S = 3.0


def check_stream(response: httpx.Response) -> None:
    """Raises:
    MalformedAnswerError: an answer that is no stream of events.
    """
    media = response.headers.get("content-type", "").partition(";")[0].strip()
    if media != "text/event-stream":
        raise MalformedAnswerError(f"the answer is of type '{media[:100]}', not a stream of events")


class Followed:
    """What was told of one plan so far, over however many streams.

    Attributes:
        over: whether there is nothing more to come.
    """

    def __init__(self) -> None:
        self.over = False
        self._last: PlanEvent | None = None
        self._ask_again_s = _ASK_AGAIN_S

    def take(self, message: ServerSentEvent) -> PlanEvent | None:
        """What a message says; None when it says nothing new, as the first one of a stream that goes on."""
        if message.retry is not None:
            self._ask_again_s = message.retry / 1000.0
        if not message.data:
            return None
        event = plan_event(message.data)
        self.over = event.final
        if event == self._last:
            return None
        self._last = event
        return event

    def deleted(self, error: NotFoundError) -> PlanEvent:
        """The end of a plan that is no longer there.

        Raises:
            NotFoundError: there never was one.
        """
        if self._last is None:
            raise error
        self.over = True
        return PlanEvent("deleted")

    def pause(self) -> Wait:
        """How long to wait before the next stream is asked for."""
        return Wait(self._ask_again_s)
