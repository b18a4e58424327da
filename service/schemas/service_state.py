"""What the service tells of itself: its limits, and whether it is well."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.schemas.fields import ResponseModel
from service.schemas.localise_answer import ModelAnswer


class LimitsAnswer(ResponseModel):
    """What requests may be; most are the setting of the same name, and named by the error about it."""

    max_plan_bytes: int = Field(description="Upload of a floor plan, whatever its format.")
    max_unpacked_bytes: int = Field(description="What an archive of a floor plan unpacks to.")
    max_entities: int = Field(description="Lines, polygons, texts and the like in a floor plan's file, with vertices.")
    max_plan_pixels: int = Field(description="Pixels of a picture of a floor plan.")
    max_import_s: float = Field(description="Longest that reading the file of a floor plan may take.")
    max_floorplans: int = Field(description="Stored floor plans per tenant.")
    max_rooms: int = Field(description="Rooms per floor plan.")
    max_vertices: int = Field(description="Vertices per room.")
    max_plan_vertices: int = Field(description="Vertices of all rooms of a floor plan.")
    max_extent_m: float = Field(description="Width or height of a floor plan.")
    max_area_m2: float = Field(description="Floor area of all rooms of a floor plan.")
    max_bounds_area_m2: float = Field(description="Area of the boxes around all rooms of a floor plan.")
    max_openings: int = Field(description="Doors, windows and passages of a floor plan.")
    max_grid_poses: int = Field(description="Poses that a plan's latent grid may have.")
    max_venues: int = Field(description="Stored venues per tenant.")
    max_venue_plans: int = Field(description="Floor plans of a venue.")
    max_venue_bytes: int = Field(description="Description of a venue.")
    max_panorama_bytes: int = Field(description="Upload of a panorama.")
    max_sequence_panoramas: int = Field(description="Panoramas of one query.")
    max_sequence_bytes: int = Field(description="Upload of all panoramas of one query; each may be a panorama's size.")
    max_pixels: int = Field(description="Pixels of a panorama.")
    max_scans: int = Field(description="Scans of a panorama that is a progressive JPEG.")
    max_top_k: int = Field(description="Candidates of an answer.")
    max_pending_requests: int = Field(description="Uploads and queries in flight.")
    max_queries: int = Field(description="Queries in work; more wait.")
    max_queries_per_tenant: int = Field(
        description="Of these, in work for one tenant, or one client where there are no API keys: who sends no more at "
        "a time is refused none while it is alone."
    )
    max_waiting_queries: int = Field(description="Queries that wait for those in work; more get a 503 at once.")
    max_reads: int = Field(description="Requests in work that change nothing; more get a 503 at once.")
    max_streams: int = Field(description="Clients that follow events; more get a 503 at once.")
    max_revisions: int = Field(description="Kept revisions of a floor plan.")
    upload_deadline_s: float = Field(description="Longest an upload may take.")
    upload_idle_s: float = Field(description="Longest wait for the next bytes of an upload.")
    upload_bytes_per_s: float = Field(description="Slowest an upload may be, once it is `upload_idle_s` behind.")
    request_deadline_s: float = Field(description="Longest a query may take once it is uploaded.")


class HealthAnswer(ResponseModel):
    """The process is alive."""

    status: Literal["ok"]


class PoolAnswer(ResponseModel):
    """State of a pool of worker processes."""

    workers: int = Field(description="Worker processes wanted.")
    ready: int = Field(description="Worker processes that are warm now.")
    warmed_up: bool = Field(description="Whether every worker has been warm once.")
    fault: str | None = Field(description="Why a worker could not start last time, null when all is well.")


class ReadyAnswer(ResponseModel):
    """Whether the service can answer at full quality."""

    ready: bool
    model: ModelAnswer
    lpo_pool: PoolAnswer
    decode_pool: PoolAnswer
    import_pool: PoolAnswer = Field(description="Reads files of plans; its workers start with the first one.")
    plans_preparing: int = Field(description="Plans whose latent grid is being computed, or will be.")
