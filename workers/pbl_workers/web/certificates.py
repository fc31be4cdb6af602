"""The laboratory's own certificates (`pbl web --tls`): an authority, made once, that phones have to trust, and the
server's certificate, which it signs and which is renewed automatically."""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import secrets
import socket
from collections.abc import Collection
from pathlib import Path
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from pbl_schemas.operations.folders import private_folder, write_text

#: Days for which the authority and a server's certificate are good (browsers take at most 398 for the latter), and
#: those before its end at which that is renewed.
AUTHORITY_DAYS, SERVER_DAYS, RENEW_DAYS = 3650, 397, 30


def folder() -> Path:
    """Return the folder of the certificates and their keys, which only this account may read."""
    return private_folder(settings.home_dir() / "web" / "tls")


def authority() -> Path:
    """Return where the authority's certificate lies, which is not secret and may not exist yet."""
    return settings.home_dir() / "web" / "tls" / "authority.crt"


def own_names() -> tuple[str, ...]:
    """Return the names under which phones of the same network reach this machine: its address and its name."""
    names = [socket.gethostname()]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked, contextlib.suppress(OSError):
        asked.connect(("192.0.2.1", 9))  # chooses the way to other machines; nothing is sent
        names.insert(0, asked.getsockname()[0])
    return tuple(dict.fromkeys(names))


def server_certificate(names: Collection[str]) -> tuple[Path, Path]:
    """Return the files of a certificate for these names and of its key, made and signed if there is none, where it
    is for other names, or ends soon. Raises OSError, and `PblError` as `_authority` does."""
    here = folder()
    cert, key = here / "server.crt", here / "server.key"
    signed_by, signing_key = _authority(here, names)
    if cert.is_file() and key.is_file():
        known = x509.load_pem_x509_certificate(cert.read_bytes())
        left = known.not_valid_after_utc - datetime.datetime.now(datetime.UTC)
        signed = known.issuer == signed_by.subject
        if signed and _names(known) == set(names) and left > datetime.timedelta(days=RENEW_DAYS):
            return cert, key
    own = ec.generate_private_key(ec.SECP256R1())
    alternatives = x509.SubjectAlternativeName([_general(name) for name in names])
    builder = (
        _builder(next(iter(names)), signed_by.subject, own.public_key(), SERVER_DAYS)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(alternatives, critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key()), critical=False)
    )
    write_text(key, _key_bytes(own))
    write_text(cert, builder.sign(signing_key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    return cert, key


#: Names that an authority may sign beside those that it is made for: of private networks, which no one else has.
_PRIVATE = ("local", "lan", "internal", "home.arpa")
_NETWORKS = ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "127.0.0.0/8", "fc00::/7", "fe80::/10", "::1/128")


def _authority(here: Path, names: Collection[str]) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return the authority, made for these names if there is none. A stolen key signs nothing but names of the
    laboratory. Raises `PblError` WEB_TLS for one that is not whole, or whose key others may read: it is not replaced,
    because phones trust it."""
    cert, key = authority(), here / "authority.key"
    if cert.is_file() or key.is_file():
        try:
            known = x509.load_pem_x509_certificate(cert.read_bytes())
            signing = cast("ec.EllipticCurvePrivateKey", serialization.load_pem_private_key(key.read_bytes(), None))
        except (OSError, ValueError, TypeError) as error:
            raise _unusable(f"{getattr(error, 'strerror', None) or 'certificate or key is damaged'}", here) from error
        if known.public_key() != signing.public_key():
            raise _unusable("a key that is not that of the certificate", here)
        if key.stat().st_mode & 0o077:
            raise _unusable(f"a key that others may read ({key.stat().st_mode & 0o777:o})", here, f"chmod 600 {key}")
        if wrong := [name for name in names if not _may_sign(known, name)]:
            raise _unusable(f"an authority that may not sign {', '.join(wrong)}", here)
        return known, signing
    own = ec.generate_private_key(ec.SECP256R1())
    # A unique name: another machine of the laboratory is another authority.
    name = f"Gait laboratory {secrets.token_hex(3)}"
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    made = (
        _builder(name, None, own.public_key(), AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.NameConstraints(_permitted(names), None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(own.public_key()), critical=False)
        .sign(own, hashes.SHA256())
    )
    write_text(key, _key_bytes(own))
    write_text(cert, made.public_bytes(serialization.Encoding.PEM))
    return made, own


def _permitted(names: Collection[str]) -> list[x509.GeneralName]:
    own = [_general(name) for name in names]
    networks = [ipaddress.ip_network(n) for n in _NETWORKS]
    networks += [ipaddress.ip_network(str(g.value)) for g in own if isinstance(g, x509.IPAddress)]
    dns = {*_PRIVATE, *(g.value for g in own if isinstance(g, x509.DNSName))}
    return [*(x509.IPAddress(n) for n in dict.fromkeys(networks)), *(x509.DNSName(n) for n in sorted(dns))]


def _may_sign(cert: x509.Certificate, name: str) -> bool:
    try:
        permitted = cert.extensions.get_extension_for_class(x509.NameConstraints).value.permitted_subtrees or []
    except x509.ExtensionNotFound:  # of before 0.2
        return True
    general = _general(name)
    if isinstance(general, x509.DNSName):
        return any(f".{name}".endswith(f".{p.value}") for p in permitted if isinstance(p, x509.DNSName))
    address = ipaddress.ip_address(name)
    return any(address in p.value for p in permitted if isinstance(p, x509.IPAddress))  # type: ignore[operator]


def _unusable(found: str, here: Path, next_step: str = "") -> PblError:
    return PblError(
        "WEB_TLS",
        found=found,
        expected="certificate and key of this machine's authority, which phones trust, as they were made",
        next_step=next_step
        or f"bring authority.crt and authority.key back from a backup; or remove {here}, start "
        "again, and let each phone trust the new authority (docs/capture.md)",
        key=here,
    )


def _builder(
    name: str, issuer: x509.Name | None, public: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name[:64])])
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer or subject)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _general(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _names(cert: x509.Certificate) -> set[str]:
    found = cert.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return {str(general.value) for general in found}


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
