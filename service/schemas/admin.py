"""Administration: API keys, limits of tenants, audit log."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from service.schemas.fields import ResponseModel
from service.schemas.venues import Document, Name

# Name of a tenant; the command line, tokens and this API check the same.
TENANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
MAX_RATE = 10**6
# Longest lifetime of a key and longest overlap of two (s): ten years and ninety days.
MAX_LIFETIME_S, MAX_OVERLAP_S = 3660 * 86400, 90 * 86400
DEFAULT_OVERLAP_S = 7 * 86400

TenantName = Annotated[str, StringConstraints(pattern=rf"^{TENANT.pattern}$")]
ScopeName = Literal["metrics", "read", "localise", "write", "admin"]


class KeyDocument(Document):
    """New API key."""

    tenant: TenantName = Field(description="Tenant whose floor plans the key gives access to.")
    name: Name = Field(description="Name of the key, for your own records.")
    scopes: list[ScopeName] = Field(min_length=1, max_length=5, description="Scopes; none includes another.")
    rate_per_minute: int | None = Field(
        None, ge=0, le=MAX_RATE, description="Requests per minute; 0: no limit. Default: `LALALOC_RATE_PER_MINUTE`."
    )
    expires_in_s: int | None = Field(
        None, ge=1, le=MAX_LIFETIME_S, description="Lifetime of the key. Default: it has no end."
    )


class RotationDocument(Document):
    """Replacement of an API key."""

    overlap_s: int = Field(
        DEFAULT_OVERLAP_S, ge=0, le=MAX_OVERLAP_S, description="Time for which the old key stays valid beside the new."
    )


class KeyAnswer(ResponseModel):
    """API key without its secret, of which only a hash is stored."""

    id: str = Field(description="Id of the key: the part between its underscores.")
    tenant: str
    name: str
    scopes: list[str]
    rate_per_minute: int | None = Field(description="Requests per minute; null: the limit in the settings.")
    created_at: datetime
    expires_at: datetime | None = Field(description="The key is rejected from this time on.")
    revoked_at: datetime | None
    last_used_at: datetime | None = Field(description="Time of the last request, to the minute.")
    replaces: str | None = Field(description="Id of the key that this one replaces.")


class NewKeyAnswer(KeyAnswer):
    """New API key with its secret, which is not shown again."""

    key: str = Field(description="The key, to be sent as `Authorization: Bearer KEY`.")


class KeyList(ResponseModel):
    """Page of API keys, newest first."""

    keys: list[KeyAnswer]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class TenantLimitsDocument(Document):
    """Limits of a tenant; fields that are left out keep their value, null stands for the limit in the settings."""

    stored_bytes: int | None = Field(None, ge=0, le=2**63 - 1, description="Limit of stored bytes.")
    bytes_in_flight: int | None = Field(
        None, ge=0, le=2**63 - 1, description="Limit of the bytes of requests in progress."
    )
    cpu_share: float | None = Field(
        None, ge=0.01, le=100.0, description="Weight in queues: with 2 the tenant's CPU seconds count half."
    )


class TenantAnswer(ResponseModel):
    """Tenant with the limits that were set for it; null stands for the limit in the settings."""

    tenant: str
    used_bytes: int = Field(description="Stored bytes.")
    stored_bytes: int | None = Field(description="Limit of stored bytes.")
    bytes_in_flight: int | None = Field(description="Limit of the bytes of requests in progress.")
    cpu_share: float | None = Field(description="Weight in queues.")


class TenantList(ResponseModel):
    """Page of tenants that stored data or have limits of their own, by name."""

    tenants: list[TenantAnswer]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class AuditEntryAnswer(ResponseModel):
    """Action of a caller or of an operator, or several equal ones within a minute."""

    id: str
    created_at: datetime = Field(description="Time of the first of the actions.")
    actor: str = Field(
        description="Id of the API key, `oidc:` and the subject of a token, `cli:` and a user, or `anonymous`; "
        "`various` where there were too many in a minute."
    )
    tenant: str = Field(description="Tenant of the actor, or the tenant that an operator changed.")
    address: str = Field(description="Address of the client; empty on the command line and for various ones.")
    action: str = Field(description="Method and route, or the command.")
    resource: str = Field(description="Path of the resource; empty for various ones.")
    status: int | None = Field(description="HTTP status; null on the command line.")
    result: str = Field(description="`done`, or the kind of the problem.")
    count: int = Field(description="Number of equal actions within a minute.")
    request_id: str | None = Field(description="Id of the first request, as in the request log.")
    detail: dict[str, Any] | None = Field(description="Further facts, such as the scopes of a new key.")


class AuditList(ResponseModel):
    """Page of the audit log, newest first."""

    entries: list[AuditEntryAnswer]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")
