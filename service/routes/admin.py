"""Administration over HTTP, for callers with the scope `admin`: API keys, limits of tenants, audit log."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime, timedelta
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, Response, status
from pydantic import AwareDatetime, BaseModel

from service.errors import (
    BytesInFlightError,
    InvalidRequestError,
    MalformedRequestError,
    SpoolFullError,
    StoreFullError,
    StoreUnavailableError,
    UnknownKeyError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http.cursors import cursor_text, parse_cursor
from service.http.fields import parse_document
from service.http.problems import problem_responses
from service.http.uploads import JSON, UploadLimits, media_type, read_body
from service.routes.dependencies import Client, Running, is_id
from service.runtime import Runtime
from service.schemas import (
    AuditEntryAnswer,
    AuditList,
    KeyAnswer,
    KeyDocument,
    KeyList,
    NewKeyAnswer,
    RotationDocument,
    TenantAnswer,
    TenantLimitsDocument,
    TenantList,
)
from service.schemas.admin import TENANT
from service.security.audit import add_audit_detail
from service.security.keys import hash_of, key_text, new_secret
from service.storage.records import ApiKey, Cursor, OperatorLimits, StoredAuditEntry

router = APIRouter(prefix="/admin", tags=["administration"])

_MAX_LISTED = 500
# Lists, objects and items of a document.
_VALUES = 100
_READ_ERRORS = (InvalidRequestError, StoreUnavailableError)
_BODY_ERRORS = (
    *_READ_ERRORS,
    MalformedRequestError,
    UnsupportedMediaError,
    UploadTooLargeError,
    UploadTimeoutError,
    BytesInFlightError,
    SpoolFullError,
    StoreFullError,
)
Document = TypeVar("Document", bound=BaseModel)
Limit = Annotated[int, Query(ge=1, le=_MAX_LISTED, description="Maximum number of items.")]
After = Annotated[str | None, Query(description="`next_cursor` of the previous page.")]
OfTenant = Annotated[
    str | None, Query(pattern=f"^{TENANT.pattern}$", description="Only those of this tenant. Default: all.")
]


def _body(model: type[BaseModel]) -> dict[str, Any]:
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    return {"requestBody": {"required": True, "content": {JSON: {"schema": schema}}}}


@router.get("/keys", summary="List API keys", responses=problem_responses(*_READ_ERRORS))
def list_keys(runtime: Running, tenant: OfTenant = None, limit: Limit = 100, cursor: After = None) -> KeyList:
    """List API keys without their secrets, newest first, including revoked and expired ones."""
    after = None if cursor is None else parse_cursor(cursor)
    found = runtime.store.keys.page(limit=limit + 1, after=after, tenant=tenant)
    page = found[:limit]
    more = cursor_text(Cursor(page[-1].created_at, page[-1].id)) if len(found) > limit else None
    return KeyList(keys=[KeyAnswer(**_values(key)) for key in page], next_cursor=more)


@router.post(
    "/keys",
    status_code=status.HTTP_201_CREATED,
    summary="Create an API key",
    response_model=NewKeyAnswer,
    openapi_extra=_body(KeyDocument),
    responses=problem_responses(*_BODY_ERRORS),
)
async def create_key(request: Request, runtime: Running, client: Client) -> Response:
    """Create an API key for any tenant. The answer has the key, which cannot be shown again.

    If the answer is lost, revoke the key and create another one.
    """
    document = await _document(request, runtime, client, KeyDocument)

    def create() -> Response:
        secret = new_secret()
        key = runtime.store.keys.create(
            document.tenant,
            document.name,
            hash_of(secret),
            document.scopes,
            rate_per_minute=document.rate_per_minute,
            lifetime=None if document.expires_in_s is None else timedelta(seconds=document.expires_in_s),
        )
        return _created(request, key, secret)

    return await runtime.uploads.run(client, create)


@router.get("/keys/{key_id}", summary="Get an API key", responses=problem_responses(UnknownKeyError, *_READ_ERRORS))
def get_key(key_id: str, runtime: Running) -> KeyAnswer:
    """Return an API key without its secret."""
    key = runtime.store.keys.get(key_id) if is_id(key_id) else None
    if key is None:
        raise UnknownKeyError(key_id)
    return KeyAnswer(**_values(key))


@router.post(
    "/keys/{key_id}/rotation",
    status_code=status.HTTP_201_CREATED,
    summary="Replace an API key",
    response_model=NewKeyAnswer,
    openapi_extra=_body(RotationDocument),
    responses=problem_responses(UnknownKeyError, *_BODY_ERRORS),
)
async def rotate_key(key_id: str, request: Request, runtime: Running, client: Client) -> Response:
    """Create a successor with the same tenant, name, scopes, rate and lifetime.

    The old key stays valid for `overlap_s`, so that programs can change to the new one.
    """
    document = await _document(request, runtime, client, RotationDocument)

    def rotate() -> Response:
        secret, overlap = new_secret(), timedelta(seconds=document.overlap_s)
        key = runtime.store.keys.rotate(key_id, hash_of(secret), overlap=overlap) if is_id(key_id) else None
        if key is None:
            raise UnknownKeyError(key_id, "valid ")
        return _created(request, key, secret)

    return await runtime.uploads.run(client, rotate)


@router.delete(
    "/keys/{key_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Revoke an API key",
    responses=problem_responses(UnknownKeyError, *_READ_ERRORS),
)
def revoke_key(key_id: str, request: Request, runtime: Running) -> None:
    """Revoke an API key for good; it is rejected within `LALALOC_KEY_CACHE_S`."""
    key = runtime.store.keys.revoke(key_id) if is_id(key_id) else None
    if key is None:
        raise UnknownKeyError(key_id, "unrevoked ")
    add_audit_detail(request, key.tenant, name=key.name)


@router.get("/tenants", summary="List tenants", responses=problem_responses(*_READ_ERRORS))
def list_tenants(runtime: Running, limit: Limit = 100, cursor: OfTenant = None) -> TenantList:
    """List the tenants that stored data or have limits of their own, by name."""
    accounts = runtime.store.quota.accounts(after=cursor or "", limit=limit + 1)
    page = sorted(accounts)[:limit]
    limits = runtime.store.tenants.limits(page)
    tenants = [
        TenantAnswer(
            tenant=tenant, used_bytes=accounts[tenant].used.total, **asdict(limits.get(tenant, OperatorLimits()))
        )
        for tenant in page
    ]
    return TenantList(tenants=tenants, next_cursor=page[-1] if len(accounts) > limit else None)


@router.patch(
    "/tenants/{tenant}",
    summary="Set limits of a tenant",
    response_model=TenantAnswer,
    openapi_extra=_body(TenantLimitsDocument),
    responses=problem_responses(*_BODY_ERRORS),
)
async def limit_tenant(tenant: str, request: Request, runtime: Running, client: Client) -> TenantAnswer:
    """Set limits of a tenant, which need not have stored anything; in effect within `LALALOC_SWEEP_S`."""
    if not TENANT.fullmatch(tenant):
        fault = "has 1 to 64 letters, digits, '.', '_' and '-', and begins with a letter or digit"
        raise InvalidRequestError([("tenant", f"is '{tenant[:64]}'; a tenant's name {fault}")])
    document = await _document(request, runtime, client, TenantLimitsDocument)
    changes = document.model_dump(exclude_unset=True)
    if not changes:
        raise InvalidRequestError([("body", "changes nothing; give stored_bytes, bytes_in_flight or cpu_share")])

    def change() -> TenantAnswer:
        limits = runtime.store.tenants.change_limits(tenant, **changes)
        add_audit_detail(request, tenant, **changes)
        used_bytes = runtime.store.quota.account(tenant).used.total
        return TenantAnswer(tenant=tenant, used_bytes=used_bytes, **asdict(limits))

    return await runtime.uploads.run(client, change)


@router.get("/audit", summary="Read the audit log", responses=problem_responses(*_READ_ERRORS))
def list_audit_entries(
    runtime: Running,
    tenant: OfTenant = None,
    actor: Annotated[str | None, Query(max_length=300, description="Only entries of this actor.")] = None,
    since: Annotated[AwareDatetime | None, Query(description="Only entries from this time on.")] = None,
    until: Annotated[AwareDatetime | None, Query(description="Only entries before this time.")] = None,
    limit: Limit = 100,
    cursor: After = None,
) -> AuditList:
    """List changes, refusals and what administrators did, newest first.

    Entries are never changed; the oldest are deleted by `LALALOC_AUDIT_KEEP_S` and `LALALOC_MAX_AUDIT_ENTRIES`.
    Refusals, failed changes and reads of administrators are counted per minute; each replica adds its own.
    """
    after = None if cursor is None else parse_cursor(cursor)
    if actor is not None and not actor.isprintable():
        raise InvalidRequestError([("actor", "must have printable characters only")])
    runtime.audit_trail.flush()
    found = runtime.store.audit_log.page(
        limit=limit + 1,
        after=after,
        tenant=tenant,
        actor=actor,
        since=_checked("since", since),
        until=_checked("until", until),
    )
    page = found[:limit]
    more = cursor_text(Cursor(page[-1].created_at, page[-1].id)) if len(found) > limit else None
    return AuditList(entries=[_audit_answer(entry) for entry in page], next_cursor=more)


async def _document(request: Request, runtime: Runtime, client: str, model: type[Document]) -> Document:
    media_type(request, (JSON,))
    content = await read_body(request, UploadLimits.of(runtime.settings, "max_venue_bytes"))
    return await runtime.uploads.run(client, parse_document, model, content.read(), _VALUES)


def _created(request: Request, key: ApiKey, secret: str) -> Response:
    facts = {"scopes": sorted(key.scopes), "expires_at": key.expires_at, "replaces": key.replaces}
    add_audit_detail(request, key.tenant, id=key.id, name=key.name, **facts)
    answer = NewKeyAnswer(**_values(key), key=key_text(key.id, secret))
    path = str(request.app.url_path_for("get_key", key_id=key.id))
    return Response(answer.model_dump_json(), status.HTTP_201_CREATED, {"Location": path}, JSON)


def _values(key: ApiKey) -> dict[str, Any]:
    return asdict(key) | {"scopes": sorted(key.scopes)}


def _audit_answer(entry: StoredAuditEntry) -> AuditEntryAnswer:
    values: dict[str, Any] = asdict(entry)
    values["detail"] = None if entry.detail is None else json.loads(entry.detail)
    return AuditEntryAnswer(**values)


def _checked(field: str, moment: datetime | None) -> datetime | None:
    """Return a time, unless databases cannot compare it.

    Raises:
        InvalidRequestError: the time is out of range.
    """
    if moment is not None and not 1970 <= moment.year < 9999:
        raise InvalidRequestError([(field, f"has the year {moment.year}; give one from 1970 to 9998")])
    return moment
