"""Access for phones in the same network, `lalaloc-service serve --lan`: addresses, certificate and key.

Browsers allow the camera over HTTPS only, so the service has a certificate of its own, of which they warn once.
"""

from __future__ import annotations

import fcntl
import ipaddress
import os
import socket
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
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
    "Open this link, then `On a phone` on the page. Each browser warns once that the certificate is not trusted: "
    "choose Advanced and Proceed, on an iPhone Show Details and visit this website. The link has a key, which ends "
    "with this run."
)
_FILE = "lan-certificate.pem"
_LIFETIME, _RENEWED_BEFORE = timedelta(days=365), timedelta(days=1)
# A service that is killed leaves its key valid for this time.
_KEY_LIFETIME = timedelta(days=1)
_SCOPES = (Permission.READ, Permission.LOCALISE, Permission.WRITE)
# Linux: the IPv4 address of an interface.
_SIOCGIFADDR = 0x8915


@contextmanager
def lan_access(folder: Path, port: int) -> Iterator[tuple[str, Path]]:
    """Give a link to the service with an API key, which is revoked at the end, and the certificate to serve with.

    The key is for the plans that are stored without keys.

    Raises:
        ConfigError: the machine is in no network, or the certificate cannot be written to the folder.
    """
    addresses = lan_addresses()
    if not addresses:
        raise ConfigError("this machine has no address in a network; connect it to the phone's Wi-Fi for --lan")
    certificate, secret = lan_certificate(folder, addresses), new_secret()
    with configured_store() as store:
        key = store.keys.create(DEFAULT_TENANT, "serve --lan", hash_of(secret), _SCOPES, lifetime=_KEY_LIFETIME)
        audit(store, key.tenant, "keys create", key.id, name=key.name, scopes=sorted(key.scopes), end=key.expires_at)
    try:
        yield f"https://{addresses[0]}:{port}/#key={key_text(key.id, secret)}", certificate
    finally:
        with configured_store() as store:
            store.keys.revoke(key.id)
            audit(store, key.tenant, "keys revoke", key.id, name=key.name)


def lan_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine in networks, that of the default route first."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        with suppress(OSError):
            # Sends nothing; the address is one for documentation, which the default route leads to.
            probe.connect(("192.0.2.1", 9))
            found.append(probe.getsockname()[0])
        for _, name in socket.if_nameindex():
            # Interfaces without an IPv4 address fail.
            with suppress(OSError):
                answer = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
                found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in dict.fromkeys(found) if not ipaddress.ip_address(address).is_loopback]


def lan_certificate(folder: Path, addresses: Sequence[str]) -> Path:
    """Return the file with certificate and key in a folder, which is kept while it is valid for the first address.

    Raises:
        ConfigError: the file cannot be written.
    """
    path = folder / _FILE
    if not _is_for(path, addresses[0]):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(_new_certificate(addresses))
        except OSError as error:
            raise ConfigError(f"cannot write the certificate '{path}': {error.strerror}") from error
    return path


def _is_for(path: Path, address: str) -> bool:
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError):
        return False
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    is_named = ipaddress.ip_address(address) in names.get_values_for_type(x509.IPAddress)
    return is_named and certificate.not_valid_after_utc > datetime.now(UTC) + _RENEWED_BEFORE


def _new_certificate(addresses: Sequence[str]) -> bytes:
    """Return a self-signed certificate for addresses, and its key, as PEM."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "LaLaLoc")])
    names = [x509.IPAddress(ipaddress.ip_address(address)) for address in addresses]
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + _LIFETIME)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        # A device that trusts it trusts this service alone.
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return certificate.public_bytes(serialization.Encoding.PEM) + private
