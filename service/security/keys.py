"""API keys as text: `lalaloc_<id>_<secret>`; the service stores the id and a hash of the secret.

The secret is 256 random bits, so a fast hash is sufficient: slow hashes only help against guessable secrets.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

_SECRET_BYTES = 32
_KEY = re.compile(r"lalaloc_([0-9a-f]{32})_([A-Za-z0-9_-]{43})")
_BEARER = re.compile(r"bearer +(\S+)", re.IGNORECASE)
# Signed JSON Web Token, of at most 8 KiB.
_TOKEN = re.compile(r"(?=.{1,8192}\Z)[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+")


@dataclass(frozen=True)
class PresentedKey:
    """Key in a request, not yet checked.

    Attributes:
        id: id of the key; not secret.
        hash: SHA-256 of its secret, 64 hexadecimal digits.
    """

    id: str
    hash: str


def new_secret() -> str:
    """Return 256 random bits as 43 characters."""
    return secrets.token_urlsafe(_SECRET_BYTES)


def hash_of(secret: str) -> str:
    """Return the stored hash of a secret: SHA-256, 64 hexadecimal digits."""
    return hashlib.sha256(secret.encode("ascii")).hexdigest()


def key_text(key_id: str, secret: str) -> str:
    """Return the key as text."""
    return f"lalaloc_{key_id}_{secret}"


def parse_authorization(values: Sequence[str]) -> PresentedKey | None:
    """Parse `Authorization` headers; None unless there is exactly one, with a well-formed key."""
    bearer = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    key = _KEY.fullmatch(bearer[1]) if bearer else None
    return None if key is None else PresentedKey(key[1], hash_of(key[2]))


def parse_token(values: Sequence[str]) -> str | None:
    """Parse `Authorization` headers; None unless there is exactly one, with a token in the form of a signed JWT."""
    bearer = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    return bearer[1] if bearer is not None and _TOKEN.fullmatch(bearer[1]) else None
