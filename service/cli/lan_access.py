"""Access for phones in the same network, `lalaloc-service serve --lan`: address, certificate and key.

Browsers allow the camera over HTTPS only, so the service has a certificate of its own, of which they warn once.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from lalaloc_core.errors import ConfigError
from service.cli.command_parts import audit, configured_store
from service.security import Permission
from service.security.keys import hash_of, key_text, new_secret
from service.storage.records import DEFAULT_TENANT

NOTICE = (
    "Open this link, then `On a phone`. Browsers warn once of the certificate: choose Advanced and Proceed, on an "
    "iPhone Show Details and visit this website. The link has a key, which ends with this run."
)
# Apple's systems refuse certificates for more than 825 days, and those without the use by servers.
_LIFETIME, _KEPT = timedelta(days=800), timedelta(days=700)
_SCOPES = (Permission.READ, Permission.LOCALISE, Permission.WRITE)


@contextmanager
def lan_access(folder: Path, port: int) -> Iterator[tuple[str, Path]]:
    """Give a link to the service with an API key, which is revoked at the end, and the certificate to serve with.

    The key is for the plans that are stored without keys.

    Raises:
        ConfigError: the machine is in no network.
    """
    address, secret = lan_address(), new_secret()
    if address is None:
        raise ConfigError("this machine has no address in a network; connect it to the phone's Wi-Fi for --lan")
    with configured_store() as store:
        # A service that is killed leaves its key valid for a day.
        lifetime = timedelta(days=1)
        key = store.keys.create(DEFAULT_TENANT, "serve --lan", hash_of(secret), _SCOPES, lifetime=lifetime)
        audit(store, key.tenant, "keys create", key.id, name=key.name, scopes=sorted(key.scopes), end=key.expires_at)
    try:
        yield f"https://{address}:{port}/#key={key_text(key.id, secret)}", lan_certificate(folder, address)
    finally:
        with configured_store() as store:
            store.keys.revoke(key.id)
            audit(store, key.tenant, "keys revoke", key.id, name=key.name)


def lan_address() -> str | None:
    """Return the IPv4 address of this machine by which it reaches others; None if it reaches none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing; the address is one for documentation, which the default route leads to.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return None
        return probe.getsockname()[0]


def lan_certificate(folder: Path, address: str) -> Path:
    """Return the file with certificate and key for an address in a folder, which is kept while it is valid."""
    path = folder / f"lan-certificate-{address}.pem"
    if not path.exists() or time.time() - path.stat().st_mtime > _KEPT.total_seconds():
        folder.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(_new_certificate(IPv4Address(address)))
    return path


def _new_certificate(address: IPv4Address) -> bytes:
    """Return a self-signed certificate for an address, and its key, as PEM."""
    key, begin = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC) - timedelta(days=1)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "LaLaLoc")])
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(begin).not_valid_after(begin + _LIFETIME)
    for extension in (
        x509.SubjectAlternativeName([x509.IPAddress(address)]),
        x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]),
    ):
        builder = builder.add_extension(extension, critical=False)
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return builder.sign(key, hashes.SHA256()).public_bytes(pem) + private
