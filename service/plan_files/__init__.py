"""Plan files: imported into stored plans, and made from them, in worker processes.

Begin with `converter.py`, the pool of workers whose program is `convert_worker.py`; `routes/plan_uploads.py` reads
small native plans in the service itself. `renditions.py` makes description, drawing, mesh and exports of a stored plan,
and `rendition_cache.py` keeps them.
"""
