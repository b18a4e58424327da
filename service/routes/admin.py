"""Administration over HTTP, for callers with the scope `admin`: API keys, limits of tenants, audit log."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime, timedelta
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response, status
from pydantic import AwareDatetime

from service.errors import InvalidRequestError, StoreFullError, UnknownKeyError
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import ApiCall, Call, Limit, Page, is_id
from service.routes.descriptions import BODY_ERRORS, READ_ERRORS, json_body
from service.schemas import admin as schemas
from service.security.audit import add_audit_detail
from service.security.keys import hash_of, key_text, new_secret
from service.storage.records import ApiKey, OperatorLimits, StoredAuditEntry

router = APIRouter(prefix="/admin", tags=["administration"])

# Lists, objects and items of a document.
_VALUES = 100
_CHANGE_ERRORS = (*READ_ERRORS, *BODY_ERRORS, StoreFullError)
OfTenant = Annotated[
    str | None, Query(pattern=f"^{schemas.TENANT.pattern}$", description="Only those of this tenant. Default: all.")
]


@router.get("/keys", summary="List API keys", responses=problem_responses(*READ_ERRORS))
def list_keys(call: Call, page: Page, tenant: OfTenant = None) -> schemas.KeyList:
    """List API keys without their secrets, newest first, including revoked and expired ones."""
    found, more = page.read(partial(call.store.keys.page, tenant=tenant))
    return schemas.KeyList(keys=[schemas.KeyAnswer(**_values(key)) for key in found], next_cursor=more)


@router.post(
    "/keys",
    status_code=status.HTTP_201_CREATED,
    summary="Create an API key",
    response_model=schemas.NewKeyAnswer,
    openapi_extra={"requestBody": json_body(schemas.KeyDocument)},
    responses=problem_responses(*_CHANGE_ERRORS),
)
async def create_key(call: Call) -> Response:
    """Create an API key for any tenant. The answer has the key, which cannot be shown again.

    If the answer is lost, revoke the key and create another one.
    """
    document, _ = await call.read_document(schemas.KeyDocument, _VALUES)

    def create() -> Response:
        secret = new_secret()
        key = call.store.keys.create(
            document.tenant,
            document.name,
            hash_of(secret),
            document.scopes,
            rate_per_minute=document.rate_per_minute,
            lifetime=None if document.expires_in_s is None else timedelta(seconds=document.expires_in_s),
        )
        return _new_key_answer(call, key, secret)

    return await call.upload(create)


@router.get("/keys/{key_id}", summary="Get an API key", responses=problem_responses(UnknownKeyError, *READ_ERRORS))
def get_key(key_id: str, call: Call) -> schemas.KeyAnswer:
    """Return an API key without its secret."""
    key = call.store.keys.get(key_id) if is_id(key_id) else None
    if key is None:
        raise UnknownKeyError(key_id, "")
    return schemas.KeyAnswer(**_values(key))


@router.post(
    "/keys/{key_id}/rotation",
    status_code=status.HTTP_201_CREATED,
    summary="Replace an API key",
    response_model=schemas.NewKeyAnswer,
    openapi_extra={"requestBody": json_body(schemas.RotationDocument)},
    responses=problem_responses(UnknownKeyError, *_CHANGE_ERRORS),
)
async def rotate_key(key_id: str, call: Call) -> Response:
    """Create a successor with the same tenant, name, scopes, rate and lifetime.

    The old key stays valid for `overlap_s`, so that programs can change to the new one.
    """
    document, _ = await call.read_document(schemas.RotationDocument, _VALUES)

    def rotate() -> Response:
        secret, overlap = new_secret(), timedelta(seconds=document.overlap_s)
        key = call.store.keys.rotate(key_id, hash_of(secret), overlap=overlap) if is_id(key_id) else None
        if key is None:
            raise UnknownKeyError(key_id, "valid ")
        return _new_key_answer(call, key, secret)

    return await call.upload(rotate)


@router.delete(
    "/keys/{key_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Revoke an API key",
    responses=problem_responses(UnknownKeyError, *READ_ERRORS),
)
def revoke_key(key_id: str, call: Call) -> None:
    """Revoke an API key for good; it is rejected within 5 s."""
    key = call.store.keys.revoke(key_id) if is_id(key_id) else None
    if key is None:
        raise UnknownKeyError(key_id, "unrevoked ")
    add_audit_detail(call.request, key.tenant, name=key.name)


@router.get("/tenants", summary="List tenants", responses=problem_responses(*READ_ERRORS))
def list_tenants(call: Call, limit: Limit = 100, cursor: OfTenant = None) -> schemas.TenantList:
    """List the tenants that stored data or have limits of their own, by name."""
    accounts = call.store.quota.accounts(after=cursor or "", limit=limit + 1)
    page = sorted(accounts)[:limit]
    limits = call.store.tenants.limits(page)
    tenants = [
        schemas.TenantAnswer(
            tenant=tenant, used_bytes=accounts[tenant].used.total, **asdict(limits.get(tenant, OperatorLimits()))
        )
        for tenant in page
    ]
    return schemas.TenantList(tenants=tenants, next_cursor=page[-1] if len(accounts) > limit else None)


@router.patch(
    "/tenants/{tenant}",
    summary="Set limits of a tenant",
    response_model=schemas.TenantAnswer,
    openapi_extra={"requestBody": json_body(schemas.TenantLimitsDocument)},
    responses=problem_responses(*_CHANGE_ERRORS),
)
async def limit_tenant(tenant: str, call: Call) -> schemas.TenantAnswer:
    """Set limits of a tenant, which need not have stored anything; in effect within 5 s."""
    if not schemas.TENANT.fullmatch(tenant):
        fault = "has 1 to 64 letters, digits, '.', '_' and '-', and begins with a letter or digit"
        raise InvalidRequestError([("tenant", f"is '{tenant[:64]}'; a tenant's name {fault}")])
    document, _ = await call.read_document(schemas.TenantLimitsDocument, _VALUES)
    changes = document.model_dump(exclude_unset=True)
    if not changes:
        raise InvalidRequestError([("body", "changes nothing; give stored_bytes, bytes_in_flight or cpu_share")])

    def change() -> schemas.TenantAnswer:
        limits = call.store.tenants.change_limits(tenant, **changes)
        add_audit_detail(call.request, tenant, **changes)
        used_bytes = call.store.quota.account(tenant).used.total
        return schemas.TenantAnswer(tenant=tenant, used_bytes=used_bytes, **asdict(limits))

    return await call.upload(change)


@router.get("/audit", summary="Read the audit log", responses=problem_responses(*READ_ERRORS))
def list_audit_entries(
    call: Call,
    page: Page,
    tenant: OfTenant = None,
    actor: Annotated[str | None, Query(max_length=300, description="Only entries of this actor.")] = None,
    since: Annotated[AwareDatetime | None, Query(description="Only entries from this time on.")] = None,
    until: Annotated[AwareDatetime | None, Query(description="Only entries before this time.")] = None,
) -> schemas.AuditList:
    """List changes, refusals and what administrators did, newest first.

    Entries are never changed; the oldest are deleted by `LALALOC_AUDIT_KEEP_S`, and beyond a million.
    Refusals, failed changes and reads of administrators are counted per minute; each replica adds its own.
    """
    if actor is not None and not actor.isprintable():
        raise InvalidRequestError([("actor", "must have printable characters only")])
    call.runtime.audit_trail.flush()
    times = {"since": _check_year("since", since), "until": _check_year("until", until)}
    found, more = page.read(partial(call.store.audit_log.page, tenant=tenant, actor=actor, **times))
    return schemas.AuditList(entries=[_audit_answer(entry) for entry in found], next_cursor=more)


def _new_key_answer(call: ApiCall, key: ApiKey, secret: str) -> Response:
    facts = {"scopes": sorted(key.scopes), "expires_at": key.expires_at, "replaces": key.replaces}
    add_audit_detail(call.request, key.tenant, id=key.id, name=key.name, **facts)
    answer = schemas.NewKeyAnswer(**_values(key), key=key_text(key.id, secret))
    path = call.path_of("get_key", key_id=key.id)
    return Response(answer.model_dump_json(), status.HTTP_201_CREATED, {"Location": path}, JSON)


def _values(key: ApiKey) -> dict[str, Any]:
    return asdict(key) | {"scopes": sorted(key.scopes)}


def _audit_answer(entry: StoredAuditEntry) -> schemas.AuditEntryAnswer:
    values: dict[str, Any] = asdict(entry)
    values["detail"] = None if entry.detail is None else json.loads(entry.detail)
    return schemas.AuditEntryAnswer(**values)


def _check_year(field: str, moment: datetime | None) -> datetime | None:
    """Return a time, unless databases cannot compare it."""
    if moment is not None and not 1970 <= moment.year < 9999:
        raise InvalidRequestError([(field, f"has the year {moment.year}; give one from 1970 to 9998")])
    return moment
