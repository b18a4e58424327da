"""`lalaloc-service serve --example`: the example plan in an empty database."""

from __future__ import annotations

import uuid
from pathlib import Path

from lalaloc_core.importers import import_plan
from service.plan_files.convert_worker import report_of
from service.settings import Settings
from service.storage import Store
from service.storage.records import DEFAULT_TENANT, NewPlan, Original

# The page offers it too.
_PLAN = Path(__file__).resolve().parents[1] / "web" / "example-flat.json"


def store_example(store: Store, settings: Settings) -> str | None:
    """Store the example plan for callers without API keys, and return its name; None if any plan is stored.

    The service computes its pose grid after the start.
    """
    if store.plans.any_stored():
        return None
    content = _PLAN.read_bytes()
    imported = import_plan(content)
    plan = imported.plan()
    new = NewPlan(plan, Original(content, report=report_of(imported)))
    store.plans.add(DEFAULT_TENANT, uuid.uuid4().hex, new, limit=settings.plans.max_floorplans)
    return plan.name
