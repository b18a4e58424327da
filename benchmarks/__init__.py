"""What the service stands, measured from outside: each script starts the service, prints what it saw, and fails if it
saw what must not be. Run them on a quiet machine, from the repository's root: `python -m benchmarks.soak`.
"""
