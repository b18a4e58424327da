"""Groups of settings: fields, defaults, limits and descriptions.

Limits that need no setting stand beside them as constants; `GET /limits` describes them (`schemas/service_state.py`).
Units stand in the names: `_s` seconds, `_m` metres, `_bytes` bytes.
"""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from lalaloc_core.floorplan import DEFAULT_LIMITS as _PLAN
from lalaloc_core.floorplan import PlanLimits
from lalaloc_core.importers import DEFAULT_IMPORT_LIMITS as _IMPORT
from lalaloc_core.importers import ImportLimits
from lalaloc_core.photograph.film import FilmLimits
from lalaloc_core.photograph.spheres import PhotographLimits
from service.settings.setting_types import Count, HostNames, IssuerUrl, Origins, PortMapping, Seconds

_FILM = FilmLimits()


class SettingGroup(BaseModel):
    """Settings of one kind; the first line of the docstring is their heading in the documentation.

    Attributes:
        prefix: start of the variables' names, after `LALALOC_`; the field's name follows.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    prefix: ClassVar[str] = ""


class DatabaseSettings(SettingGroup):
    """Database."""

    prefix = "database_"

    url: str | None = Field(
        default=None,
        description="`postgresql://user:password@host/name` or `sqlite:///file`. Default: SQLite in the data folder.",
    )
    connections: int = Field(default=8, ge=1, le=1000, description="Size of the connection pool.")
    # A request without a connection by then (s) fails with 503: longer waits would fill the slots of others.
    wait_s: ClassVar[float] = 2.0


class ComputeSettings(SettingGroup):
    """Processor cores."""

    workers: int | None = Field(
        default=None,
        ge=0,
        le=64,
        description="LPO worker processes, for models that compare latents. Default: a quarter of the usable cores "
        "(affinity and cgroup quota), at least 1. 0: no LPO; answers end at VDR.",
    )
    # Torch threads per LPO worker: more use the cores less well.
    worker_threads: ClassVar[int] = 1
    onnx_threads: int = Field(default=0, ge=0, le=256, description="onnxruntime threads per network. 0: one.")
    compute_threads: int = Field(
        default=0,
        ge=0,
        le=256,
        description="Queries that the main process computes at a time. 0: the cores that the LPO workers leave free.",
    )


class LpoSettings(SettingGroup):
    """Pose refinement (LPO)."""

    prefix = "lpo_"

    # LPO jobs that wait for a worker: a longer wait would exceed the timeout of most.
    queue: ClassVar[int] = 16
    deadline_s: Seconds = Field(
        default=2.0, description="LPO timeout per query; the answer then falls back to the VDR pose."
    )
    # CPU time (s) of one LPO job, several times the longest; its worker is then restarted.
    stall_s: ClassVar[float] = 10.0


class DecodeSettings(SettingGroup):
    """Decoding photographs."""

    prefix = "decode_"

    workers: int = Field(
        default=2,
        ge=1,
        le=64,
        description="Processes that decode photographs, one at a time each. One is reserved for idle tenants.",
    )
    # CPU time (s) for decoding one photograph, several times that of the largest; the process is then replaced.
    stall_s: ClassVar[float] = 4.0
    memory_bytes: int = Field(
        default=2**30, ge=64 * 2**20, description="Memory limit for decoding one photograph or film; enforced on Linux."
    )
    # Processes that read films, one at a time each; started on first use. A film occupies a core for seconds.
    film_workers: ClassVar[int] = 1


class ImportSettings(SettingGroup):
    """Import of plan files."""

    prefix = "import_"

    workers: int = Field(
        default=2,
        ge=1,
        le=64,
        description="Processes that read and write plan files (not the native format); started on first use. One is "
        "reserved for idle tenants.",
    )
    memory_bytes: int = Field(
        default=2 * 2**30,
        ge=256 * 2**20,
        description="Memory limit for reading one plan file, libraries included; enforced on Linux.",
    )


class AccessSettings(SettingGroup):
    """Access."""

    api_keys: bool = Field(
        default=False,
        description="Require an API key on every route except health and the pages; create keys with `lalaloc-service "
        "keys create`.",
    )
    allow_anonymous: bool = Field(
        default=False,
        description="Without API keys, also listen on public addresses. Use it behind your own access control.",
    )
    allowed_hosts: HostNames = Field(
        default="",
        description="Without API keys: host names, separated by commas, that requests can use (`Host`, `Origin`) "
        "besides this machine's; `*` for any.",
    )
    cors_origins: Origins = Field(
        default="",
        description="CORS: origins, separated by commas, whose pages can call the API from a browser, such as "
        "`https://plans.example`; `*` for any, which needs `LALALOC_API_KEYS=on`.",
    )
    published_on: PortMapping = Field(
        default="",
        description="Address on which a container publishes the port, such as `127.0.0.1:8000`; `8000` alone means "
        "every address. Without API keys it must be an address of this machine, unless `LALALOC_ALLOW_ANONYMOUS=on`.",
    )
    # Lifetime (s) of an API key in memory: a revoked key is rejected after this delay.
    key_cache_s: ClassVar[float] = 5.0
    rate_per_minute: int = Field(
        default=600,
        ge=0,
        le=10**6,
        description="Rate limit per API key and replica, in requests per minute, for keys without a rate of their own; "
        "each photograph of a batch counts as one, and an answer to GET as one more per 256 KiB. 0: no limit.",
    )
    rate_burst: int = Field(
        default=60,
        ge=0,
        le=10**6,
        description="Rate limit per API key and replica, in requests per second. 0: no limit.",
    )

    oidc_issuer: IssuerUrl = Field(
        default="",
        description="OpenID Connect: URL of the issuer whose tokens are accepted beside API keys, as in their claim "
        "`iss`. Needs `LALALOC_API_KEYS=on` and `LALALOC_OIDC_AUDIENCE`.",
    )
    oidc_audience: str = Field(default="", description="OpenID Connect: claim `aud` that tokens need.")
    oidc_tenant_claim: str = Field(
        default="tenant",
        min_length=1,
        description="OpenID Connect: claim with the tenant; dots separate the names of nested claims.",
    )
    oidc_scope_claim: str = Field(
        default="scope",
        min_length=1,
        description="OpenID Connect: claim with the scopes, such as `lalaloc:read`, as a list or separated by spaces.",
    )

    @model_validator(mode="after")
    def _any_page_needs_keys(self) -> Self:
        if "*" in self.cors_origin_set and not self.api_keys:
            raise ValueError("LALALOC_CORS_ORIGINS=* needs LALALOC_API_KEYS=on: any page could change all plans")
        return self

    @model_validator(mode="after")
    def _tokens_need_keys_and_audience(self) -> Self:
        if self.oidc_issuer and not self.api_keys:
            raise ValueError("LALALOC_OIDC_ISSUER needs LALALOC_API_KEYS=on: all requests are accepted without")
        if bool(self.oidc_issuer) != bool(self.oidc_audience):
            raise ValueError("LALALOC_OIDC_ISSUER and LALALOC_OIDC_AUDIENCE need each other: set both or none")
        return self

    @property
    def allowed_host_names(self) -> frozenset[str]:
        """The names in `allowed_hosts`, in lower case."""
        return _items(self.allowed_hosts)

    @property
    def cors_origin_set(self) -> frozenset[str]:
        """The origins in `cors_origins`, in lower case."""
        return _items(self.cors_origins)

    @property
    def published_host(self) -> str | None:
        """The address in `published_on`, `0.0.0.0` if it is a port alone, None if it is empty."""
        if not self.published_on:
            return None
        return self.published_on.rpartition(":")[0].strip("[]") or "0.0.0.0"


class UploadSettings(SettingGroup):
    """Uploads."""

    prefix = "upload_"

    deadline_s: Seconds = Field(default=60.0, description="Timeout for an upload.")
    # Timeout (s) for the next bytes of an upload: slow networks pause for seconds.
    idle_s: ClassVar[float] = 10.0
    # Minimum rate of an upload, which can lag behind it by `idle_s`: slots are not for trickles.
    bytes_per_s: ClassVar[float] = 8192.0
    # Uploaded files beyond this size pass through unnamed temporary files in `TMPDIR`, which end with the request.
    memory_bytes: ClassVar[int] = 2**20
    tenant_bytes: Count = Field(
        default=256 * 2**20,
        description="Bytes of request bodies in progress per tenant, for tenants without a limit of their own "
        "(`lalaloc-service tenants limit`); further ones get 503, or 413 if the body alone exceeds it.",
    )
    total_bytes: Count = Field(
        default=448 * 2**20,
        description="Bytes of request bodies in progress, of all tenants together; further ones get 503.",
    )


class RequestSettings(SettingGroup):
    """Requests and connections."""

    request_deadline_s: Seconds = Field(default=10.0, description="Timeout for a query after its upload.")
    max_pending_requests: int = Field(
        default=0,
        ge=0,
        description="Uploads and queries in progress, from the first byte; further ones get 503. 0: "
        "`LALALOC_MAX_QUERIES` plus 38.",
    )
    max_queries: int = Field(
        default=0,
        ge=0,
        description="Queries computed at a time; further ones wait. 0: enough that one "
        "tenant can run two queries per LPO worker and compute thread.",
    )
    # Queries that wait for a slot; further ones would miss their deadline, and get 503 before their upload is read.
    max_waiting_queries: ClassVar[int] = 16
    # Read-only requests in progress, with their answers in memory; further ones get 503.
    max_reads: ClassVar[int] = 64
    max_streams: ClassVar[int] = 64
    # Open connections, idle ones included; the limit of file descriptors must allow them.
    max_connections: ClassVar[int] = 1024
    keep_alive_s: Seconds = Field(default=15.0, description="Timeout for an idle connection between requests.")
    stop_deadline_s: float = Field(
        default=20.0,
        ge=1.0,
        le=3600.0,
        description="Timeout for stopping: requests in progress finish, new ones are refused.",
    )
    stop_notice_s: float = Field(
        default=0.0, ge=0.0, le=3600.0, description="Time for which `/readyz` reports 503 before the service stops."
    )


class GridSettings(SettingGroup):
    """Pose grids."""

    grid_step_m: float = Field(
        default=0.5, ge=0.1, le=5.0, description="Distance between neighbouring poses of a pose grid."
    )
    max_grid_poses: Count = Field(default=900_000, description="Maximum number of poses in the pose grid of one plan.")
    # Pose grids up to this size take less than a second, and are computed during the upload.
    inline_grid_poses: ClassVar[int] = 1000
    # Lease (s) on a pose grid: if its owner is silent for longer, another replica computes the grid.
    grid_lease_s: ClassVar[float] = 15.0
    # Interval (s) at which deleted plans leave memory, and abandoned pose grids are taken over.
    sweep_s: ClassVar[float] = 5.0


class StorageSettings(SettingGroup):
    """Storage, caches and kept answers."""

    max_stored_bytes: Count | None = Field(
        default=None,
        description="Stored bytes per tenant: floor plans with their revisions and files, pose grids, venues, kept "
        "answers, sessions, albums, idempotency keys. `lalaloc-service tenants limit` sets the limit of one tenant. "
        "Default: 10 GiB, with SQLite at most half of its volume.",
    )
    # Idempotency keys and their answers per tenant; the oldest are deleted first.
    max_idempotency_bytes: ClassVar[int] = 64 * 2**20

    plan_cache_bytes: int = Field(
        default=64 * 2**20,
        ge=0,
        description="Floor plans kept in memory, for speed and for queries while the database is down; as much again "
        "for their descriptions, walls, drawings, meshes and exports. 0: none.",
    )
    grid_cache_bytes: int = Field(default=2**30, ge=0, description="Pose grids kept in memory.")
    venue_cache_bytes: int = Field(
        default=128 * 2**20,
        ge=0,
        description="Search indices of large venues kept in memory: 45 bytes per prototype, about 7.5 kB per home.",
    )
    # Prototype file of large venues: 82 bytes per prototype, so 150,000 homes.
    venue_file_bytes: ClassVar[int] = 2 * 2**30
    keep_answers_s: float = Field(
        default=0.0,
        ge=0.0,
        le=366 * 86400.0,
        description="Lifetime of kept answers, which a link reopens; photographs are never kept. 0: no answers are "
        "kept.",
    )
    # Kept answers per tenant; the oldest is deleted first.
    max_kept_answers: ClassVar[int] = 10_000
    session_ttl_s: float = Field(
        default=3600.0,
        ge=1.0,
        le=366 * 86400.0,
        description="Lifetime of a session of a tracked camera after its last photograph.",
    )
    # Sessions of tracked cameras per tenant, of at most 100 kB each.
    max_sessions: ClassVar[int] = 1000
    album_ttl_s: float = Field(
        default=90 * 86400.0, ge=1.0, le=3660 * 86400.0, description="Lifetime of an album after its last change."
    )
    # Albums per tenant; the photographs count among the stored bytes.
    max_albums: ClassVar[int] = 1000
    # Photographs of an album, which is what the solver is measured with.
    max_album_photographs: ClassVar[int] = 500
    audit_keep_s: float = Field(
        default=365 * 86400.0, ge=86400.0, le=3660 * 86400.0, description="Lifetime of entries of the audit log."
    )
    # Entries of the audit log, about 600 bytes each. A tenth is for requests of unknown callers.
    max_audit_entries: ClassVar[int] = 10**6


class PlanSettings(SettingGroup):
    """Limits of floor plans and venues."""

    max_floorplans: Count = Field(default=10_000, description="Stored floor plans per tenant.")
    # Revisions kept per floor plan; the oldest is deleted first.
    max_revisions: ClassVar[int] = 10
    max_plan_bytes: Count = Field(default=_IMPORT.max_plan_bytes, description="Size of a plan file, in any format.")
    max_unpacked_bytes: ClassVar[int] = _IMPORT.max_unpacked_bytes
    max_entities: ClassVar[int] = _IMPORT.max_entities
    max_plan_pixels: ClassVar[int] = _IMPORT.max_plan_pixels
    max_import_s: Seconds = Field(
        default=_IMPORT.max_import_s,
        description="CPU time limit for reading a plan file. The process is replaced 10 s later. With the wait for a "
        "process, an upload can take twice this time.",
    )
    max_rooms: ClassVar[int] = _PLAN.max_rooms
    max_vertices: ClassVar[int] = _PLAN.max_vertices_per_room
    max_plan_vertices: ClassVar[int] = _PLAN.max_plan_vertices
    max_extent_m: ClassVar[float] = _PLAN.max_extent_m
    max_area_m2: ClassVar[float] = _PLAN.max_area_m2
    # Area of the bounding boxes of all rooms of a floor plan; its pose grid is laid over them.
    max_bounds_area_m2: ClassVar[float] = _PLAN.max_bounds_area_m2
    max_openings: ClassVar[int] = _PLAN.max_openings
    max_venues: ClassVar[int] = 1000
    max_venue_plans: Count = Field(default=10_000, description="Floor plans of a venue.")
    max_venue_bytes: Count = Field(default=4 * 2**20, description="Size of a venue document.")

    @property
    def plan_limits(self) -> PlanLimits:
        """Limits of floor plans, for the core."""
        return PlanLimits(
            max_rooms=self.max_rooms,
            max_vertices_per_room=self.max_vertices,
            max_plan_vertices=self.max_plan_vertices,
            max_extent_m=self.max_extent_m,
            max_area_m2=self.max_area_m2,
            max_bounds_area_m2=self.max_bounds_area_m2,
            max_openings=self.max_openings,
        )

    @property
    def import_limits(self) -> ImportLimits:
        """Limits of plan files, for the core."""
        return ImportLimits(
            max_plan_bytes=self.max_plan_bytes,
            max_unpacked_bytes=self.max_unpacked_bytes,
            max_entities=self.max_entities,
            max_plan_pixels=self.max_plan_pixels,
            max_import_s=self.max_import_s,
            plan=self.plan_limits,
        )

    @property
    def import_deadline_s(self) -> float:
        """Timeout for reading or writing a plan file, waiting for a process included."""
        return 2.0 * self.max_import_s


class PhotographSettings(SettingGroup):
    """Limits of photographs and queries."""

    max_photograph_bytes: Count = Field(default=40 * 2**20, description="Size of a photograph's file.")
    max_sequence_photographs: int = Field(
        default=100, ge=2, le=100, description="Photographs of a turn; more than 10 have more time, in proportion."
    )
    max_sequence_bytes: Count = Field(default=100 * 2**20, description="Size of all photographs of a turn or a batch.")
    max_batch_photographs: int = Field(
        default=100,
        ge=1,
        le=1000,
        description="Photographs of a batch; `LALALOC_MAX_SEQUENCE_BYTES` limits their size.",
    )
    # Pixels of a photograph: as many as the memory of a decoder holds.
    max_pixels: ClassVar[int] = 100_000_000
    # Scans of a progressive JPEG; encoders write 3 to 12, and each takes as long as the picture.
    max_scans: ClassVar[int] = 20
    max_film_bytes: Count = Field(default=_FILM.max_bytes, description="Size of a film's file.")
    max_film_s: ClassVar[float] = _FILM.max_s
    max_film_pixels: ClassVar[int] = _FILM.max_pixels
    # CPU time limit (s) for decoding a film; finding its angles has 40 s more.
    max_film_cpu_s: ClassVar[float] = _FILM.max_cpu_s
    # Timeout (s) for reading a film, besides that of the query for its frames.
    film_deadline_s: ClassVar[float] = 120.0
    # Candidates per answer: as many as the page can show.
    max_top_k: ClassVar[int] = 10
    # Error of compasses indoors, within which headings are searched.
    compass_tolerance_deg: ClassVar[float] = 20.0

    require_features: bool = Field(
        default=False,
        description="Refuse photographs: queries need features, which devices compute (docs/reference/features.md).",
    )

    @property
    def photograph_limits(self) -> PhotographLimits:
        """Limits of photographs, for the core."""
        return PhotographLimits(max_pixels=self.max_pixels, max_scans=self.max_scans)

    @property
    def film_limits(self) -> FilmLimits:
        """Limits of films, for the core."""
        return FilmLimits(
            max_bytes=self.max_film_bytes,
            max_s=self.max_film_s,
            max_pixels=self.max_film_pixels,
            max_cpu_s=self.max_film_cpu_s,
        )


def _items(text: str) -> frozenset[str]:
    return frozenset(item.strip().lower() for item in text.split(",")) - {""}
