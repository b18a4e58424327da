"""Settings of the service, read once from environment variables that start with `LALALOC_`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import PlanLimits
from lalaloc_core.localise.images import PanoramaLimits

PREFIX = "LALALOC_"
_DEFAULT_BUNDLE = Path(__file__).resolve().parent.parent / "models" / "default"

Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Metres = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Settings(BaseSettings):
    """Every field is the variable `LALALOC_<FIELD NAME>`; build with `Settings.load()`.

    Units stand in the names: `_s` seconds, `_m` metres, `_bytes` bytes.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, env_ignore_empty=True, frozen=True, extra="forbid")

    data_dir: Path = Field(default=Path("data"), description="Folder of the database; created when missing.")
    database_url: str | None = Field(default=None, description="SQLAlchemy URL; by default SQLite in the data folder.")
    bundle: Path = Field(default=_DEFAULT_BUNDLE, description="Folder of the model bundle.")
    log_level: str = Field(
        default="info", pattern="^(debug|info|warning|error)$", description="Least level that is logged."
    )

    workers: int = Field(
        default=1, ge=0, le=64, description="LPO worker processes; 0 turns LPO off, answers end at VDR."
    )
    worker_threads: Count = Field(default=1, description="Torch threads of each LPO worker.")
    onnx_threads: int = Field(default=0, ge=0, description="onnxruntime threads per network, 0 for one per core.")
    compute_threads: Count = Field(default=2, description="Queries that are computed at the same time.")
    lpo_queue: Count = Field(default=16, description="LPO jobs that may wait for a worker; more are answered by VDR.")
    lpo_deadline_s: Seconds = Field(default=2.0, description="Longest wait for LPO before the VDR pose is the answer.")
    lpo_stall_s: Seconds = Field(default=10.0, description="An LPO worker busy with one job for longer is restarted.")

    request_deadline_s: Seconds = Field(default=10.0, description="Longest a query may take once it is uploaded.")
    upload_deadline_s: Seconds = Field(default=60.0, description="Longest an upload may take.")
    max_pending_requests: Count = Field(default=32, description="Uploads and queries in flight; more get a 503.")

    grid_step_m: float = Field(default=0.5, ge=0.1, le=5.0, description="Distance of the poses of a latent grid.")
    max_grid_poses: Count = Field(default=40_000, description="Poses that a plan's latent grid may have.")
    grid_cache_bytes: int = Field(default=256 * 2**20, ge=0, description="Latent grids kept in memory.")
    max_grids_per_plan: Annotated[int, Field(ge=2)] = Field(
        default=8, description="Stored latent grids (camera heights) per plan; the oldest on-demand one makes room."
    )

    max_floorplans: Count = Field(default=10_000, description="Stored floor plans.")
    max_plan_bytes: Count = Field(default=2 * 2**20, description="Upload of a floor plan.")
    max_rooms: Count = Field(default=500, description="Rooms per floor plan.")
    max_vertices: Annotated[int, Field(ge=3)] = Field(default=200, description="Vertices per room.")
    max_extent_m: Metres = Field(default=500.0, description="Width or height of a floor plan.")
    max_panorama_bytes: Count = Field(default=40 * 2**20, description="Upload of a panorama.")
    max_pixels: Count = Field(default=100_000_000, description="Pixels of a panorama.")

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
    def resolved_database_url(self) -> str:
        """The SQLAlchemy URL in use."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'lalaloc.sqlite3').resolve()}"

    @property
    def plan_limits(self) -> PlanLimits:
        """Limits of floor plans in the terms of the core."""
        return PlanLimits(
            max_rooms=self.max_rooms, max_vertices_per_room=self.max_vertices, max_extent_m=self.max_extent_m
        )

    @property
    def panorama_limits(self) -> PanoramaLimits:
        """Limits of panoramas in the terms of the core."""
        return PanoramaLimits(max_pixels=self.max_pixels)


def settings_table() -> str:
    """All settings as a Markdown table, for the documentation."""
    lines = ["| variable | default | meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = "`models/default`" if name == "bundle" else "" if field.default is None else f"`{field.default}`"
        lines.append(f"| `{PREFIX}{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines) + "\n"


def _describe(fault: Mapping[str, object]) -> str:
    location = fault["loc"]
    field = str(location[0]) if isinstance(location, tuple) and location else "?"
    return f"{PREFIX}{field.upper()} is {fault['input']!r}: {fault['msg']}"
