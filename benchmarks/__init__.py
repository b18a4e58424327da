"""How much load, abuse and failure the service withstands, measured from outside.

Each script starts the service, prints what it saw, and fails if it saw what must not be. Run them on a quiet machine,
from the repository's root: `python -m benchmarks.soak`. Begin with `soak.py`; `load.py` has the clients that all use.
"""
