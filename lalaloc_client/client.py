"""The client that blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lalaloc_client import operations
from lalaloc_client.answers import Readiness
from lalaloc_client.plan_methods import PlanMethods
from lalaloc_client.query_methods import QueryMethods
from lalaloc_client.venue_methods import VenueMethods


class Client(PlanMethods, QueryMethods, VenueMethods):
    """Asks a LaLaLoc service; close it, or use it in a `with` block. May be shared between threads.

    Every method raises ProblemError when the service answers with a problem, ConnectionFailedError when it does not
    answer, and MalformedAnswerError when it answers something else; see `lalaloc_client.errors`.
    """

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def limits(self) -> Mapping[str, Any]:
        """What the service allows, by name."""
        return self._run(operations.limits(self._patience))

    def ready(self) -> Readiness:
        """Whether the service can answer at full quality."""
        return self._run(operations.readiness(self._patience))
