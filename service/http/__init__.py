"""What stands between the socket and a route: slots for requests, uploads, idempotency, events, errors, headers.

Begin with `admission_control.py`, which says how much may be in work, and `middleware/`, which every request passes.
Routes use `uploads.py` for bodies, `conditional.py`, `cursors.py` and `idempotent_request.py` for what their headers
and parameters ask, `events.py` for streams, `problems.py` and `faults.py` for errors; `parameters.py` refuses what they
do not know. `server.py` runs the app, `api_description.py` describes it.
"""

from service.http.admission_control import Admission, AdmissionLimits
from service.http.events import PlanEvents
from service.http.idempotent_request import IdempotentRequest

__all__ = ["Admission", "AdmissionLimits", "IdempotentRequest", "PlanEvents"]
