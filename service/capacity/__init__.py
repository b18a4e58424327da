"""Capacity: who may compute, send bytes, or hold memory, now.

Begin with `fair_share.py`, which orders and limits everything that waits for CPU time by the time that each client has
used (`cpu_accounts.py`). A client is a tenant or, without API keys, a client address. `cores.py` divides the cores and
`threads.py` has a thread pool for each kind of blocking call. `admission_control.py` limits the requests in progress
and `bytes_in_flight.py` the uploads; `bounded_cache.py` and `single_flight.py` bound what is kept and computed at once.
"""
