"""Load, fault and abuse tests of a running service, and measurements of single parts of the search.

Each script prints its figures and exits with 1 when a limit is exceeded: `python -m benchmarks.hostile`. Run them on a
quiet machine, from the repository's root. Begin with `harness.py`, which starts the service and the clients of
`locustfile.py`.
"""
