"""HTTP service around the query side of `lalaloc_core`.

Begin with `app.py`, the application, and `runtime.py`, its parts; a query begins in `routes/localise.py`.

http/       layer between socket and routes: uploads, idempotency, errors, middleware
routes/     HTTP routes
schemas/    requests and answers of the API
query/      photographs to answers, in a plan or a venue
decoding/   files to photographs, in worker processes
venues/     the plans of a venue that a photograph is compared with
grids/      pose grids of plans, computed once for all replicas
plan_files/ plan files, read and written in worker processes
storage/    database: plans, pose grids, keys, kept answers
capacity/   who may compute or send bytes, now
pools/      pools of worker processes
workers/    common loop of the worker processes
security/   API keys, scopes, rate limits
telemetry/  metrics, logs and traces
settings/   settings, read from the environment
cli/        command line
on_ray/     the service on several machines
web/        web pages, built from web/ beside this package

Also here: `errors.py` (errors and their HTTP problems), `query_context.py` (client and deadline of a query),
`bounded_cache.py`, `plan_documents.py`, `uploaded_file.py`, `openapi.py`.
"""

import os

# Queries are computed side by side, and the threads of a matrix product spin after it, which took 0.7 of a core from
# other queries. OpenBLAS reads this when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
