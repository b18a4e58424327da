"""HTTP layer between the socket and the routes: slots, uploads, idempotency, events, errors, headers.

Begin with `admission_control.py`, which limits requests in progress, and `middleware/`, which every request passes.
Routes read bodies with `uploads.py` and `fields.py`, handle headers and cursors with `accept.py`, `conditional.py`,
`cursors.py` and `idempotent_request.py`, and stream with `events.py`; `problems.py` answers errors. `server.py` runs
the app, `api_description.py` describes it.
"""

from service.http.admission_control import Admission, AdmissionLimits
from service.http.events import PlanEvents
from service.http.idempotent_request import IdempotentRequest

__all__ = ["Admission", "AdmissionLimits", "IdempotentRequest", "PlanEvents"]
