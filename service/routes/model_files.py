"""Image encoder of the model, for devices that encode photographs themselves."""

from __future__ import annotations

import gzip
import os
from collections.abc import AsyncIterator
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from lalaloc_core.bundle import MANIFEST_NAME
from lalaloc_core.localise.encode.features import DEVICE_FILES, device_manifest
from service.errors import ChangedModelFileError, InvalidRequestError, RangeError, UnknownModelFileError
from service.http.problems import problem_responses
from service.http.representations import byte_range, digest_etag, not_modified, tagged_answer, tagged_stream
from service.http.uploads import JSON, on_request_end
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import PARTIAL, PARTIAL_CONTENT, reads_file

router = APIRouter(prefix="/model", tags=["localisation"])
_BINARY = "application/octet-stream"
_CHUNK_BYTES = 2**20
# Ending of the name of a file as it is packed for browsers: its even bytes and then its odd ones, compressed. Weights
# of half precision are a seventh smaller so, and a tenth if they are compressed as they are.
_PACKED = ".planes.gz"


@router.get(
    "/{file}",
    summary="Get a file of the image encoder",
    **reads_file(
        "*/*",
        parameters=PARTIAL,
        responses=PARTIAL_CONTENT
        | problem_responses(UnknownModelFileError, InvalidRequestError, RangeError, ChangedModelFileError),
    ),
)
async def get_model_file(file: str, call: Call) -> Response:
    """Return a file with which a device computes features: `manifest.json`, `image_encoder.onnx`, `view_encoder.onnx`.

    The manifest has sizes and digests of the files, and no more of the model than its image encoder needs. `Range`
    resumes the download of a file. With `.planes.gz` after its name, a network is smaller: gzip of its even bytes and
    then its odd ones, without `Range`.
    """
    bundle = call.runtime.bundle
    manifest = bundle.manifest
    if file == MANIFEST_NAME:
        content = device_manifest(manifest).to_json().encode()
        etag = digest_etag(sha256(content).hexdigest())
        return not_modified(call.request, etag) or tagged_answer([content], JSON, etag)
    name = file.removesuffix(_PACKED)
    entry = manifest.files.get(name)
    if name not in DEVICE_FILES or entry is None:
        raise UnknownModelFileError(file, manifest.name)
    etag = digest_etag(entry.sha256 if file == name else sha256(f"{entry.sha256}{_PACKED}".encode()).hexdigest())
    if (answer := not_modified(call.request, etag)) is not None:
        return answer
    if file != name:
        async with call.reading():
            packed = await run_in_threadpool(_packed, bundle.folder / name, entry.bytes, entry.sha256)
        return tagged_answer([packed], _BINARY, etag)
    wanted = byte_range(call.request, etag, entry.bytes)
    async with call.reading():
        opened = await run_in_threadpool(_open, bundle.folder / file, entry.bytes)
    on_request_end(call.request.scope, opened.close)
    headers, status = {"Accept-Ranges": "bytes"}, 200
    if wanted is None:
        wanted = range(entry.bytes)
    else:
        headers["Content-Range"], status = f"bytes {wanted.start}-{wanted.stop - 1}/{entry.bytes}", 206
    return tagged_stream(_chunks(opened, wanted, call), len(wanted), _BINARY, etag, headers, status)


def _open(path: Path, size_bytes: int) -> BinaryIO:
    try:
        opened = path.open("rb")
    except OSError as error:
        raise ChangedModelFileError(path.name) from error
    if os.fstat(opened.fileno()).st_size != size_bytes:
        opened.close()
        raise ChangedModelFileError(path.name)
    return opened


@lru_cache(maxsize=3)
def _packed(path: Path, size_bytes: int, digest: str) -> bytes:
    """Return a file of the model as it is packed for browsers; it is kept, so it must be undamaged."""
    with _open(path, size_bytes) as opened:
        content = opened.read()
    if sha256(content).hexdigest() != digest:
        raise ChangedModelFileError(path.name)
    return gzip.compress(content[::2] + content[1::2], mtime=0)


async def _chunks(opened: BinaryIO, wanted: range, call: ApiCall) -> AsyncIterator[bytes]:
    """Yield bytes of a file until the client has gone. Clients check the digest, so they notice altered files."""
    position = wanted.start
    while position < wanted.stop and not await call.request.is_disconnected():
        async with call.reading():
            chunk = await run_in_threadpool(_read, opened, position, min(_CHUNK_BYTES, wanted.stop - position))
        if not chunk:
            raise ChangedModelFileError(os.path.basename(opened.name))
        position += len(chunk)
        yield chunk


def _read(opened: BinaryIO, position: int, size_bytes: int) -> bytes:
    opened.seek(position)
    return opened.read(size_bytes)
