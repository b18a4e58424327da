"""What stands between the socket and a route: slots for requests, uploads, idempotency, events, errors, headers.

Begin with `admission.py`.
"""
