"""Venue of the levels of a plan file."""

from __future__ import annotations

from collections.abc import Sequence

from lalaloc_core.importers import building_name
from service.conversion import PlanFile, convert_levels
from service.errors import InvalidRequestError
from service.routes.plan_uploads import PlanUpload
from service.runtime import Runtime
from service.storage.records import JSON, ComputedGrid, Original, VenueRecord
from service.storage.venue_imports import NewPlan
from service.stored_plan import PlanDocument

_DEFAULT_NAME = "venue"
# Levels of a venue, as in requests.
_MAX_LEVEL = 1000.0


def store_venue_of_levels(
    uploaded: PlanUpload, runtime: Runtime, tenant: str, client: str, venue_id: str
) -> VenueRecord:
    """Store a plan of every level of a file with rooms, and the venue of these plans. Blocks.

    Args:
        uploaded: the file with its options.
        runtime: the service.
        tenant: owner of the venue.
        client: client of the request.
        venue_id: a new id, or that of a repeated request.

    Raises:
        InvalidFloorPlanError, PlanTooLargeError: the file or one of its levels is invalid; then nothing is stored.
        TooManyFloorPlansError, TooManyVenuesError, StorageQuotaError: see `VenueImports.add`.
        MissingExtraError, OverloadedError, DeadlineExceededError, ConverterNotReadyError, StoppingError: see `convert`.
    """
    content = uploaded.file.read()
    name = uploaded.options.name or building_name(uploaded.file.name) or _DEFAULT_NAME
    files = convert_levels(
        content, uploaded.options, name, runtime.converter, runtime.settings, client, runtime.permits
    )
    limits = runtime.settings.plans
    if len(files) > limits.max_venue_plans:
        fault = f"has {len(files)} levels; the limit is {limits.max_venue_plans} floor plans (LALALOC_MAX_VENUE_PLANS)"
        raise InvalidRequestError([("file", fault)])
    for file in files:
        runtime.grids.check_size(file.plan, None if file.level is None else file.level.name)
    grids = runtime.grids.prepare_all([file.plan for file in files], client)
    originals = [_original(file, content if len(files) == 1 else None) for file in files]
    plans = [_new_plan(*values, runtime) for values in zip(files, _level_numbers(files), originals, grids, strict=True)]
    venue, records = runtime.store.venue_imports.add(
        tenant, venue_id, name, plans, max_plans=limits.max_floorplans, max_venues=limits.max_venues
    )
    # None if an earlier attempt stored them; the grids that it left are computed later.
    for record, grid in zip(records, grids, strict=False):
        runtime.grids.on_plan_stored(record, grid)
    return venue


def _new_plan(file: PlanFile, level: float, original: Original, grid: ComputedGrid | None, runtime: Runtime) -> NewPlan:
    return NewPlan(
        plan=file.plan,
        level=level,
        original=original,
        document=file.document,
        grid=grid,
        later_bytes=runtime.grids.expected_bytes(file.plan) if grid is None else 0,
    )


def _original(file: PlanFile, content: bytes | None) -> Original:
    """Return the file that is kept for a plan: a level in the native format where the uploaded file has several."""
    if content is not None:
        return Original(content, file.media_type, file.report)
    document = file.document or PlanDocument.from_plan(file.plan)
    return Original(document.document.encode(), JSON, file.report)


def _level_numbers(files: Sequence[PlanFile]) -> list[float]:
    """Return the levels' numbers; their order if the file gives a level none."""
    numbers = [0.0 if file.level is None else file.level.number for file in files]
    known = [number for number in numbers if number is not None and abs(number) <= _MAX_LEVEL]
    return known if len(known) == len(files) else [float(index) for index in range(len(files))]
