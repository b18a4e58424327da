"""Capacity: who may compute or send bytes, now.

A slot is of a request, a core is of a computation. Begin with `admission_control.py`, which gives slots to requests and
bounds their bytes. `fair_share.py` orders and limits everything that waits for CPU time by the time that each client
has used (`cpu_accounts.py`). A client is a tenant or, without API keys, a client address. `cores.py` divides the cores,
and `threads.py` has a thread pool for each kind of blocking call.
"""
