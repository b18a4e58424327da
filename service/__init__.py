"""The HTTP service.

Begin with `app.py`, the application, and `runtime.py`, its parts; a query begins in `routes/localise.py`.

http/       what stands between the socket and a route: slots, uploads, idempotency, errors; middleware/ is part of it
security/   API keys, scopes, rates, and what holds while there are no keys
routes/     the HTTP routes
schemas/    what the API takes and answers
query/      what answers a panorama
grids/      latent grids of plans, computed once for all replicas
storage/    what persists: plans, grids, keys, kept answers
pools/      worker processes, kept alive and fed
workers/    the programs that run in them
telemetry/  metrics, logs and traces
preview/    drawings and meshes of plans
conversion/ files of plans, read and written in worker processes
on_ray/     the service on several machines
web/        the web pages, built from web/ beside this package

Beside them: `settings.py`, `setting_types.py`, `errors.py` (what errors mean over HTTP), `cores.py` (which part gets
how many), `fair_share.py` (that no tenant takes everything), `threads.py`, `bounded_cache.py`, and the command lines
`cli.py`, `openapi.py`, `__main__.py`.
"""
