"""HTTP layer between the socket and the routes: uploads, idempotency, events, errors, headers.

Begin with `uploads.py`, and `middleware/`, which every request passes.
Routes read bodies with `fields.py`, handle headers and cursors with `accept.py`, `conditional.py`,
`cursors.py` and `idempotent_request.py`, and stream with `events.py`; `problems.py` answers errors. `server.py` runs
the app, `api_description.py` describes it.
"""

from service.http.events import PlanEvents
from service.http.idempotent_request import IdempotentRequest
