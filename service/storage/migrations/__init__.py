"""How the tables came to be: one module per step in `versions/`, run in order by `service.storage.migration`.

Begin with `versions/v0001_revisions_and_leases.py`; what the tables look like now says `service.storage.tables`.
"""
