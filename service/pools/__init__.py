"""Pools of supervised worker processes, for work that is slow, needs much memory, or can crash.

A worker process runs one job at a time and talks over its own pipe. A supervising thread starts it, feeds it, kills it
when it stalls, and replaces it when it dies. Callers see only the result, the job's own error, or a `JobLostError`.

    spec = WorkerSpec("decode", run_decoder, (decoding, memory_bytes), stall_s=10.0)
    pool = WorkerPool(spec, workers=2, queue_limit=16)
    pool.start()
    result = await pool.run_job(job, timeout_s=5.0)     # cancelling it cancels the job

`run_decoder` of `decoding/decode_worker.py` takes the worker's pipe and these arguments. Begin with `pool.py`, the
interface for callers; `job_queue.py` is the queue, and `supervisor.py` the thread that keeps one worker alive.
"""

from service.pools.job_queue import JobLostError, LostReason
from service.pools.pool import PoolState, WorkerPool
from service.pools.supervisor import WorkerSpec
