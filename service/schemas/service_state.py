"""Limits, health and readiness of the service."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lalaloc_core.localise.answers.documents import ModelAnswer
from service.schemas.fields import ResponseModel


class LimitsAnswer(ResponseModel):
    """Limits of requests; most are settings, and errors name them."""

    max_plan_bytes: int = Field(description="Size of a plan file, in any format.")
    max_unpacked_bytes: int = Field(description="Unpacked size of an archive, or of a compressed part of a plan file.")
    max_entities: int = Field(
        description="Drawing entities (lines, polygons, texts) of a plan file, vertices included."
    )
    max_plan_pixels: int = Field(description="Pixels of a floor plan picture.")
    max_import_s: float = Field(description="CPU time limit for reading a plan file.")
    max_floorplans: int = Field(description="Stored floor plans per tenant.")
    max_rooms: int = Field(description="Rooms per floor plan.")
    max_vertices: int = Field(description="Vertices per room.")
    max_plan_vertices: int = Field(description="Vertices of all rooms of a floor plan.")
    max_extent_m: float = Field(description="Width or height of a floor plan.")
    max_area_m2: float = Field(description="Floor area of all rooms of a floor plan.")
    max_bounds_area_m2: float = Field(description="Area of the bounding boxes of all rooms.")
    max_openings: int = Field(description="Doors, windows and passages of a floor plan.")
    max_grid_poses: int = Field(description="Maximum number of poses in the pose grid of one plan.")
    max_venues: int = Field(description="Stored venues per tenant.")
    max_venue_plans: int = Field(description="Floor plans of a venue.")
    max_venue_bytes: int = Field(description="Size of a venue document.")
    max_photograph_bytes: int = Field(description="Size of a photograph's file.")
    max_sequence_photographs: int = Field(description="Photographs of a sequence query; more than 10 have more time.")
    max_sequence_bytes: int = Field(description="Size of all photographs of a sequence query or a batch.")
    max_film_bytes: int = Field(description="Size of a film's file.")
    max_film_s: float = Field(description="Duration of a film.")
    max_film_pixels: int = Field(description="Pixels of a film: width times height.")
    max_film_cpu_s: float = Field(description="CPU time limit for decoding a film.")
    max_batch_photographs: int = Field(description="Photographs of a batch.")
    max_albums: int = Field(description="Albums per tenant.")
    max_album_photographs: int = Field(description="Photographs of an album.")
    max_pixels: int = Field(description="Pixels of a photograph.")
    require_features: bool = Field(description="Photographs are refused; queries need features.")
    max_scans: int = Field(description="Scans of a progressive JPEG.")
    max_top_k: int = Field(description="Candidates per answer.")
    max_pending_requests: int = Field(description="Uploads and queries in progress.")
    max_queries: int = Field(description="Queries computed at a time; further ones wait.")
    max_queries_per_tenant: int = Field(
        description="Queries computed at a time for one tenant (without API keys: for one client address). A tenant "
        "that is alone and stays within it is never refused."
    )
    max_waiting_queries: int = Field(description="Queries that wait for a slot; further ones get 503.")
    max_reads: int = Field(description="Read-only requests in progress; further ones get 503.")
    max_streams: int = Field(description="Open event streams; further ones get 503.")
    max_revisions: int = Field(description="Revisions kept per floor plan.")
    upload_deadline_s: float = Field(description="Timeout for an upload.")
    upload_idle_s: float = Field(description="Timeout for the next bytes of an upload.")
    upload_bytes_per_s: float = Field(
        description="Minimum upload rate; an upload can lag behind it by `upload_idle_s`."
    )
    request_deadline_s: float = Field(description="Timeout for a query after its upload.")


class StoredBytesByKind(ResponseModel):
    """Stored bytes of a tenant by kind."""

    plans: int = Field(description="Floor plans with their revisions, uploaded files and import reports.")
    grids: int = Field(description="Pose grids.")
    venues: int = Field(description="Venues.")
    answers: int = Field(description="Kept answers.")
    sessions: int = Field(description="Sessions of tracked cameras.")
    albums: int = Field(description="Albums, with the features and pins of their photographs.")
    idempotency: int = Field(description="Idempotency keys and their answers.")


class StoredBytesAnswer(ResponseModel):
    """Stored bytes of a tenant with their limit."""

    used: int = Field(description="Stored bytes, with an estimate for rows and indices.")
    limit: int = Field(description="Limit of `used`; uploads beyond it get 507.")
    by_kind: StoredBytesByKind


class BytesInFlightAnswer(ResponseModel):
    """Bytes of request bodies in progress of a tenant with their limit, in this replica."""

    used: int = Field(description="Bytes of request bodies in progress.")
    limit: int = Field(description="Limit of `used`; requests beyond it get 503.")


class UsageAnswer(ResponseModel):
    """Use of the service by a tenant."""

    tenant: str
    stored_bytes: StoredBytesAnswer
    bytes_in_flight: BytesInFlightAnswer
    cpu_seconds: float = Field(description="CPU time (s) of the tenant's requests in this replica since it started.")


class HealthAnswer(ResponseModel):
    """Liveness of the process."""

    status: Literal["ok"]


class PoolAnswer(ResponseModel):
    """State of a pool of worker processes."""

    workers: int = Field(description="Configured worker processes.")
    ready: int = Field(description="Worker processes that are ready now.")
    warmed_up: bool = Field(description="True after every worker has been ready.")
    fault: str | None = Field(description="Reason why a worker failed to start; null if none did.")


class ReadyAnswer(ResponseModel):
    """Readiness of the service."""

    ready: bool
    model: ModelAnswer
    lpo_pool: PoolAnswer
    decode_pool: PoolAnswer
    import_pool: PoolAnswer = Field(description="Processes that read plan files; they start on first use.")
    database: Literal["answers", "unavailable", "damaged"] = Field(
        description="Without the database, the service is ready and answers queries in plans that it has in memory."
    )
    plans_preparing: int = Field(description="Plans whose pose grid is not computed yet.")
