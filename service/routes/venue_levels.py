"""Venues of the levels of plan files."""

from __future__ import annotations

from collections.abc import Sequence

from lalaloc_core.importers import building_name
from service.errors import InvalidRequestError
from service.plan_files.plan_file import PlanFile, convert_levels
from service.routes.plan_uploads import PlanUpload
from service.runtime import Runtime
from service.storage.records import JSON, ComputedGrid, Original, PlanRecord, VenueRecord
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
    name = uploaded.options.name or building_name(uploaded.file.name) or _DEFAULT_NAME
    plans = _new_plans(uploaded, runtime, client, name)
    limits = runtime.settings.plans
    venue, records = runtime.store.venue_imports.add(
        tenant, venue_id, name, plans, max_plans=limits.max_floorplans, max_venues=limits.max_venues
    )
    _announce(plans, records, runtime)
    return venue


def add_levels_to_venue(
    uploaded: PlanUpload,
    runtime: Runtime,
    tenant: str,
    client: str,
    venue: VenueRecord,
    token: str,
    expected: str | None,
) -> VenueRecord:
    """Store a plan of every level of a file with rooms, and add them to a venue. Blocks.

    Args:
        uploaded: the file with its options.
        runtime: the service.
        tenant: owner of the venue.
        client: client of the request.
        venue: the venue.
        token: the same for every attempt of the request.
        expected: id of the revision that the venue must have; None for any.

    Raises:
        LaLaLocError: see `store_venue_of_levels` and `VenueImports.extend`.
    """
    plans = _new_plans(uploaded, runtime, client, uploaded.options.name or venue.name or _DEFAULT_NAME)
    limits = runtime.settings.plans
    extended, records = runtime.store.venue_imports.extend(
        tenant,
        venue.id,
        token,
        plans,
        max_plans=limits.max_floorplans,
        max_venue_plans=limits.max_venue_plans,
        expected=expected,
    )
    _announce(plans, records, runtime)
    return extended


def _new_plans(uploaded: PlanUpload, runtime: Runtime, client: str, name: str) -> list[NewPlan]:
    """Return the plans of a file, with the pose grids that are computed at once."""
    content = uploaded.file.read()
    files = convert_levels(
        content, uploaded.options, name, runtime.converter, runtime.settings, client, runtime.permits
    )
    limit = runtime.settings.plans.max_venue_plans
    if len(files) > limit:
        fault = f"has {len(files)} levels; the limit is {limit} floor plans (LALALOC_MAX_VENUE_PLANS)"
        raise InvalidRequestError([("file", fault)])
    for file in files:
        runtime.grids.check_size(file.plan, None if file.level is None else file.level.name)
    grids = runtime.grids.prepare_all([file.plan for file in files], client)
    originals = [_original(file, content if len(files) == 1 else None) for file in files]
    return [_new_plan(*values, runtime) for values in zip(files, _level_numbers(files), originals, grids, strict=True)]


def _announce(plans: Sequence[NewPlan], records: Sequence[PlanRecord], runtime: Runtime) -> None:
    """Tell the provider of grids about stored plans; there are no records if an earlier attempt stored them."""
    # The grids that an earlier attempt left are computed later.
    for record, new in zip(records, plans, strict=False):
        runtime.grids.on_plan_stored(record, new.grid)


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
