"""Image encoder of the model, for devices that encode photographs themselves."""

from __future__ import annotations

from collections.abc import AsyncIterator
from hashlib import sha256
from pathlib import Path

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from lalaloc_core.bundle import MANIFEST_NAME
from lalaloc_core.localise.encode.features import DEVICE_FILES, device_manifest
from service.errors import InvalidRequestError, UnknownModelFileError
from service.http.conditional import digest_etag, not_modified, tagged_answer, tagged_stream
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import CONDITIONAL, file_response

router = APIRouter(prefix="/model", tags=["localisation"])
_BINARY = "application/octet-stream"
_CHUNK_BYTES = 2**20


@router.get(
    "/{file}",
    summary="Get a file of the image encoder",
    response_class=Response,
    openapi_extra=CONDITIONAL,
    responses=file_response("*/*") | problem_responses(UnknownModelFileError, InvalidRequestError),
)
async def get_model_file(file: str, call: Call) -> Response:
    """Return a file with which a device computes features: `manifest.json`, `image_encoder.onnx`, `view_encoder.onnx`.

    The manifest has sizes and digests of the files, and no more of the model than its image encoder needs.
    """
    bundle = call.runtime.bundle
    manifest = bundle.manifest
    if file == MANIFEST_NAME:
        content = device_manifest(manifest).to_json().encode()
        etag = digest_etag(sha256(content).hexdigest())
        return not_modified(call.request, etag) or tagged_answer([content], JSON, etag)
    entry = manifest.files.get(file)
    if file not in DEVICE_FILES or entry is None:
        raise UnknownModelFileError(file, manifest.name)
    etag = digest_etag(entry.sha256)
    if (answer := not_modified(call.request, etag)) is not None:
        return answer
    chunks = _chunks(bundle.folder / file, call)
    return tagged_stream(chunks, entry.bytes, _BINARY, etag)


async def _chunks(path: Path, call: ApiCall) -> AsyncIterator[bytes]:
    """Yield a file until the client has gone. Clients check the digest, so an altered file is noticed there."""
    with path.open("rb") as opened:
        while not await call.request.is_disconnected():
            async with call.reading():
                chunk = await run_in_threadpool(opened.read, _CHUNK_BYTES)
            if not chunk:
                return
            yield chunk
