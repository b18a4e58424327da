"""Migrations of the schema, one module per step in `versions/`, run in order by `service.storage.store`.

Begin with `versions/v0001_revisions_and_leases.py`. `service.storage.tables` describes the current schema.
"""
