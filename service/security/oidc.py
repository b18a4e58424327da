"""Tokens of an OpenID Connect issuer: signed JSON Web Tokens (RFC 9068), checked with the issuer's published keys.

The keys are fetched at the first token and every ten minutes after it, aside from requests. A token with an unknown key
can bring a fetch forward, at most one per `_PAUSE_S`, however many such tokens arrive.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import httpx
from joserfc import jwt
from joserfc.errors import ClaimError, ExpiredTokenError, InvalidKeyIdError, JoseError, UnsupportedAlgorithmError
from joserfc.jwk import JWKRegistry, Key, KeySet, RSAKey
from joserfc.jws import JWSRegistry
from joserfc.jwt import JWTClaimsRegistry

from service.errors import IssuerUnavailableError, UnauthenticatedError
from service.schemas.admin import TENANT
from service.security.permissions import Identity, Permission
from service.settings.setting_groups import AccessSettings
from service.settings.setting_types import secure_url
from service.telemetry import LOGGER_NAME

# Signatures with public keys only: neither `none` nor shared secrets.
ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "Ed25519")
_TYPES = (None, "jwt", "at+jwt", "application/at+jwt")
SCOPE_PREFIX = "lalaloc:"
# Tolerance (s) between the clocks of issuer and service.
LEEWAY_S = 60
_DISCOVERY = "/.well-known/openid-configuration"
# Age (s) from which keys are fetched again, and from which they are not used any more.
_FRESH_S, _STALE_S = 600.0, 3600.0
# Minimum time (s) between two fetches.
_PAUSE_S = 10.0
# Limits of a fetch: time (s) of each step, time of both documents, and bytes of each.
_STEP_S, _FETCH_S, _MAX_BYTES = 5.0, 10.0, 256 * 1024
_MAX_KEYS, _MIN_RSA_BITS, _MAX_RSA_BITS = 100, 2048, 8192
_MAX_SUBJECT = 255
# Errors of the library for texts that are no tokens.
_MALFORMED = (JoseError, ValueError, TypeError, AttributeError, KeyError, RecursionError)


class _Registry(JWSRegistry):
    # Issuers can send chains of certificates along.
    max_header_length = 4096


class TokenVerifier:
    """Check of tokens; for one event loop.

    Args:
        settings: issuer, audience and names of claims.
        clock: current time for intervals, seconds.
        now: current time in seconds since 1970.
    """

    def __init__(
        self,
        settings: AccessSettings,
        *,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], float] = time.time,
    ) -> None:
        self._settings, self._clock, self._now = settings, clock, now
        self._registry = _Registry(algorithms=ALGORITHMS, strict_check_header=False)
        # Keys of the issuer, and when they were fetched.
        self._published: tuple[KeySet, float] | None = None
        self._tried_s = -float("inf")
        self._fetching: asyncio.Task[None] | None = None

    async def verify(self, token: str) -> Identity:
        """Return the holder of a token."""
        try:
            decoded = await self._decoded(token)
            self._check(decoded)
        except UnsupportedAlgorithmError as error:
            raise UnauthenticatedError(
                f"the token's algorithm is not one of {', '.join(ALGORITHMS)}; get another token from the issuer"
            ) from error
        except InvalidKeyIdError as error:
            raise UnauthenticatedError(
                "the token is signed with a key that the issuer does not publish; get a new one from the issuer"
            ) from error
        except ExpiredTokenError as error:
            raise UnauthenticatedError("the token has expired; get a new one from the issuer") from error
        except ClaimError as error:
            expected = {"iss": self._settings.oidc_issuer, "aud": self._settings.oidc_audience}.get(error.claim)
            reason = (
                f"must be '{expected}'"
                if expected
                else "is missing or not acceptable now; get a new one from the issuer"
            )
            raise UnauthenticatedError(f"the token's claim '{error.claim}' {reason}") from error
        except _MALFORMED as error:
            raise UnauthenticatedError(
                "the token is not a JSON Web Token with a valid signature; get a new one from the issuer"
            ) from error
        return self._identity(decoded.claims)

    async def _decoded(self, token: str) -> jwt.Token:
        """Return a token whose signature is valid."""
        keys = await self._keys()
        try:
            return jwt.decode(token, keys, registry=self._registry)
        except InvalidKeyIdError:
            # The issuer may have begun to use another key.
            renewed = await self._keys(renew=True)
            if renewed is keys:
                raise
            return jwt.decode(token, renewed, registry=self._registry)

    def _check(self, token: jwt.Token) -> None:
        kind = token.header.get("typ")
        if (kind.lower() if isinstance(kind, str) else kind) not in _TYPES:
            raise UnauthenticatedError("the token's type must be 'at+jwt' or 'JWT'; send an access token")
        registry = JWTClaimsRegistry(
            now=int(self._now()),
            leeway=LEEWAY_S,
            iss={"essential": True, "value": self._settings.oidc_issuer},
            aud={"essential": True, "value": self._settings.oidc_audience},
            exp={"essential": True},
            sub={"essential": True},
        )
        registry.validate(token.claims)

    def _identity(self, claims: Mapping[str, Any]) -> Identity:
        subject = claims["sub"]
        if len(subject) > _MAX_SUBJECT or not subject.isascii() or not subject.isprintable():
            raise UnauthenticatedError(
                f"the token's claim 'sub' must have up to {_MAX_SUBJECT} printable ASCII letters"
            )
        name = self._settings.oidc_tenant_claim
        tenant = _claim(claims, name)
        if not isinstance(tenant, str) or not TENANT.fullmatch(tenant):
            raise UnauthenticatedError(
                f"the token's claim '{name}' must be the name of a tenant: 1 to 64 letters, digits, '.', '_' and '-' "
                "(LALALOC_OIDC_TENANT_CLAIM)"
            )
        stated = _claim(claims, self._settings.oidc_scope_claim)
        scopes = stated.split() if isinstance(stated, str) else stated if isinstance(stated, list) else []
        granted = frozenset(scope for scope in Permission if SCOPE_PREFIX + scope in scopes)
        return Identity(f"oidc:{subject}", tenant, granted)

    async def _keys(self, *, renew: bool = False) -> KeySet:
        """Return the issuer's keys, with `renew` such that were fetched lately."""
        age_s = self._age_s()
        if renew or age_s >= _STALE_S:
            if (task := self._begin_fetch()) is not None:
                # Others wait for it too, so it outlasts the request.
                await asyncio.shield(task)
        elif age_s >= _FRESH_S:
            self._begin_fetch()
        if self._published is None or self._age_s() >= _STALE_S:
            raise IssuerUnavailableError()
        return self._published[0]

    def _age_s(self) -> float:
        return float("inf") if self._published is None else self._clock() - self._published[1]

    def _begin_fetch(self) -> asyncio.Task[None] | None:
        """Return a fetch in progress; None if the last one ended a moment ago."""
        if self._fetching is None or self._fetching.done():
            if self._clock() - self._tried_s < _PAUSE_S:
                return None
            self._fetching = asyncio.create_task(self._fetch())
        return self._fetching

    async def _fetch(self) -> None:
        try:
            self._published = await fetch_keys(self._settings.oidc_issuer), self._clock()
        except (httpx.HTTPError, OSError, ValueError, RecursionError) as error:
            fields = {"issuer": self._settings.oidc_issuer, "reason": f"{type(error).__name__}: {error}"[:300]}
            logging.getLogger(LOGGER_NAME).warning("fetching the issuer's keys failed", extra={"fields": fields})
        finally:
            self._tried_s = self._clock()


async def fetch_keys(issuer: str) -> KeySet:
    """Return the keys that an issuer publishes for signatures (OpenID Connect Discovery 1.0, RFC 8414)."""
    # Reads the certificates of authorities.
    tls = await asyncio.to_thread(httpx.create_ssl_context)
    # Without compression, so that the bytes on the wire bound those in memory.
    headers = {"Accept": "application/json", "Accept-Encoding": "identity"}
    try:
        async with asyncio.timeout(_FETCH_S), httpx.AsyncClient(verify=tls, timeout=_STEP_S, headers=headers) as client:
            document = await _json(client, issuer.rstrip("/") + _DISCOVERY)
            if document.get("issuer") != issuer:
                name = str(document.get("issuer"))[:200]
                raise ValueError(f"the issuer calls itself '{name}'; set LALALOC_OIDC_ISSUER to it")
            listed = (await _json(client, secure_url(str(document.get("jwks_uri"))))).get("keys")
    except TimeoutError as error:
        raise ValueError(f"the issuer answers for more than {_FETCH_S:g} s") from error
    except httpx.InvalidURL as error:
        raise ValueError(f"not a URL: {error}") from error
    if not isinstance(listed, list) or len(listed) > _MAX_KEYS:
        raise ValueError(f"the issuer must publish a list of up to {_MAX_KEYS} keys")
    keys = [key for key in map(_imported, listed) if key is not None]
    if not keys:
        raise ValueError("the issuer publishes no key for signatures")
    return KeySet(keys)


async def _json(client: httpx.AsyncClient, url: str) -> dict[str, Any]:
    content = bytearray()
    async with client.stream("GET", url) as response:
        if response.status_code != httpx.codes.OK:
            raise ValueError(f"{url} answers with status {response.status_code}")
        async for chunk in response.aiter_raw():
            content += chunk
            if len(content) > _MAX_BYTES:
                raise ValueError(f"{url} answers with more than {_MAX_BYTES} bytes")
    document = json.loads(content)
    if not isinstance(document, dict):
        raise ValueError(f"{url} is not a JSON object")
    return document


def _imported(parameters: object) -> Key | None:
    """Return a public key for signatures; None for other keys, such as those of unknown types."""
    if not isinstance(parameters, dict) or parameters.get("kty") not in ("RSA", "EC", "OKP"):
        return None
    if parameters.get("use", "sig") != "sig":
        return None
    try:
        key = JWKRegistry.import_key(parameters)
        if isinstance(key, RSAKey) and not _MIN_RSA_BITS <= key.raw_value.key_size <= _MAX_RSA_BITS:
            return None
    except _MALFORMED:
        return None
    return key


def _claim(claims: Mapping[str, Any], name: str) -> object:
    """Return a claim by its name, or by names of nested claims with dots between them."""
    if name in claims:
        return claims[name]
    value: object = claims
    for part in name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value
