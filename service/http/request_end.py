"""Functions that are called at the end of a request."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from starlette.types import Scope

_SCOPE_KEY = "lalaloc.request_end"


@contextmanager
def ending_request(scope: Scope) -> Iterator[None]:
    """Call the functions of `on_request_end` at the end of the block."""
    with ExitStack() as stack:
        scope[_SCOPE_KEY] = stack
        yield


def on_request_end(scope: Scope, call: Callable[[], None]) -> None:
    """Call a function when the answer is sent, or the request has failed."""
    stack: ExitStack | None = scope.get(_SCOPE_KEY)
    if stack is not None:
        stack.callback(call)
