"""Pools of supervised worker processes, for work that may take long, eat memory, or crash.

A worker process answers one job at a time over a pipe of its own. A supervising thread starts it, feeds it, kills it
when it stalls, and replaces it when it dies. What happens to a worker reaches callers only as a `JobLostError`.

    pool = WorkerPool(WorkerSpec("decode", run_decoder, (limits,), stall_s=10.0), workers=2, queue_limit=16)
    pool.start()
    answer = await pool.answer(job, timeout_s=5.0)      # cancelling it cancels the job

with `run_decoder(connection, limits)` a function of `service.workers`. Begin with `pool.py`, which is what callers see;
`job_queue.py` is the queue, and `supervisor.py` the thread over each worker.
"""

from service.pools.job_queue import JobLostError, LostReason
from service.pools.pool import PoolState, WorkerPool
from service.pools.supervisor import WorkerSpec

__all__ = ["JobLostError", "LostReason", "PoolState", "WorkerPool", "WorkerSpec"]
