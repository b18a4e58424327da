"""API keys as text: `lalaloc_<id>_<secret>`, of which the service keeps the id and a hash of the secret.

The secret is 256 random bits, so a fast hash keeps it as well as a slow one would: slow hashes make up for secrets that
can be guessed, and nobody guesses one of 2^256. Whoever reads the hashes cannot present any of them.
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


@dataclass(frozen=True)
class PresentedKey:
    """A key that somebody presents; whether it is valid is another matter.

    Attributes:
        id: names the key, no secret.
        hash: SHA-256 of its secret, 64 hexadecimal digits.
    """

    id: str
    hash: str


def new_secret() -> str:
    """256 random bits as 43 letters, digits, dashes and underscores."""
    return secrets.token_urlsafe(_SECRET_BYTES)


def hash_of(secret: str) -> str:
    """What is stored of a secret: its SHA-256 as 64 hexadecimal digits."""
    return hashlib.sha256(secret.encode("ascii")).hexdigest()


def key_text(key_id: str, secret: str) -> str:
    """The key as its owner keeps and sends it."""
    return f"lalaloc_{key_id}_{secret}"


def parse_authorization(values: Sequence[str]) -> PresentedKey | None:
    """The key of a request's `Authorization` headers; None when there is not exactly one, with one well-formed key."""
    bearer = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    key = _KEY.fullmatch(bearer[1]) if bearer else None
    return None if key is None else PresentedKey(key[1], hash_of(key[2]))
