"""HTTP layer between the socket and the routes: uploads, idempotency, events, errors, headers.

`http_protocol.py` parses the bytes of a connection; `server.py` runs it.
Begin with `uploads.py`, which reads bodies, and `middleware/`, which every request passes.
Routes check form fields with `fields.py`, choose and send answers with `representations.py`, repeat none with
`idempotent_request.py`, and stream with `events.py`; `problems.py` answers errors, `api_description.py` describes the
app.
"""

from service.http.idempotent_request import IdempotentRequest
