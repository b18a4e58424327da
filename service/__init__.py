"""HTTP service around the query side of `lalaloc_core`.

Begin with `app.py`, the application, and `runtime.py`, its parts; a query begins in `routes/localise.py`.

http/       layer between socket and routes: slots, uploads, idempotency, errors, middleware
security/   API keys, scopes, rate limits
routes/     HTTP routes
schemas/    requests and answers of the API
query/      computation of answers
grids/      pose grids of plans, computed once for all replicas
storage/    database: plans, pose grids, keys, kept answers
pools/      pools of worker processes
workers/    programs of the worker processes
tenancy/    sharing of CPU time and uploads between tenants
telemetry/  metrics, logs and traces
renditions/ files made from plans
conversion/ plan files, read and written in worker processes
on_ray/     the service on several machines
web/        web pages, built from web/ beside this package

Also here: `settings.py`, `setting_groups.py`, `setting_types.py`, `errors.py`, `problem_kinds.py` (errors over HTTP),
`cores.py` (division of the cores), `threads.py`, `bounded_cache.py`, `stored_plan.py`, `uploaded_file.py`, and the
command lines `cli.py`, `openapi.py`, `__main__.py`.
"""

import os

# Queries are computed side by side, and the threads of a matrix product spin after it, which took 0.7 of a core from
# other queries. OpenBLAS reads this when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
