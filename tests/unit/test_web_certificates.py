"""Certificates of `pbl web --tls`: what a browser that trusts the authority accepts."""

import datetime
import socket
import ssl
import stat
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography import x509

from pbl_pipeline.errors import PblError
from pbl_workers.cli.web import web
from pbl_workers.web import Where, certificates
from pbl_workers.web.access import host_name
from tests import Environment, Limits, refused

NAMES = ("127.0.0.1", "gait.example")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, environment: Environment) -> Path:
    environment(PBL_HOME=tmp_path)
    return tmp_path


def handshake(names: tuple[str, ...], asked: str, trusted: Path) -> None:
    """A TLS connection under a name, checked as a browser does. Raises `ssl.SSLError`."""
    cert, key = certificates.server_certificate(names)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(cert, key)
    listening = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        connection, _ = listening.accept()
        with connection:
            try:
                server.wrap_socket(connection, server_side=True).close()
            except (ssl.SSLError, OSError):
                return

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        context = ssl.create_default_context(cafile=trusted)
        with (
            socket.create_connection(listening.getsockname()) as sent,
            context.wrap_socket(sent, server_hostname=asked),
        ):
            pass
    finally:
        thread.join(5)
        listening.close()


def test_a_browser_that_trusts_the_authority_accepts_each_name(home: Path):
    certificates.server_certificate(NAMES)
    for name in NAMES:
        handshake(NAMES, name, certificates.authority())
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(NAMES, "other.example", certificates.authority())


def test_another_authority_is_not_accepted(home: Path, environment: Environment, tmp_path: Path):
    certificates.server_certificate(NAMES)
    other = certificates.authority()
    environment(PBL_HOME=tmp_path / "other")
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(NAMES, "127.0.0.1", other)


def test_the_authority_is_made_once_and_the_servers_certificate_for_its_names(home: Path):
    cert, key = certificates.server_certificate(NAMES)
    first, authority = cert.read_bytes(), certificates.authority().read_bytes()
    assert certificates.server_certificate(NAMES) == (cert, key)
    assert cert.read_bytes() == first
    certificates.server_certificate(("gait.example",))
    assert cert.read_bytes() != first
    assert certificates.authority().read_bytes() == authority


def test_it_is_renewed_before_its_end(home: Path, limits: Limits):
    cert, _ = certificates.server_certificate(NAMES)
    first = cert.read_bytes()
    left = x509.load_pem_x509_certificate(first).not_valid_after_utc - datetime.datetime.now(datetime.UTC)
    assert left < datetime.timedelta(days=398)  # the most that browsers take
    limits(certificates, RENEW_DAYS=397)
    certificates.server_certificate(NAMES)
    assert cert.read_bytes() != first


def test_keys_are_private(home: Path):
    certificates.server_certificate(NAMES)
    for key in (certificates.folder()).glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert stat.S_IMODE(certificates.folder().stat().st_mode) == 0o700
    authority = x509.load_pem_x509_certificate(certificates.authority().read_bytes())
    assert authority.extensions.get_extension_for_class(x509.BasicConstraints).value.path_length == 0


def test_names_of_this_machine():
    assert socket.gethostname() in certificates.own_names()


def test_the_command_makes_it_and_asks_for_accounts(home: Path):
    done = CliRunner().invoke(web, ["--tls", "--port", "0"])
    assert certificates.authority().is_file()
    assert str(certificates.authority()) in done.output
    assert isinstance(done.exception, PblError)
    assert done.exception.code == "WEB_ACCOUNT"
    both = CliRunner().invoke(web, ["--tls", "--tls-cert", "a.pem", "--tls-key", "b.pem"])
    assert both.exit_code == 2


def test_names_are_those_of_a_host_header(home: Path):
    """Capital letters, umlauts, IPv6: what a browser sends is answered, in the certificate, and printed."""
    where = Where("0.0.0.0", tls_cert=Path("c"), hostnames=("Gait.Example", "büro.example", "FE80:0:0::1", "LAB-PC."))
    assert where.names == {"gait.example", "xn--bro-hoa.example", "fe80::1", "lab-pc"}
    assert "https://[fe80::1]:8484" in where.addresses(8484)
    cert, _ = certificates.server_certificate(sorted(where.names))
    first = cert.read_bytes()
    certificates.server_certificate(sorted(where.names))
    assert cert.read_bytes() == first


@pytest.mark.parametrize("name", ["", " ", "a b", "https://gait.example", "x" * 64, "a..b", "-a"])
def test_what_is_no_name_of_a_host_is_refused(name: str):
    assert "--hostname" in refused("USAGE", host_name, name).next_step


def test_an_authority_signs_names_of_the_laboratory_alone(home: Path):
    certificates.server_certificate(NAMES)
    certificates.server_certificate(("192.168.1.7", "lab.local", "www.gait.example"))
    assert "other.example" in refused("WEB_TLS", certificates.server_certificate, ("other.example",)).found


@pytest.mark.parametrize("harm", ["lost", "damaged", "another", "open"])
def test_an_authority_is_never_replaced_in_silence(home: Path, harm: str):
    certificates.server_certificate(NAMES)
    key, before = certificates.folder() / "authority.key", certificates.authority().read_bytes()
    if harm == "lost":
        key.unlink()
    elif harm == "damaged":
        key.write_bytes(key.read_bytes()[:40])
    elif harm == "another":
        key.write_bytes((certificates.folder() / "server.key").read_bytes())
    else:
        key.chmod(0o644)
    error = refused("WEB_TLS", certificates.server_certificate, NAMES)
    assert ("chmod 600" in error.next_step) == (harm == "open")
    assert certificates.authority().read_bytes() == before
