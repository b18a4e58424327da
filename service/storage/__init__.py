"""Persistence behind `Store`: SQLAlchemy on SQLite or PostgreSQL, every call one transaction.

    floorplans       id, tenant, name, current revision, created_at, updated_at
    ├── kept_answers     kept answers to queries; tenant, created_at
    └── revisions        id, number, document, digest of the original, rooms, area, camera height, failure
        ├── original_chunks  the uploaded file, 1 MiB each
        ├── latent_grids     pose grids: model, grid step, camera height, poses
        │   └── grid_chunks      the arrays as one blob, 1 MiB each
        └── grid_leases      owner, end and progress of each grid's computation
    venues           id, tenant, name, revision, anchor, created_at, updated_at
    └── venue_plans      floor plan, level, name
    sessions         plan or venue, state of the tracked camera, photographs, claim, expires_at
    albums           plan or venue, revision, model, expires_at, state and lease of the solution
    └── album_photographs    digest, features, correction, pin
    tenants          limits of each tenant
    api_keys         tenant, name, hash, scopes, rate, created_at, expires_at, revoked_at, last_used_at, key it replaces
    audit_log        actor, tenant, address, action, resource, status, result, count, created_at
    idempotency      (tenant, route, key) -> digest of the body, and the answer once it exists

Begin with `store.py`, then `plans.py`. Indented rows are deleted with the row that they belong to, so deleting a plan
is one statement. `migrations` creates the tables; `tables.py` describes their current state.
"""

from service.storage.store import PlanLookup, Store, open_store
