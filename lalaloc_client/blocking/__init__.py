"""`Client`; `make client` generates all but `backend.py` from `asynchronous/`.

Begin with `client.py`.
"""
