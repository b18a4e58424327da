"""What persists, behind `Store`: SQLAlchemy on SQLite or PostgreSQL, every call one transaction.

    floorplans       id, tenant, name, current revision, created_at, updated_at
    ├── kept_answers     answers to pictures, where queries ask to keep them; tenant, created_at
    └── revisions        id, number, document, digest of the original, rooms, area, camera height, failure
        ├── original_chunks  the uploaded bytes, 1 MiB each
        ├── latent_grids     model, grid step, camera height, poses
        │   └── grid_chunks      the arrays as one blob, 1 MiB each
        └── grid_leases      who computes which grid, until when, how far
    venues           id, tenant, name, revision, anchor, created_at, updated_at
    └── venue_plans      floor plan, level, name
    api_keys         tenant, name, hash, scopes, rate, created_at, revoked_at, last_used_at
    idempotency      (tenant, route, key) -> digest of the body, and the answer once there is one

Begin with `store.py`, then `plans.py`. What is indented goes with what it hangs on, so that deleting a plan is one
statement and final. `migrations` makes the tables; `tables` says what they look like now.
"""

from service.storage.plan_lookup import PlanLookup
from service.storage.store import Store, open_store

__all__ = ["PlanLookup", "Store", "open_store"]
