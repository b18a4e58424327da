"""Load tests of a running service, large plans and venues, durable commits, and plan files and drawings to import.

Each script prints its figures and exits with 1 when a limit is exceeded: `python -m benchmarks.neighbours`. Run them on
a quiet machine, from the repository's root. Begin with `harness.py`, which starts the service and its clients.
"""
