"""Steps of the schema; each names its predecessor.

Begin with `v0001_revisions_and_leases.py`.
"""
