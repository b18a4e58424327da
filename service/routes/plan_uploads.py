"""Body of a plan upload: a plan file, alone or in a form with options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from pydantic import BaseModel

from lalaloc_core.errors import InvalidFloorPlanError, MissingExtraError, SeveralLevelsError
from lalaloc_core.importers import ImportOptions
from service.capacity.threads import Threads
from service.errors import (
    BytesInFlightError,
    ConverterNotReadyError,
    InvalidRequestError,
    MalformedRequestError,
    PlanTooLargeError,
    SpoolFullError,
    StorageQuotaError,
    StoreFullError,
    StoreUnavailableError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http.uploads import JSON, MULTIPART, Parts, UploadLimits, media_type, read_body, read_parts
from service.plan_files.plan_file import seems_native
from service.runtime import Runtime
from service.schemas import ImportForm, LevelsForm
from service.uploaded_file import UploadedFile

_FILE = "file"
# Media types that clients send; the actual format is detected from the content.
_FILES = (
    JSON,
    "application/geo+json",
    "application/zip",
    "application/pdf",
    "application/xml",
    "image/svg+xml",
    "image/png",
    "image/jpeg",
    "image/vnd.dxf",
    "application/dxf",
    "application/x-step",
    "application/octet-stream",
)
_BYTES = {"schema": {"type": "string", "format": "binary"}}
REFUSED_UPLOADS = (
    InvalidFloorPlanError,
    SeveralLevelsError,
    MissingExtraError,
    InvalidRequestError,
    PlanTooLargeError,
    MalformedRequestError,
    UnsupportedMediaError,
    UploadTooLargeError,
    UploadTimeoutError,
    BytesInFlightError,
    SpoolFullError,
    ConverterNotReadyError,
    StoreUnavailableError,
    StoreFullError,
    StorageQuotaError,
)


def _form_schema(form: type[BaseModel]) -> dict[str, Any]:
    schema = form.model_json_schema()
    schema["properties"][_FILE] = {
        "type": "string",
        "format": "binary",
        "description": "GeoJSON, an IMDF archive, OpenStreetMap (XML or Overpass JSON), a RoomPlan scan, SVG, DXF, IFC "
        "(also zipped), PDF, PNG, JPEG, or JSON in the native format (FloorPlanDocument). The format is detected from "
        "the content.",
    }
    schema["required"] = [_FILE]
    return schema


# Request body of both operations that take a plan.
UPLOAD_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        JSON: {"schema": {"$ref": "#/components/schemas/FloorPlanDocument"}},
        MULTIPART: {"schema": _form_schema(ImportForm)},
        **dict.fromkeys(_FILES[1:], _BYTES),
    },
}
# Form of an operation that takes a file with all its levels.
LEVELS_FORM: dict[str, Any] = {"schema": _form_schema(LevelsForm)}


@dataclass(frozen=True)
class PlanUpload:
    """Uploaded file with its options."""

    file: UploadedFile
    options: ImportOptions
    fields: Mapping[str, str]

    @property
    def parts(self) -> Parts:
        """The parts that identify the request for idempotency."""
        return Parts(dict(self.fields), {_FILE: self.file})

    def threads(self, runtime: Runtime) -> Threads:
        """Return the threads to read and store it on; files that wait for a worker have threads of their own."""
        return runtime.uploads if seems_native(self.file) else runtime.file_uploads


async def read_upload(request: Request, runtime: Runtime, form: type[BaseModel] = ImportForm) -> PlanUpload:
    """Read the file in a request, with its options.

    Args:
        request: the request.
        runtime: the service.
        form: known options.

    Raises:
        UnsupportedMediaError: the media type is not that of a plan file.
        UploadTooLargeError, UploadTimeoutError, MalformedRequestError: see `read_body` and `read_parts`.
        InvalidRequestError: a part or option is missing, unknown or invalid.
    """
    limits = UploadLimits.of(runtime.settings, "max_plan_bytes")
    if media_type(request, (MULTIPART, *_FILES)) != MULTIPART:
        return PlanUpload(await read_body(request, limits), ImportOptions(), {})
    known = set(form.model_fields)
    parts = await read_parts(request, limits, files={_FILE}, fields=known, check=_faults)
    return PlanUpload(parts.files[_FILE], ImportOptions.from_text(parts.fields), parts.fields)


def _faults(fields: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return (name, message) of invalid options, and of options that contradict each other."""
    faults = []
    for name, text in fields.items():
        try:
            ImportOptions.from_text({name: text})
        except InvalidFloorPlanError as error:
            faults.append((name, error.reason.removeprefix(f"{name} ")))
    if not faults:
        try:
            ImportOptions.from_text(fields)
        except InvalidFloorPlanError as error:
            faults.append(("scale", error.reason))
    return faults
