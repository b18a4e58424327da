"""Tokens of OpenID Connect issuers: a certified one that runs here, and one that answers and signs anything."""

from __future__ import annotations

import asyncio
import base64
import hmac
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx
import pytest
from joserfc import jwt
from joserfc.jwk import ECKey, JWKRegistry, Key, OctKey, OKPKey, RSAKey
from joserfc.jws import JWSRegistry
from joserfc.jwt import JWTClaimsRegistry

from lalaloc_core.errors import ConfigError
from service.errors import IssuerUnavailableError, UnauthenticatedError
from service.security import access_control, oidc
from service.security.oidc import TokenVerifier
from service.security.permissions import Identity, Permission
from service.settings import Settings
from service.storage.store import Store
from tests.local_servers import QuietHandler, free_port, http_server
from tests.service.conftest import FLAT, StartApp, assert_problem, wait_for
from tests.service.test_security import bearer, make_key

ISSUER = Path(__file__).parent / "issuer"
AUDIENCE = "https://lalaloc.example"


def _rsa(kid: str, bits: int = 2048) -> RSAKey:
    return RSAKey.generate_key(bits, {"kid": kid, "use": "sig", "alg": "RS256"})


FIRST, SECOND = _rsa("first"), _rsa("second")


# --- A certified issuer -----------------------------------------------------------------------------------------------

needs_node = pytest.mark.skipif(
    shutil.which("node") is None or not (ISSUER / "node_modules").is_dir(),
    reason="needs Node, and `npm ci` in tests/service/issuer",
)


class NodeIssuer:
    """The npm package `oidc-provider`, which is certified by the OpenID Foundation."""

    def __init__(self, port: int, *keys: RSAKey) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self.fetched = 0
        command = ["node", "issuer.mjs", str(port)]
        self._process = subprocess.Popen(
            command, cwd=ISSUER, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"keys": [key.as_dict(private=True) for key in keys]}))
        self._process.stdin.close()
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        assert self._ready.wait(60.0), "the issuer did not start"

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.fetched += "jwks" in line
            if line.startswith("ready"):
                self._ready.set()

    def token(self, *scopes: str) -> str:
        """Return a token by client credentials."""
        form = {"grant_type": "client_credentials", "scope": " ".join(scopes), "resource": AUDIENCE}
        answer = httpx.post(f"{self.url}/token", data=form, auth=("robot", "robot%27s%20secret"))
        return answer.raise_for_status().json()["access_token"]

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()


@contextmanager
def node_issuer(port: int, *keys: RSAKey) -> Iterator[NodeIssuer]:
    issuer = NodeIssuer(port, *keys)
    try:
        yield issuer
    finally:
        issuer.stop()


def _with_issuer(url: str) -> dict[str, Any]:
    return {"api_keys": True, "oidc_issuer": url, "oidc_audience": AUDIENCE}


@needs_node
@pytest.mark.one_replica
def test_tokens_of_a_certified_issuer(start_app: StartApp, app_store: Store, tmp_path: Path) -> None:
    with node_issuer(free_port(), FIRST) as issuer, start_app(tmp_path, **_with_issuer(issuer.url)) as client:
        reader, admin = issuer.token("lalaloc:read"), issuer.token("lalaloc:admin", "lalaloc:write")
        assert client.get("/usage", headers=bearer(reader)).json()["tenant"] == "acme"
        response = client.post("/floorplans", json=FLAT, headers=bearer(reader))
        assert "'write'; it has: read." in assert_problem(response, 403, "insufficient-scope")["detail"]
        assert client.post("/floorplans", json=FLAT, headers=bearer(admin)).status_code == 201
        # Keys work beside tokens.
        assert client.get("/limits", headers=bearer(make_key(app_store))).status_code == 200
        entries = client.get("/admin/audit", headers=bearer(admin)).json()["entries"]
        found = {(entry["actor"], entry["tenant"], entry["action"], entry["result"]) for entry in entries}
        results = ("done", "insufficient-scope")
        assert {("oidc:robot", "acme", "POST /floorplans", result) for result in results} <= found
        changed = reader[:-4] + ("AAAA" if reader[-4:] != "AAAA" else "BBBB")
        assert_problem(client.get("/usage", headers=bearer(changed)), 401, "unauthenticated")
        assert issuer.fetched == 1


@needs_node
@pytest.mark.one_replica
def test_issuer_rotates_its_keys(start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oidc, "_PAUSE_S", 0.2)
    port = free_port()
    with start_app(tmp_path, **_with_issuer(f"http://127.0.0.1:{port}")) as client:

        def status(token: str) -> int:
            return client.get("/limits", headers=bearer(token)).status_code

        unavailable = client.get("/limits", headers=bearer(_signed(FIRST, {"iss": f"http://127.0.0.1:{port}"})))
        assert_problem(unavailable, 503, "issuer-unavailable")
        assert "retry-after" in unavailable.headers
        with node_issuer(port, FIRST) as issuer:
            old = issuer.token("lalaloc:read")
            wait_for(lambda: status(old) == 200)
        # The keys are kept while the issuer is away.
        assert status(old) == 200
        with node_issuer(port, SECOND) as issuer:
            new = issuer.token("lalaloc:read")
            wait_for(lambda: status(new) == 200)
            assert status(old) == 401


# --- An issuer that answers anything ----------------------------------------------------------------------------------


@dataclass
class AnyIssuer:
    """HTTP server with a discovery document and keys, which tests change."""

    url: str
    keys: list[Key] = field(default_factory=lambda: [FIRST])
    document: dict[str, Any] = field(default_factory=dict)
    # Answers in place of the document.
    answer: Callable[[BaseHTTPRequestHandler], None] | None = None
    fetched: int = 0

    def verifier(
        self, *, now: Callable[[], float] = time.time, clock: Callable[[], float] = time.monotonic, **more: Any
    ):
        settings = Settings(**(_with_issuer(self.url) | more))
        return TokenVerifier(settings.access, now=now, clock=clock)


@pytest.fixture
def issuer() -> Iterator[AnyIssuer]:
    class Handler(QuietHandler):
        def do_GET(self) -> None:
            if self.path == "/keys":
                content: dict[str, Any] = {"keys": [key.as_dict(private=False) for key in found.keys]}
            elif found.answer is not None:
                found.fetched += 1
                found.answer(self)
                return
            else:
                found.fetched += 1
                content = {"issuer": found.url, "jwks_uri": f"{found.url}/keys"} | found.document
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(content).encode())

    with http_server(Handler) as url:
        found = AnyIssuer(url)
        yield found


def _signed(key: Key, claims: dict[str, Any] | None = None, **header: Any) -> str:
    """Return a token with valid claims, some of them changed; None removes one."""
    now = int(time.time())
    valid = {"sub": "robot", "aud": AUDIENCE, "iat": now, "exp": now + 300, "tenant": "acme", "scope": "lalaloc:read"}
    values = {name: value for name, value in (valid | (claims or {})).items() if value is not None}
    all_headers = {"alg": header.pop("alg", "RS256"), "kid": key.kid, "typ": "at+jwt"} | header
    shown = {name: value for name, value in all_headers.items() if value is not None}
    usable = _for_any_algorithm(key)
    return jwt.encode(shown, values, usable, registry=JWSRegistry(algorithms=oidc.ALGORITHMS), default_type=None)


def _for_any_algorithm(key: Key) -> Key:
    parameters: Any = {name: value for name, value in key.as_dict(private=True).items() if name not in ("alg", "use")}
    return JWKRegistry.import_key(parameters)


def _verify(verifier: TokenVerifier, *tokens: str) -> Identity:
    async def verify() -> Identity:
        return [await verifier.verify(token) for token in tokens][-1]

    return asyncio.run(verify())


def _refusal(verifier: TokenVerifier, token: str) -> str:
    with pytest.raises(UnauthenticatedError) as caught:
        _verify(verifier, token)
    return str(caught.value)


def test_claims_give_tenant_and_scopes(issuer: AnyIssuer) -> None:
    def holder(claims: dict[str, Any], **settings: Any) -> Identity:
        return _verify(issuer.verifier(**settings), _signed(FIRST, {"iss": issuer.url} | claims))

    read = frozenset({Permission.READ})
    assert holder({}) == Identity("oidc:robot", "acme", read)
    assert holder({"aud": ["other", AUDIENCE], "scope": "openid read lalaloc:read lalaloc:fly"}).permissions == read
    assert holder({"scope": None}).permissions == frozenset()
    roles = {"access": {"roles": ["lalaloc:admin", "lalaloc:read", "admin", 7]}}
    assert holder(roles, oidc_scope_claim="access.roles").permissions == {Permission.ADMIN, Permission.READ}
    assert holder({"https://x.example/org": "b"}, oidc_tenant_claim="https://x.example/org").tenant == "b"


@pytest.mark.parametrize(
    ("key", "algorithm"),
    [
        (FIRST, "RS256"),
        (FIRST, "PS384"),
        (ECKey.generate_key("P-256", {"kid": "e"}), "ES256"),
        (ECKey.generate_key("P-521", {"kid": "e"}), "ES512"),
        (OKPKey.generate_key("Ed25519", {"kid": "o"}), "Ed25519"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_public_key_algorithms_are_accepted(issuer: AnyIssuer, key: Key, algorithm: str) -> None:
    issuer.keys = [_for_any_algorithm(key)]
    for kid in (key.kid, None):
        token = _signed(key, {"iss": issuer.url}, alg=algorithm, kid=kid)
        assert _verify(issuer.verifier(), token).tenant == "acme"


def _confused(issuer: AnyIssuer) -> str:
    """Return a token whose shared secret is the issuer's public key."""
    signed = _unsigned(issuer, "HS256").rpartition(".")[0]
    # The library refuses to make this token.
    signature = hmac.digest(FIRST.as_pem(private=False), signed.encode(), "sha256")
    return f"{signed}.{base64.urlsafe_b64encode(signature).rstrip(b'=').decode()}"


def _unsigned(issuer: AnyIssuer, algorithm: str) -> str:
    _, body, signature = _signed(FIRST, {"iss": issuer.url}).split(".")
    return _with_head(json.dumps({"alg": algorithm, "kid": "first"}).encode(), body, signature)


def _with_head(head: bytes, body: str = "e30", signature: str = "x") -> str:
    return f"{base64.urlsafe_b64encode(head).rstrip(b'=').decode()}.{body}.{signature}"


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        (lambda issuer: _unsigned(issuer, "none"), "algorithm is not one of RS256"),
        (lambda issuer: _unsigned(issuer, "None"), "algorithm is not one of RS256"),
        (_confused, "algorithm is not one of RS256"),
        (lambda issuer: _signed(SECOND, {"iss": issuer.url}), "key that the issuer does not publish"),
        (lambda issuer: _signed(SECOND, {"iss": issuer.url}, kid="first"), "valid signature"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url}, alg="PS256"), "key that the issuer does not publish"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url}, typ="logout+jwt"), "type must be 'at+jwt'"),
        (lambda issuer: _signed(FIRST, {"iss": "https://evil.example"}), "claim 'iss' must be 'http://127"),
        (lambda _: _signed(FIRST), "claim 'iss' must be"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "aud": "other"}), f"claim 'aud' must be '{AUDIENCE}'"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "aud": None}), "claim 'aud'"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "exp": None}), "claim 'exp' is missing"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "exp": "never"}), "claim 'exp'"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "sub": None}), "claim 'sub' is missing"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "sub": "x\n"}), "claim 'sub' must have up to 255"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "tenant": None}), "LALALOC_OIDC_TENANT_CLAIM"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "tenant": "../x"}), "must be the name of a tenant"),
        (lambda issuer: _signed(FIRST, {"iss": issuer.url, "tenant": ["acme"]}), "must be the name of a tenant"),
        (lambda _: "a.b.c", "not a JSON Web Token"),
        (lambda _: _with_head(b'["alg"]'), "not a JSON Web Token"),
        (lambda _: _with_head(b'{"alg": [], "kid": {}}'), "not a JSON Web Token"),
        (lambda _: _with_head(b"[" * 3000), "not a JSON Web Token"),
    ],
)
def test_invalid_token_is_refused(issuer: AnyIssuer, token: Callable[[AnyIssuer], str], reason: str) -> None:
    assert reason in _refusal(issuer.verifier(), token(issuer))


def test_clocks_can_differ_by_a_minute(issuer: AnyIssuer) -> None:
    token = _signed(FIRST, {"iss": issuer.url, "iat": 1000, "nbf": 1000, "exp": 2000})
    for now in (1000 - oidc.LEEWAY_S, 1500, 2000 + oidc.LEEWAY_S - 1):
        assert _verify(issuer.verifier(now=lambda now=now: now), token).tenant == "acme"
    assert "has expired" in _refusal(issuer.verifier(now=lambda: 2000 + oidc.LEEWAY_S), token)
    assert "claim 'nbf'" in _refusal(
        issuer.verifier(now=lambda: 1000 - oidc.LEEWAY_S - 1),
        _signed(FIRST, {"iss": issuer.url, "nbf": 1000, "iat": 1}),
    )


@pytest.mark.filterwarnings("ignore:Key size")
def test_keys_without_use_for_signatures_are_ignored(issuer: AnyIssuer) -> None:
    weak = _rsa("weak", 1024)
    issuer.keys = [weak, RSAKey.generate_key(2048, {"kid": "enc", "use": "enc"}), OctKey.generate_key(256), FIRST]
    assert _verify(issuer.verifier(), _signed(FIRST, {"iss": issuer.url})).tenant == "acme"
    assert "does not publish" in _refusal(issuer.verifier(), _signed(weak, {"iss": issuer.url}))


def test_keys_are_not_fetched_per_token(issuer: AnyIssuer) -> None:
    clock_s = [0.0]
    verifier = issuer.verifier(clock=lambda: clock_s[0])
    valid = _signed(FIRST, {"iss": issuer.url})
    unknown = [_signed(SECOND, {"iss": issuer.url}, kid=f"{number}") for number in range(20)]

    async def refused(tokens: list[str]) -> None:
        results = await asyncio.gather(*(verifier.verify(token) for token in tokens), return_exceptions=True)
        assert all(isinstance(result, UnauthenticatedError) for result in results)

    async def run() -> None:
        await asyncio.gather(*(verifier.verify(valid) for _ in range(20)))
        assert issuer.fetched == 1
        await refused(unknown)
        assert issuer.fetched == 1
        clock_s[0] += oidc._PAUSE_S
        await refused(unknown)
        assert issuer.fetched == 2
        # Old keys are renewed without waiting, and used while the issuer is away.
        issuer.answer = lambda handler: handler.send_error(500)
        clock_s[0] += oidc._FRESH_S
        await verifier.verify(valid)
        while issuer.fetched < 3 or verifier._begin_fetch() is not None:
            await asyncio.sleep(0.01)
        await verifier.verify(valid)
        clock_s[0] += oidc._STALE_S
        for _ in range(2):
            with pytest.raises(IssuerUnavailableError):
                await verifier.verify(valid)
        assert issuer.fetched == 4
        issuer.answer = None
        clock_s[0] += oidc._PAUSE_S
        await verifier.verify(valid)

    asyncio.run(run())


def _repeated(content: bytes, times: int, pause_s: float = 0.0) -> Callable[[BaseHTTPRequestHandler], None]:
    """Return an answer that repeats its content until the caller has enough."""

    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.end_headers()
        with suppress(OSError):
            for _ in range(times):
                handler.wfile.write(content)
                time.sleep(pause_s)

    return answer


def _redirecting(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(302)
    handler.send_header("Location", "/keys")
    handler.end_headers()


@pytest.mark.parametrize(
    ("answer", "document", "reason"),
    [
        (_repeated(b" " * 65536, 100), {}, "more than 262144 bytes"),
        (_repeated(b" ", 600, 0.05), {}, "for more than"),
        (_redirecting, {}, "status 302"),
        (lambda handler: handler.send_error(500), {}, "status 500"),
        (None, {"issuer": "https://other.example"}, "calls itself 'https://other.example'"),
        (None, {"jwks_uri": "http://10.0.0.1/keys"}, "must begin with https"),
        (None, {"jwks_uri": "file:///etc/passwd"}, "not a URL"),
        (None, {"jwks_uri": None}, "not a URL"),
        (None, {"jwks_uri": "https://a\x01b/"}, "not a URL"),
    ],
)
def test_unusable_issuer_is_not_trusted(
    issuer: AnyIssuer, monkeypatch: pytest.MonkeyPatch, answer: Any, document: dict[str, Any], reason: str
) -> None:
    monkeypatch.setattr(oidc, "_FETCH_S", 0.3)
    issuer.answer, issuer.document = answer, document
    with pytest.raises(ValueError, match=reason):
        asyncio.run(oidc.fetch_keys(issuer.url))
    with pytest.raises(IssuerUnavailableError):
        _verify(issuer.verifier(), _signed(FIRST, {"iss": issuer.url}))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"oidc_issuer": "https://login.example"}, "LALALOC_API_KEYS=on"),
        ({"oidc_issuer": "https://login.example", "api_keys": True}, "LALALOC_OIDC_AUDIENCE"),
        ({"oidc_audience": AUDIENCE, "api_keys": True}, "LALALOC_OIDC_ISSUER"),
        (_with_issuer("http://login.example"), "must begin with https://"),
        (_with_issuer("http://localhost.evil.example"), "must begin with https://"),
        (_with_issuer("ftp://login.example"), "not a URL"),
        (_with_issuer("https://user@login.example"), "not a URL"),
        (_with_issuer("https://login.example?x=1"), "not a URL"),
        (_with_issuer("https://login.example:99999"), "not a URL"),
    ],
)
def test_unsafe_settings_are_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        Settings(**settings)
    Settings(**_with_issuer("https://login.example/realms/acme"))


@pytest.mark.one_replica
def test_invalid_tokens_are_limited_and_events_end_with_the_token(
    start_app: StartApp, tmp_path: Path, issuer: AnyIssuer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access_control, "REFUSED_KEYS_PER_MINUTE", 5)
    later_s = 0

    def registry(now: int, **options: Any) -> JWTClaimsRegistry:
        return JWTClaimsRegistry(now=now + later_s, **options)

    monkeypatch.setattr(oidc, "JWTClaimsRegistry", registry)
    with start_app(tmp_path, key_cache_s=1.0, **_with_issuer(issuer.url)) as client:
        valid = _signed(FIRST, {"iss": issuer.url, "scope": "lalaloc:write"})
        plan_id = client.post("/floorplans", json=FLAT, headers=bearer(valid)).json()["id"]
        brief = _signed(FIRST, {"iss": issuer.url, "exp": int(time.time()) + 200})
        valid = _signed(FIRST, {"iss": issuer.url, "scope": "lalaloc:write", "exp": int(time.time()) + 2000})
        with client.stream("GET", f"/floorplans/{plan_id}/events", headers=bearer(brief), timeout=60.0) as stream:
            assert stream.status_code == 200
            later_s = 400
            # Ends by itself, long before the time limit of streams.
            stream.read()
        expired = assert_problem(client.get("/limits", headers=bearer(brief)), 401, "unauthenticated")
        assert "has expired" in expired["detail"]
        statuses = [client.get("/limits", headers=bearer(brief)).status_code for _ in range(12)]
        assert set(statuses) == {401, 429}
        assert client.get("/limits", headers=bearer(valid)).status_code == 403
        admin = _signed(FIRST, {"iss": issuer.url, "scope": "lalaloc:admin", "exp": int(time.time()) + 2000})
        entries = client.get("/admin/audit", headers=bearer(admin)).json()["entries"]
        results = {entry["result"] for entry in entries}
        assert {"unauthenticated", "too-many-refused-keys", "insufficient-scope"} <= results


@pytest.mark.one_replica
def test_outage_of_the_issuer_is_said_and_audited(
    start_app: StartApp, tmp_path: Path, issuer: AnyIssuer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(oidc, "_PAUSE_S", 0.0)
    issuer.answer = lambda handler: handler.send_error(500)
    with start_app(tmp_path, **_with_issuer(issuer.url)) as client:
        admin = bearer(_signed(FIRST, {"iss": issuer.url, "scope": "lalaloc:admin"}))
        assert_problem(client.get("/usage", headers=admin), 503, "issuer-unavailable")
        issuer.answer = None
        entries = client.get("/admin/audit", headers=admin).json()["entries"]
        assert ("GET /usage", "issuer-unavailable") in {(entry["action"], entry["result"]) for entry in entries}
