"""Passwords from files, and nowhere else to be read; connections that are encrypted when they must be."""

import datetime
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pymysql
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from pbl_pipeline.errors import PblError
from pbl_schemas import connection
from pbl_schemas.operations import embedded
from pbl_schemas.operations.embedded import Folder, process
from tests import Environment
from tests.command import PBL
from tests.database import new_home, remove_home

pytestmark = pytest.mark.database

WRONG = "wrong-password-5d1e"

Use = Callable[..., None]


def make_certificates(folder: Path, name: str) -> dict[str, Path]:
    """An authority, and a server's key and certificate that it signed for `name`."""
    now = datetime.datetime.now(datetime.UTC)
    keys = {who: ec.generate_private_key(ec.SECP256R1()) for who in ("ca", "server")}
    issuer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "laboratory")])
    files = {}
    for who, subject in (("ca", issuer), ("server", x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))):
        made = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer)
            .public_key(keys[who].public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=who == "ca", path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .sign(keys["ca"], hashes.SHA256())
        )
        files[who] = folder / f"{who}.pem"
        files[who].write_bytes(made.public_bytes(serialization.Encoding.PEM))
        plain = serialization.NoEncryption()
        form = serialization.PrivateFormat.TraditionalOpenSSL
        files[f"{who}-key"] = folder / f"{who}-key.pem"
        files[f"{who}-key"].write_bytes(keys[who].private_bytes(serialization.Encoding.PEM, form, plain))
    return files


@contextmanager
def encrypted_server(name: str) -> Iterator[tuple[Path, dict[str, Path]]]:
    """A server with a certificate for this name; its home and the files."""
    home = new_home()
    files = make_certificates(home, name)
    for file in files.values():
        file.chmod(0o644)  # the server's account reads them; they are worth nothing after the test
    options = (*process.OPTIONS, f"--ssl-cert={files['server']}", f"--ssl-key={files['server-key']}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "OPTIONS", options)
        embedded.start(folder=Folder(home / "db"))
    try:
        yield home, files
    finally:
        remove_home(home)


@pytest.fixture(scope="module")
def encrypted() -> Iterator[tuple[Path, dict[str, Path]]]:
    with encrypted_server("localhost") as server:
        yield server


@pytest.fixture
def use(environment: Environment) -> Use:
    """Point the tables at the server of a home by the variables of an external one."""

    def point(home: Path, host: str = "127.0.0.1", **more: str) -> None:
        folder = Folder(home / "db")
        file = home / "password"
        file.write_text(folder.credentials().app_password + "\n")
        values = {"DJ_HOST": host, "DJ_PORT": folder.state()["port"], "DJ_USER": "pbl", "DJ_PASS_FILE": file}
        environment(**values | more)

    return point


def cipher() -> str:
    """What encrypts the driver's connection with our settings; empty where nothing does."""
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SHOW SESSION STATUS LIKE 'Ssl_cipher'")
        return (cursor.fetchone() or ("", ""))[1]


SHOW = """
from pbl_schemas import connection
print("cipher", connection.connect().query("SHOW SESSION STATUS LIKE 'Ssl_cipher'").fetchone()[1] or "none")
"""


def in_new_process(code: str) -> subprocess.CompletedProcess[str]:
    """DataJoint keeps one connection per process: each way of connecting gets one of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)


# ----------------------------------------------------------------------------------------------------------- TLS
def test_required_encryption_is_refused_by_a_server_without(database: Path, use: Use):
    use(database, DJ_USE_TLS="1")
    with pytest.raises(PblError) as error:
        connection.plain_connection()
    assert error.value.code == "DB_NOT_RUNNING"
    assert "SSL" in str(error.value)
    done = in_new_process(SHOW)
    assert done.returncode != 0
    assert "cipher" not in done.stdout
    use(database, DJ_USE_TLS="0")
    assert cipher() == ""


def test_encryption_and_the_name_of_the_server(encrypted: tuple[Path, dict[str, Path]], use: Use):
    home, files = encrypted
    use(home, DJ_USE_TLS="1")
    assert cipher().startswith("TLS_")
    assert "cipher TLS_" in in_new_process(SHOW).stdout
    use(home, host="localhost", DJ_TLS_CA=str(files["ca"]))
    assert cipher().startswith("TLS_")
    assert "cipher TLS_" in in_new_process(SHOW).stdout
    # The certificate is for localhost, not for this address.
    use(home, DJ_TLS_CA=str(files["ca"]))
    with pytest.raises(PblError, match="IP address mismatch"):
        connection.plain_connection()
    assert "cipher" not in in_new_process(SHOW).stdout


def test_a_certificate_of_another_authority_is_refused(
    encrypted: tuple[Path, dict[str, Path]], use: Use, tmp_path: Path
):
    other = make_certificates(tmp_path, "localhost")
    use(encrypted[0], host="localhost", DJ_TLS_CA=str(other["ca"]))
    with pytest.raises(PblError, match="certificate verify failed"):
        connection.plain_connection()
    assert "cipher" not in in_new_process(SHOW).stdout
    use(encrypted[0], DJ_TLS_CA=str(tmp_path / "nowhere.pem"))
    with pytest.raises(PblError, match=r"^FILE_MISSING: "):
        connection.plain_connection()


# ------------------------------------------------------------------------------------------------------- secrets
def test_the_password_comes_from_the_file_even_where_the_variable_is_set(database: Path, use: Use):
    use(database, DJ_PASS=WRONG)
    with closing(connection.plain_connection()) as server:
        assert server.ping() is None


@pytest.mark.long
def test_no_secret_is_printed_or_logged(database: Path, use: Use, tmp_path: Path):
    """Commands that work and commands that fail, with all logging on: neither output nor files name the secrets."""
    right = Folder(database / "db").credentials().app_password
    wrong = tmp_path / "wrong"
    wrong.write_text(WRONG)
    s3 = tmp_path / "s3"
    s3.write_text("s3-secret-91c2")
    use(database, DJ_LOG_LEVEL="DEBUG", PBL_S3_SECRET_FILE=str(s3), PBL_S3_KEY="pbl", PBL_HOME=str(tmp_path / "home"))
    said = ""
    running = []
    for arguments, changes in (
        (["--debug", "db", "status"], {}),
        (["--debug", "db", "status"], {"DJ_PASS_FILE": str(wrong)}),
        (["--debug", "db", "status"], {"DJ_PORT": "1"}),
        (["--debug", "db", "init"], {"PBL_S3_ENDPOINT": "http://127.0.0.1:1", "AWS_MAX_ATTEMPTS": "1"}),
        (["--debug", "status"], {"DJ_USER": "nobody"}),
        (["--debug", "doctor"], {}),
    ):
        env, pipe = {**os.environ, **changes}, subprocess.PIPE
        command = [*PBL, *arguments]
        running.append(
            subprocess.Popen(command, text=True, env=env, cwd=tmp_path, stdout=pipe, stderr=subprocess.STDOUT)
        )
    for child in running:  # beside each other
        with child:
            said += child.communicate(timeout=300)[0]
    assert "DB_REFUSED" in said
    assert "STORE_UNAVAILABLE" in said
    for file in (p for p in tmp_path.rglob("*") if p.is_file() and p not in (wrong, s3)):
        said += file.read_text(errors="replace")
    for secret in (right, WRONG, "s3-secret-91c2"):
        assert secret not in said


def test_a_refused_login_names_no_password(database: Path, use: Use, environment: Environment):
    use(database)
    environment(DJ_PASS_FILE=None, DJ_PASS=WRONG)
    with pytest.raises(PblError) as error:
        connection.plain_connection()
    assert error.value.code == "DB_REFUSED"
    assert "DJ_PASS" in str(error.value)
    assert WRONG not in str(error.value)
    assert isinstance(error.value.__cause__, pymysql.err.OperationalError)
    assert WRONG not in str(error.value.__cause__)
    assert "DB_REFUSED" in in_new_process(SHOW).stderr
    environment(DJ_PASS=None)
    with pytest.raises(PblError, match=r"^DB_REFUSED: "):
        connection.plain_connection()


@pytest.mark.parametrize(
    ("content", "code"), [(None, "FILE_MISSING"), (b"\xff\xfe secret", "FILE_MISSING"), (b"\n", "USAGE")]
)
def test_a_file_without_a_secret(database: Path, use: Use, tmp_path: Path, content: bytes | None, code: str):
    file = tmp_path / "password"
    if content is not None:
        file.write_bytes(content)
    use(database, DJ_PASS_FILE=str(file))
    with pytest.raises(PblError) as error:
        connection.plain_connection()
    assert error.value.code == code
    assert error.value.__cause__ is None
    assert "secret\n" not in str(error.value)
