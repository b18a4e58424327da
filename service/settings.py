"""Settings of the service, read once from environment variables that start with `LALALOC_`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import PlanLimits
from lalaloc_core.importers import ImportLimits
from lalaloc_core.localise.bundle import default_bundle
from lalaloc_core.panorama.images import PanoramaLimits
from service.cores import CoreShares, share_cores, usable_cores
from service.fair_share import with_headroom
from service.setting_types import Count, HostNames, Metres, Origins, PortMapping, Seconds

PREFIX = "LALALOC_"
_DEFAULT_BUNDLE = default_bundle().resolve()

# Requests that may be uploading, besides queries in work.
_UPLOADS = 38


class Settings(BaseSettings):
    """Every field is the variable `LALALOC_<FIELD NAME>`; build with `Settings.load()`.

    Units stand in the names: `_s` seconds, `_m` metres, `_bytes` bytes.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, env_ignore_empty=True, frozen=True, extra="forbid")

    data_dir: Path = Field(default=Path("data"), description="Folder of the database; created when missing.")
    database_url: str | None = Field(
        default=None,
        description="`postgresql://user:password@host/name` or `sqlite:///file`; by default SQLite in the data folder.",
    )
    database_connections: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=8, description="Connections to the database that are open at a time."
    )
    database_wait_s: Seconds = Field(
        default=2.0, description="Longest wait for a connection to the database; then the answer is a 503."
    )
    bundle: Path = Field(default=_DEFAULT_BUNDLE, description="Folder of the model bundle.")
    log_level: str = Field(
        default="info", pattern="^(debug|info|warning|error)$", description="Least level that is logged."
    )
    otlp_endpoint: str | None = Field(
        default=None,
        pattern="^https?://[^/]+",
        description="Full address of an OpenTelemetry collector, `http://collector:4318/v1/traces`; spans of requests "
        "and their stages go there. Needs the extra `otel`.",
    )

    workers: int | None = Field(
        default=None,
        ge=0,
        le=64,
        description="LPO worker processes; by default a quarter of the cores that the process may use (affinity and "
        "control group's quota), at least one. 0 turns LPO off, answers end at VDR.",
    )
    worker_threads: int = Field(default=0, ge=0, le=256, description="Torch threads of each LPO worker; 0: one.")
    onnx_threads: int = Field(default=0, ge=0, le=256, description="onnxruntime threads per network; 0: one.")
    compute_threads: int = Field(
        default=0,
        ge=0,
        le=256,
        description="Queries that the service's own process computes at the same time, besides those in LPO; 0: as "
        "many as the LPO workers leave cores for; a worker that has more than a quarter of them shares it.",
    )
    lpo_queue: Count = Field(default=16, description="LPO jobs that may wait for a worker; more are answered by VDR.")
    lpo_deadline_s: Seconds = Field(default=2.0, description="Longest wait for LPO before the VDR pose is the answer.")
    lpo_stall_s: Seconds = Field(default=10.0, description="An LPO worker busy with one job for longer is restarted.")

    decode_workers: Annotated[int, Field(ge=1, le=64)] = Field(
        default=2,
        description="Processes that decode panoramas, one picture at a time each; one is always left to other tenants "
        "than those that have others at work.",
    )
    decode_queue: Count = Field(default=32, description="Panoramas that may wait to be decoded; more get a 503.")
    decode_stall_s: Seconds = Field(
        default=4.0, description="A process busy with one panorama for longer is replaced, and the query fails."
    )
    decode_memory_bytes: Annotated[int, Field(ge=64 * 2**20)] = Field(
        default=2**30, description="Memory that decoding one panorama may need; enforced on Linux."
    )
    import_workers: Annotated[int, Field(ge=1, le=64)] = Field(
        default=2,
        description="Processes that read and write files of plans but those in the native format, one at a time each; "
        "they start with the first such file. One is always left to other tenants than those that have others at work.",
    )
    import_queue: Count = Field(default=16, description="Files of plans that may wait to be read; more get a 503.")
    import_stall_s: Seconds = Field(
        default=40.0, description="A process busy with one file of a plan for longer is replaced, and the upload fails."
    )
    import_deadline_s: Seconds = Field(
        default=60.0, description="Longest that reading or writing the file of a plan may take, waiting included."
    )
    import_memory_bytes: Annotated[int, Field(ge=256 * 2**20)] = Field(
        default=2 * 2**30,
        description="Memory that reading the file of a plan may need, with the libraries for it; enforced on Linux.",
    )
    compass_tolerance_deg: float = Field(
        default=20.0,
        ge=0.0,
        le=45.0,
        description="How far off the compass heading in a panorama's metadata may be: it is searched for within that.",
    )

    api_keys: bool = Field(
        default=False,
        description="Every route but health needs an API key; make them with `lalaloc-service keys create`.",
    )
    allow_anonymous: bool = Field(
        default=False,
        description="Without API keys, listen to others than this machine as well: where something else decides who "
        "gets here.",
    )
    allowed_hosts: HostNames = Field(
        default="",
        description="Without API keys, names besides this machine's that requests may be for (`Host`) and pages come "
        "from (`Origin`), separated by commas; `*` for any.",
    )
    cors_origins: Origins = Field(
        default="",
        description="Origins whose pages may ask from a browser (CORS), separated by commas, such as "
        "`https://plans.example`; `*` for any, which needs `api_keys`.",
    )
    published_on: PortMapping = Field(
        default="",
        description="Where the port is published if not where the service listens, as Docker has it: `127.0.0.1:8000`, "
        "or `8000` for every address. Without API keys, addresses of this machine only, unless `allow_anonymous`.",
    )
    key_cache_s: Annotated[float, Field(ge=0.0, le=60.0)] = Field(
        default=5.0, description="How long an API key is remembered: a revoked one is refused at most that much later."
    )
    rate_per_minute: Annotated[int, Field(ge=0, le=10**6)] = Field(
        default=600,
        description="Requests per minute of an API key that has no rate of its own, counted by each replica; 0: any "
        "number.",
    )
    rate_burst: Annotated[int, Field(ge=0, le=10**6)] = Field(
        default=60, description="Of these, most within one second; 0: any number."
    )
    refused_keys_per_minute: Annotated[int, Field(ge=1, le=10**6)] = Field(
        default=60,
        description="Invalid API keys per minute of a client address, counted by each replica; further ones are not "
        "looked at, those that work go on working.",
    )

    request_deadline_s: Seconds = Field(default=10.0, description="Longest a query may take once it is uploaded.")
    upload_deadline_s: Seconds = Field(default=60.0, description="Longest an upload may take.")
    upload_idle_s: Seconds = Field(default=10.0, description="Longest wait for the next bytes of an upload.")
    upload_bytes_per_s: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = Field(
        default=8192.0, description="Slowest an upload may be, once it is `upload_idle_s` behind."
    )
    max_pending_requests: int = Field(
        default=0,
        ge=0,
        description="Uploads and queries in work, from the first byte on; more get a 503 at once. "
        "0: 38 more than queries may be in work.",
    )
    max_queries: int = Field(
        default=0,
        ge=0,
        description="Queries, of these, that are computed at a time; more wait, see `LALALOC_MAX_WAITING_QUERIES`. "
        "0: enough for a tenant alone to have twice as many as LPO workers and compute threads.",
    )
    max_waiting_queries: int = Field(
        default=16,
        ge=0,
        description="Queries that wait for one of those to end; more get a 503 before they are uploaded.",
    )
    max_reads: Count = Field(default=64, description="Requests in work that change nothing; more get a 503 at once.")
    max_streams: Count = Field(default=64, description="Clients that follow events; more get a 503 at once.")
    stream_deadline_s: Seconds = Field(
        default=900.0, description="Longest that a client follows events before it has to ask anew."
    )
    max_connections: Count = Field(default=1024, description="Open connections, idle ones included; more get a 503.")
    keep_alive_s: Seconds = Field(default=15.0, description="How long a connection may be idle between requests.")
    head_deadline_s: Seconds = Field(
        default=10.0, description="Longest that the head of a request, or the rest of a refused body, may take."
    )
    stop_deadline_s: Annotated[float, Field(ge=1.0, le=3600.0)] = Field(
        default=20.0, description="Longest that stopping may take: what is in work is finished, the rest refused."
    )
    stop_notice_s: Annotated[float, Field(ge=0.0, le=3600.0)] = Field(
        default=0.0, description="How long `/readyz` tells a load balancer that the service stops before it does."
    )

    grid_step_m: float = Field(default=0.5, ge=0.1, le=5.0, description="Distance of the poses of a latent grid.")
    max_grid_poses: Count = Field(default=900_000, description="Poses that a plan's latent grid may have.")
    inline_grid_poses: int = Field(
        default=1000,
        ge=0,
        description="A plan that needs no more grid poses than this is ready when its upload is answered; larger ones "
        "are prepared in the background.",
    )
    grid_lease_s: Annotated[float, Field(ge=0.1, le=3600.0, allow_inf_nan=False)] = Field(
        default=15.0,
        description="A replica that is silent for longer loses the latent grid that it computes to another.",
    )
    sweep_s: Annotated[float, Field(ge=0.1, le=3600.0, allow_inf_nan=False)] = Field(
        default=5.0,
        description="How often plans that are gone are dropped from memory, and grids that nobody computes taken up.",
    )
    plan_cache_bytes: int = Field(
        default=64 * 2**20,
        ge=0,
        description="Floor plans kept in memory, so that they are not read anew for every query, and to localise while "
        "the database is away. 0: none is kept.",
    )
    plan_cache_age_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = Field(
        default=600.0, description="How long a plan in memory is trusted while the database is away."
    )
    grid_cache_bytes: int = Field(default=2**30, ge=0, description="Latent grids kept in memory.")
    venue_cache_bytes: int = Field(
        default=128 * 2**20,
        ge=0,
        description="Memory for indices of large venues: 45 bytes per prototype, some 7.5 kB per plan of a home.",
    )
    venue_file_bytes: int = Field(
        default=2 * 2**30,
        ge=0,
        description="Prototypes of floor plans in a file in `LALALOC_DATA_DIR`, which large venues are searched by: 82 "
        "bytes each, some 14 kB per floor plan of a home. It can be deleted while the service is stopped.",
    )
    max_grids_per_plan: Annotated[int, Field(ge=2)] = Field(
        default=8, description="Stored latent grids (camera heights) per plan; the oldest on-demand one makes room."
    )

    keep_answers_s: Annotated[float, Field(ge=0.0, le=366 * 86400.0)] = Field(
        default=0.0,
        description="How long answers, not their panoramas, are kept so that a link opens them again; 0: not at all.",
    )
    max_kept_answers: Count = Field(default=10_000, description="Kept answers per tenant; the oldest makes room.")

    max_revisions: Annotated[int, Field(ge=2)] = Field(
        default=10, description="Revisions kept per floor plan; the oldest makes room."
    )
    max_floorplans: Count = Field(default=10_000, description="Stored floor plans per tenant.")
    max_plan_bytes: Count = Field(default=40 * 2**20, description="Upload of a floor plan, whatever its format.")
    max_unpacked_bytes: Count = Field(
        default=200_000_000,
        description="What an archive, or a compressed part of a floor plan's file, unpacks to.",
    )
    max_entities: Count = Field(
        default=300_000, description="Lines, polygons, texts and the like in the file of a floor plan, with vertices."
    )
    max_plan_pixels: Count = Field(default=40_000_000, description="Pixels of a picture of a floor plan.")
    max_import_s: Seconds = Field(
        default=30.0, description="Longest that reading the file of a floor plan may take, once it is begun."
    )
    max_rooms: Count = Field(default=10_000, description="Rooms per floor plan.")
    max_vertices: Annotated[int, Field(ge=3)] = Field(default=200, description="Vertices per room.")
    max_plan_vertices: Annotated[int, Field(ge=3)] = Field(
        default=100_000, description="Vertices of all rooms of a floor plan."
    )
    max_extent_m: Metres = Field(default=1000.0, description="Width or height of a floor plan.")
    max_area_m2: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = Field(
        default=200_000.0, description="Floor area of all rooms of a floor plan."
    )
    max_bounds_area_m2: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = Field(
        default=500_000.0,
        description="Area of the boxes around all rooms of a floor plan, which its latent grid is looked for in.",
    )
    max_openings: Annotated[int, Field(ge=0)] = Field(
        default=20_000, description="Doors, windows and passages of a floor plan."
    )
    max_venues: Count = Field(default=1000, description="Stored venues per tenant.")
    max_venue_plans: Count = Field(default=10_000, description="Floor plans of a venue.")
    max_venue_bytes: Count = Field(default=4 * 2**20, description="Description of a venue: its list of plans, mostly.")
    max_panorama_bytes: Count = Field(default=40 * 2**20, description="Upload of a panorama.")
    max_sequence_panoramas: Annotated[int, Field(ge=2, le=20)] = Field(
        default=10, description="Panoramas of one query of several."
    )
    max_sequence_bytes: Count = Field(
        default=100 * 2**20, description="Upload of all panoramas of one query of several."
    )
    max_pixels: Count = Field(default=100_000_000, description="Pixels of a panorama.")
    max_scans: Count = Field(
        default=20, description="Scans of a panorama that is a progressive JPEG; encoders write 3 to 12."
    )
    max_top_k: Annotated[int, Field(ge=1, le=100)] = Field(default=10, description="Candidates of an answer.")

    @model_validator(mode="after")
    def _any_page_needs_keys(self) -> Self:
        if "*" in self.cors_origin_set and not self.api_keys:
            raise ValueError("LALALOC_CORS_ORIGINS=* needs LALALOC_API_KEYS=on: any page could change all plans")
        return self

    @classmethod
    def load(cls) -> Self:
        """Read the settings from the environment; an empty variable counts as not set.

        Raises:
            ConfigError: a `LALALOC_` variable that no setting has, or a value outside its limits.
        """
        known = {PREFIX + name.upper() for name in cls.model_fields}
        unknown = sorted(name for name in os.environ if name.upper().startswith(PREFIX) and name.upper() not in known)
        if unknown:
            raise ConfigError(f"unknown setting {', '.join(unknown)}; known are {', '.join(sorted(known))}")
        try:
            return cls()
        except ValidationError as error:
            raise ConfigError("; ".join(_describe(fault) for fault in error.errors())) from error

    @property
    def allowed_host_names(self) -> frozenset[str]:
        """The names in `allowed_hosts`, in lower case."""
        return frozenset(name.strip().lower() for name in self.allowed_hosts.split(",")) - {""}

    @property
    def cors_origin_set(self) -> frozenset[str]:
        """The origins in `cors_origins`, in lower case."""
        return frozenset(origin.strip().lower() for origin in self.cors_origins.split(",")) - {""}

    @property
    def published_host(self) -> str | None:
        """The address in `published_on`, `0.0.0.0` where it is a port alone; None where nothing is said."""
        if not self.published_on:
            return None
        return self.published_on.rpartition(":")[0].strip("[]") or "0.0.0.0"

    @property
    def cores(self) -> CoreShares:
        """How the cores are shared out, with what is left open filled in."""
        return share_cores(
            usable_cores(),
            workers=self.workers,
            worker_threads=self.worker_threads,
            compute_threads=self.compute_threads,
            onnx_threads=self.onnx_threads,
        )

    @property
    def pending_limit(self) -> int:
        """Uploads and queries that may be in work."""
        return self.max_pending_requests or self.query_limit + _UPLOADS

    @property
    def query_limit(self) -> int:
        """Queries that may be computed or wait for it."""
        return self.max_queries or with_headroom(2 * (self.cores.workers + self.cores.compute_threads))

    @property
    def resolved_database_url(self) -> str:
        """The SQLAlchemy URL in use."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'lalaloc.sqlite3').resolve()}"

    @property
    def plan_limits(self) -> PlanLimits:
        """Limits of floor plans in the terms of the core."""
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
        """Limits of the files of floor plans in the terms of the core."""
        return ImportLimits(
            max_plan_bytes=self.max_plan_bytes,
            max_unpacked_bytes=self.max_unpacked_bytes,
            max_entities=self.max_entities,
            max_plan_pixels=self.max_plan_pixels,
            max_import_s=self.max_import_s,
            plan=self.plan_limits,
        )

    @property
    def panorama_limits(self) -> PanoramaLimits:
        """Limits of panoramas in the terms of the core."""
        return PanoramaLimits(max_pixels=self.max_pixels, max_scans=self.max_scans)


def settings_table() -> str:
    """All settings as a Markdown table, for the documentation."""
    lines = ["| variable | default | meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = "`models/default`" if name == "bundle" else "" if field.default is None else f"`{field.default}`"
        lines.append(f"| `{PREFIX}{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines) + "\n"


def _describe(fault: Mapping[str, object]) -> str:
    location = fault["loc"]
    if not location:
        # About several of them, which it names.
        return str(fault["msg"]).removeprefix("Value error, ")
    field = str(location[0]) if isinstance(location, tuple) and location else "?"
    return f"{PREFIX}{field.upper()} is {fault['input']!r}: {fault['msg']}"
