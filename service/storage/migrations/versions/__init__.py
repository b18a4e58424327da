"""The steps of the schema, each with the one that it follows.

Begin with `v0001_revisions_and_leases.py`.
"""
