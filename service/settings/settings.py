"""Settings of the service, read once from environment variables that start with `LALALOC_`.

`setting_groups.py` defines them in groups: `LALALOC_LPO_DEADLINE_S` is `settings.lpo.deadline_s`.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from lalaloc_core.bundle import default_bundle
from lalaloc_core.errors import ConfigError
from service.capacity.cores import CoreShares, share_cores, usable_cores
from service.capacity.fair_share import with_headroom
from service.settings import setting_groups as groups

PREFIX = "LALALOC_"
_DEFAULT_BUNDLE = default_bundle().resolve()

# Uploads in addition to the queries in progress, unless LALALOC_MAX_PENDING_REQUESTS is set.
_DEFAULT_UPLOADS = 38

# Photographs of a sequence within the time limits of one query.
_PHOTOGRAPHS_PER_LIMIT = 10

# A film's frames have the time of as many photographs.
FILM_PHOTOGRAPHS = 40

# Settings of earlier versions, besides those that are constants now. A variable of one is ignored with a warning.
_REMOVED_NAMES = (
    "decode_queue head_deadline_s import_deadline_s import_queue import_stall_s max_grids_per_plan plan_cache_age_s "
    "refused_keys_per_minute stream_deadline_s"
)
_REMOVED = frozenset(_REMOVED_NAMES.split())


# Earlier names of settings, which stay valid.
EARLIER_NAMES = {"max_panorama_bytes": "max_photograph_bytes", "max_sequence_panoramas": "max_sequence_photographs"}


class Settings(BaseModel):
    """Service.

    `Settings.load()` reads the environment. `Settings(workers=4)` sets values by variable name, in lower case and
    without `LALALOC_`; the others keep their defaults.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    data_dir: Path = Field(
        default=Path("data"), description="Folder of the data and the SQLite database; in the image `/data`, a volume."
    )
    bundle: Path = Field(default=_DEFAULT_BUNDLE, description="Model bundle; in the image `/app/models/default`.")
    log_level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="Minimum log level.")
    otlp_endpoint: str | None = Field(
        default=None,
        pattern="^https?://[^/]+",
        description="URL of an OpenTelemetry collector, `http://collector:4318/v1/traces`, for spans of requests and "
        "their stages. Needs the extra `otel`.",
    )
    database: groups.DatabaseSettings = groups.DatabaseSettings()
    compute: groups.ComputeSettings = groups.ComputeSettings()
    lpo: groups.LpoSettings = groups.LpoSettings()
    decode: groups.DecodeSettings = groups.DecodeSettings()
    imports: groups.ImportSettings = groups.ImportSettings()
    access: groups.AccessSettings = groups.AccessSettings()
    uploads: groups.UploadSettings = groups.UploadSettings()
    requests: groups.RequestSettings = groups.RequestSettings()
    grids: groups.GridSettings = groups.GridSettings()
    storage: groups.StorageSettings = groups.StorageSettings()
    plans: groups.PlanSettings = groups.PlanSettings()
    photographs: groups.PhotographSettings = groups.PhotographSettings()

    def __init__(self, **values: Any) -> None:
        """Check the values.

        Raises:
            ConfigError: an unknown name, a setting under two names, or a value outside its limits.
        """
        for earlier in values.keys() & EARLIER_NAMES.keys():
            name = EARLIER_NAMES[earlier]
            if name in values:
                raise ConfigError(
                    f"{_variable(earlier)} is the earlier name of {_variable(name)}; set only one of them"
                )
            values[name] = values.pop(earlier)
        paths = {name: path for name, path, _ in _fields()}
        if unknown := sorted(values.keys() - paths.keys()):
            known = ", ".join(sorted(_variable(name) for name in paths))
            raise ConfigError(f"unknown setting {', '.join(map(_variable, unknown))}; known: {known}")
        nested: dict[str, Any] = {}
        for name, value in values.items():
            *group, field = paths[name]
            (nested.setdefault(group[0], {}) if group else nested)[field] = value
        try:
            super().__init__(**nested)
        except ValidationError as error:
            names: dict[tuple[int | str, ...], str] = {path: name for name, path, _ in _fields()}
            faults = []
            for fault in error.errors():
                # The check of a whole group names the variables in its message.
                message, name = fault["msg"].removeprefix("Value error, "), names.get(fault["loc"])
                faults.append(message if name is None else f"{_variable(name)} is {fault['input']!r}: {message}")
            raise ConfigError("; ".join(faults)) from error

    @classmethod
    def load(cls) -> Self:
        """Read the settings from the environment; an empty variable counts as not set.

        Raises:
            ConfigError: an unknown `LALALOC_` variable, or a value outside its limits.
        """
        given = {name.upper(): value for name, value in os.environ.items() if name.upper().startswith(PREFIX) and value}
        values = {name.removeprefix(PREFIX).lower(): value for name, value in given.items()}
        for name in sorted(values.keys() & (_REMOVED | CONSTANTS.keys())):
            logging.getLogger("lalaloc").warning("%s is ignored: this setting was removed", _variable(name))
            del values[name]
        return cls(**values)

    def value(self, name: str) -> Any:
        """Return a setting by variable name, in lower case and without `LALALOC_`, or a constant beside the settings.

        Earlier names are read, too.
        """
        name = EARLIER_NAMES.get(name, name)
        return attrgetter(".".join(_PATHS.get(name) or CONSTANTS[name]))(self)

    def values(self) -> dict[str, Any]:
        """Return the value of every setting by variable name."""
        return {name: self.value(name) for name in _PATHS}

    def with_values(self, **values: Any) -> Self:
        """Return a copy with some values changed; names as in the constructor."""
        return type(self)(**(self.values() | values))

    @property
    def cores(self) -> CoreShares:
        """Cores of each component, with defaults resolved."""
        return share_cores(usable_cores(), **self.compute.model_dump())

    @property
    def pending_limit(self) -> int:
        """Limit of uploads and queries in progress, with its default resolved."""
        return self.requests.max_pending_requests or self.query_limit + _DEFAULT_UPLOADS

    @property
    def query_limit(self) -> int:
        """Limit of queries in progress, with its default resolved."""
        return self.requests.max_queries or with_headroom(2 * (self.cores.workers + self.cores.compute_threads))

    @property
    def sequence_deadline_s(self) -> float:
        """Timeout for the longest sequence query, or query about a film, after its upload."""
        photographs, limit_s = self.photographs, self.requests.request_deadline_s
        film_s = limit_s * work_factor(FILM_PHOTOGRAPHS) + photographs.film_deadline_s
        return max(limit_s * work_factor(photographs.max_sequence_photographs), film_s)

    @property
    def database_url(self) -> str:
        """The SQLAlchemy URL in use."""
        return self.database.url or f"sqlite:///{(self.data_dir / 'lalaloc.sqlite3').resolve()}"


def work_factor(photographs: int) -> float:
    """Return the time limits of a query of several photographs, in units of those of one query."""
    return max(photographs / _PHOTOGRAPHS_PER_LIMIT, 1.0)


def settings_table() -> str:
    """Return all settings as Markdown: a heading and a table per group."""
    lines: list[str] = []
    heading = ""
    for name, path, field in _fields():
        group = Settings if len(path) == 1 else type(Settings.model_fields[path[0]].default)
        if heading != (heading := (group.__doc__ or "").split("\n")[0].rstrip(".")):
            lines += ["", f"## {heading}", "", "| variable | default | meaning |", "|---|---|---|"]
        default = (
            "`models/default`" if name == "bundle" else "" if field.default in (None, "") else f"`{field.default}`"
        )
        lines.append(f"| `{_variable(name)}` | {default} | {field.description} |")
    return "\n".join(lines[1:])


def _fields() -> Iterator[tuple[str, tuple[str, ...], FieldInfo]]:
    """Yield the name, the path of attributes and the field of every setting."""
    for name, field in Settings.model_fields.items():
        if isinstance(field.default, groups.SettingGroup):
            for inner, inner_field in type(field.default).model_fields.items():
                yield field.default.prefix + inner, (name, inner), inner_field
        else:
            yield name, (name,), field


# Attributes of all settings by name, in lower case and without `LALALOC_`.
_PATHS = {name: path for name, path, _ in _fields()}
SETTING_NAMES = frozenset(_PATHS)
# Attributes of the constants beside the settings, by names of the same kind.
CONSTANTS = {
    field.default.prefix + inner: (name, inner)
    for name, field in Settings.model_fields.items()
    if isinstance(field.default, groups.SettingGroup)
    for inner in type(field.default).__class_vars__ - {"prefix"}
}


def _variable(name: str) -> str:
    return PREFIX + name.upper()
