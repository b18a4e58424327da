"""IMDF 1.0 archives (Indoor Mapping Data Format): GeoJSON files by feature type, in a zip archive with a manifest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_text import read_json
from lalaloc_core.importers.formats.geojson import import_features, read_features
from lalaloc_core.importers.model.assemble import ImportedPlan
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.sketch import Level

FORMAT = "imdf"
_TAKEN = ("unit", "opening", "fixture", "kiosk")


def import_imdf(files: Mapping[str, bytes], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """One plan for every level of an archive, lowest first.

    Args:
        files: the archive's files by name.

    Raises:
        InvalidFloorPlanError: names the file and what is wrong.
    """
    by_type = {name.rpartition("/")[2].partition(".")[0].casefold(): name for name in files}
    if "unit" not in by_type:
        found = ", ".join(sorted(files)[:10]) or "no GeoJSON at all"
        raise InvalidFloorPlanError(f"the archive has no unit.geojson, it has {found}")
    features = []
    for kind in _TAKEN:
        if kind in by_type:
            document = _read(files, by_type[kind], budget)
            # The type stands in every feature by the standard, and in the file's name where a tool left it out.
            features += [
                replace(feature, says={"feature_type": kind} | dict(feature.says))
                for feature in read_features(document, budget)
            ]
    levels = _levels(_read(files, by_type["level"], budget)) if "level" in by_type else {}
    return import_features(features, None, FORMAT, options, budget, levels)


def _read(files: Mapping[str, bytes], name: str, budget: Budget) -> Any:
    try:
        return read_json(files[name], budget.limits.max_depth)
    except InvalidFloorPlanError as error:
        raise InvalidFloorPlanError(f"'{name[:100]}': {error.reason}") from error


def _levels(document: Any) -> dict[str, Level]:
    found: dict[str, Level] = {}
    features = document.get("features") if isinstance(document, Mapping) else None
    for feature in features if isinstance(features, list) else []:
        says = feature.get("properties") if isinstance(feature, Mapping) else None
        if not isinstance(says, Mapping) or not isinstance(feature.get("id"), str):
            continue
        ordinal = says.get("ordinal")
        number = float(ordinal) if isinstance(ordinal, int | float) and abs(ordinal) < 1e6 else None
        found[feature["id"]] = Level(_text(says.get("name")) or _text(says.get("short_name")) or f"{ordinal}", number)
    return found


def _text(value: Any) -> str | None:
    if isinstance(value, Mapping):
        value = value.get("en") or next(iter(value.values()), None)
    return value[:200] if isinstance(value, str) and value.strip() else None
