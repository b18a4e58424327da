"""Sharing of the service between its clients: CPU time and the bytes of uploads.

A client is a tenant or, without API keys, a client address. Begin with `cpu_accounts.py`, which measures the CPU time
of each client. `fair_share.py` orders and limits everything that waits for CPU time by it; `http/bytes_in_flight.py`
limits the uploads in progress.
"""
