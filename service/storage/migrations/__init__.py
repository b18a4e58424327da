"""How the tables came to be: one module per step in `versions`, run in order by `service.storage.migration`."""
