"""Accounts of the review page: passwords, sessions, who guesses, addresses that other machines reach, slow clients."""

import contextlib
import re
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from starlette.testclient import TestClient

from pbl_pipeline.errors import PblError
from pbl_workers.cli.web import web
from pbl_workers.web import Options, Where, accounts, certificates, connections, create_app, serve
from pbl_workers.web.access import IDLE_HOURS, Sessions
from pbl_workers.web.accounts import Accounts, Attempts
from pbl_workers.web.serve import config
from tests import Environment, Faults, Limits
from tests.integration.web import post, running
from tests.rows import new_visit

BASE = "https://gait.example"
WORDS = "correct horse battery staple"
#: The module that counts connections; its package has a function of the same name.
SERVER = sys.modules[config.__module__]


@pytest.fixture
def cheap(limits: Limits) -> None:
    """Hashes that cost little; the tests that need it measure the real cost."""
    limits(accounts, LOG_N=4)


@pytest.fixture
def known(cheap: None, tmp_path: Path) -> Accounts:
    """Accounts A (reader) and O (operator)."""
    made = Accounts(tmp_path / "web" / "accounts.json")
    made.add("A", ["reader"], WORDS)
    made.add("O", ["operator"], WORDS + " 2")
    return made


def browser(known: Accounts, sessions: Sessions | None = None) -> TestClient:
    app = create_app(Options(hosts=frozenset({"gait.example"}), accounts=known, secure=True), sessions)
    return TestClient(app, base_url=BASE, raise_server_exceptions=False, headers={"accept-language": "en"})


def sign_in(client: TestClient, name: str = "A", password: str = WORDS, **headers: str):
    return client.post("/enter", data={"name": name, "password": password}, headers=headers, follow_redirects=False)


# ------------------------------------------------------------------------------------------------------------ passwords
def test_a_hash_is_salted_memory_hard_and_of_its_password_alone():
    start = time.perf_counter()
    stored = accounts.hashed(WORDS)
    seconds = time.perf_counter() - start
    kind, log_n, r, p, *_ = stored.split("$")
    assert (kind, 128 * 2 ** int(log_n) * int(r), p) == ("scrypt", 128 * 2**20, "1")  # 128 MiB a guess
    assert seconds > 0.05
    assert accounts.matches(WORDS, stored)
    assert not accounts.matches(WORDS + " ", stored)
    assert stored != accounts.hashed(WORDS)
    umlaut = accounts.hashed("Stra\u00dfenk\u00fcnstler im Regen")
    assert accounts.matches("Stra\u00dfenku\u0308nstler im Regen", umlaut)  # composed of two signs


def test_the_file_is_for_its_account_alone_and_has_no_password(known: Accounts):
    text = known.path.read_text()
    assert WORDS not in text
    assert known.path.stat().st_mode & 0o777 == 0o600
    assert known.path.parent.stat().st_mode & 0o777 == 0o700
    known.path.chmod(0o644)
    with pytest.raises(PblError, match="chmod 600"):
        Accounts(known.path).all()
    known.path.chmod(0o600)
    known.path.write_text("{")
    with pytest.raises(PblError, match="restore the file") as error:
        Accounts(known.path).all()
    assert error.value.code == "WEB_ACCOUNT"


@pytest.mark.parametrize(
    ("name", "roles", "password", "said"),
    [
        ("A", ["reader"], WORDS, "an account 'A'"),
        ("", ["reader"], WORDS, "the name"),
        ("a\nb", ["reader"], WORDS, "the name"),
        ("../x", ["reader"], WORDS, "the name"),
        ("<b>", ["reader"], WORDS, "the name"),
        ("B", ["admin"], WORDS, "roles admin"),
        ("B", [], WORDS, "roles none"),
        ("B", ["reader"], "short", "a password of 5 characters"),
    ],
)
def test_accounts_that_cannot_be(known: Accounts, name: str, roles: list[str], password: str, said: str):
    before = known.path.read_bytes()
    with pytest.raises(PblError, match=re.escape(said)) as error:
        known.add(name, roles, password)
    assert error.value.code == "WEB_ACCOUNT"
    assert password not in str(error.value) or password == WORDS
    assert known.path.read_bytes() == before


def test_the_commands(cheap: None, tmp_path: Path, environment: Environment):
    environment(PBL_HOME=tmp_path)
    run = lambda *args, **more: CliRunner().invoke(web, ["account", *args], **more)  # noqa: E731
    typed = f"{WORDS}\n{WORDS}\n"
    done = run("add", "R.Viewer", "--role", "reviewer", "--role", "operator", input=typed)
    assert done.exit_code == 0, done.output
    assert WORDS not in done.output
    assert Accounts().all()["R.Viewer"].roles == ("reviewer", "operator")
    assert run("add", "B", input=typed).exit_code == 2  # a role has to be said
    assert "R.Viewer" in run("list").output
    assert run("password", "R.Viewer", input="another pass phrase\nanother pass phrase\n").exit_code == 0
    assert Accounts().check("R.Viewer", WORDS) is None
    assert isinstance(run("remove", "nobody").exception, PblError)
    assert run("remove", "R.Viewer").exit_code == 0
    assert Accounts().all() == {}


def test_a_backup_has_no_accounts(tables: None, tmp_path: Path, cheap: None):
    from pbl_schemas.operations.backup import backup

    Accounts().add("A", ["reader"], WORDS)
    try:
        kept = Accounts().all()["A"].password
        backup(tmp_path / "saved")
        for path in (tmp_path / "saved").rglob("*"):
            assert "account" not in path.name
            assert not path.is_file() or kept.encode() not in path.read_bytes()
    finally:
        Accounts().remove("A")


# ------------------------------------------------------------------------------------------------------------- sessions
def test_the_way_in_and_out(known: Accounts, tables: None):
    client = browser(known)
    assert client.get("/visits").status_code == 401
    assert "<form" in client.get("/visits").text
    assert "by the link in the terminal" not in client.get("/visits").text  # links are no way in here
    key = client.app.state.site.sessions.new_link("X", "reviewer")  # type: ignore[attr-defined]
    assert client.get(f"/enter?key={key}", follow_redirects=False).status_code == 200
    assert client.get("/visits").status_code == 401
    for name, password in (("A", "wrong password words"), ("nobody", WORDS), ("", ""), ("A", "x" * 300)):
        answer = sign_in(client, name, password)
        assert answer.status_code == 401
        assert "do not belong together" in answer.text
        assert f'value="{name}" required' in answer.text
        assert not password or password not in answer.text
        client.app.state.site.attempts._failures.clear()  # type: ignore[attr-defined]
    answer = sign_in(client)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"].lower()
    assert cookie.startswith("__host-pbl_session=")
    assert all(part in cookie for part in ("secure", "httponly", "samesite=strict", "path=/"))
    assert "domain" not in cookie
    page = client.get("/visits")
    assert page.status_code == 200
    assert page.headers["strict-transport-security"]
    assert client.get("/operate").status_code == 403  # A is a reader
    kept = client.cookies["__Host-pbl_session"]
    post(client, "/leave")
    client.cookies.set("__Host-pbl_session", kept)
    assert client.get("/visits").status_code == 401


def test_a_session_is_never_the_browsers_choice_and_the_old_one_ends(known: Accounts, tables: None):
    client = browser(known)
    client.cookies.set("__Host-pbl_session", "planted")
    answer = sign_in(client)
    assert answer.status_code == 303
    first = answer.headers["set-cookie"].partition("=")[2].partition(";")[0]
    assert "planted" not in first
    sessions = client.app.state.site.sessions  # type: ignore[attr-defined]
    assert sessions.find("planted") is None
    client.cookies.clear()
    client.cookies.set("__Host-pbl_session", first)
    assert sign_in(client, "O", WORDS + " 2").status_code == 303
    assert sessions.find(first) is None  # another person at the same browser is not in the session of the one before


def test_a_session_ends_by_itself_and_with_its_account(known: Accounts, tables: None):
    now = [0.0]
    sessions = Sessions(clock=lambda: now[0], idle_hours=IDLE_HOURS, still=known.current)
    client = browser(known, sessions)
    sign_in(client)
    for _ in range(3):  # each request keeps it
        now[0] += 3600 * IDLE_HOURS - 1
        assert client.get("/visits").status_code == 200
    now[0] += 3600 * IDLE_HOURS + 1
    assert client.get("/visits").status_code == 401
    sign_in(client)
    known.set_password("A", "another pass phrase")
    assert client.get("/visits").status_code == 401
    sign_in(client, "A", "another pass phrase")
    assert client.get("/visits").status_code == 200
    Accounts(known.path).remove("A")  # by another process
    assert client.get("/visits").status_code == 401


def test_a_form_elsewhere_signs_nobody_in(known: Accounts):
    client = browser(known)
    for headers in ({"origin": "https://evil.example"}, {"origin": "null"}, {"sec-fetch-site": "cross-site"}):
        assert sign_in(client, **headers).status_code == 403
    assert sign_in(client, origin=BASE).status_code == 303
    assert client.get("/visits", headers={"host": "127.0.0.1"}).status_code == 400
    assert client.get("/visits", headers={"host": "gait.example.evil"}).status_code == 400


def test_a_file_that_is_damaged_meanwhile_lets_nobody_in(known: Accounts, tables: None):
    client = browser(known)
    sign_in(client)
    known.path.write_text("{}")
    assert client.get("/visits").status_code == 401
    late = sign_in(browser(known))
    assert late.status_code == 409
    assert "WEB_ACCOUNT" in late.text


# ------------------------------------------------------------------------------------------------------------ guessing
def test_who_guesses_waits_twice_as_long_each_time():
    now = [0.0]
    attempts = Attempts(clock=lambda: now[0])
    waits = []
    for _ in range(12):
        now[0] += attempts.wait_s("A", "192.0.2.1")
        attempts.failed("A", "192.0.2.1")
        waits.append(attempts.wait_s("A", "192.0.2.1"))
    assert waits == [0, 0, 1, 2, 4, 8, 16, 32, 60, 60, 60, 60]
    assert attempts.wait_s("A", "198.51.100.1") == 0  # an address that never failed
    for n in range(3):
        assert attempts.wait_s("A", "198.51.100.2") == 0
        attempts.failed("B" if n else "A", "198.51.100.2")
    assert attempts.wait_s("A", "198.51.100.2") == 60  # one that guesses shares the wait of the account
    assert attempts.wait_s("B", "198.51.100.1") == 0
    for i in range(30):  # many accounts from one address
        attempts.failed(f"person{i}", "192.0.2.1")
    assert attempts.wait_s("B", "192.0.2.1") == 900
    attempts.succeeded("A", "192.0.2.1")
    assert attempts.wait_s("A", "198.51.100.2") == 0
    assert attempts.wait_s("B", "192.0.2.1") == 900  # an account of one's own does not clear the address
    now[0] += Attempts.FORGOTTEN_S + 901
    attempts.failed("B", "192.0.2.1")
    assert attempts.wait_s("B", "192.0.2.1") == 0


def test_the_memory_of_failures_is_bounded():
    attempts = Attempts(clock=lambda: 0.0)
    for i in range(Attempts.MOST):
        attempts.failed(f"x{i}", f"10.0.{i // 256}.{i % 256}")
    assert len(attempts._failures) <= Attempts.MOST


def test_the_page_refuses_before_it_compares(known: Accounts, faults: Faults):
    client = browser(known)
    for _ in range(3):
        assert sign_in(client, "A", "wrong password words").status_code == 401
    compared = faults(Accounts, "check")
    late = sign_in(client)
    assert late.status_code == 429
    assert int(late.headers["retry-after"]) >= 1
    assert "Try again in" in late.text
    assert not compared


def test_a_flood_of_wrong_passwords_does_not_keep_the_right_one_out(known: Accounts, faults: Faults):
    """Wrong passwords of many addresses for one account, at once and before; then the right one from another."""
    faults(Accounts, "check", before=lambda *_: time.sleep(0.05))
    where = Where("127.0.0.1", behind_proxy="127.0.0.1", hostnames=("gait.example",))
    app = create_app(Options(hosts=where.names, accounts=known, secure=True))

    def send(connection: socket.socket, address: str, password: str) -> None:
        body = f"name=A&password={password}"
        form = f"Content-Type: application/x-www-form-urlencoded\r\nContent-Length: {len(body)}"
        lines = ["POST /enter HTTP/1.1", "Host: gait.example", f"X-Forwarded-For: {address}", form, "", body]
        connection.sendall("\r\n".join(lines).encode())

    with running(app, where) as port, contextlib.ExitStack() as stack:
        flood = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(90)]
        for i, connection in enumerate(flood):
            send(connection, f"198.51.100.{i // 3}", "wrong-password-words")
        time.sleep(0.3)
        with socket.create_connection(("127.0.0.1", port), timeout=30) as right:
            send(right, "192.0.2.7", WORDS.replace(" ", "+"))
            assert b"HTTP/1.1 303" in right.recv(65536)
        answers = [connection.recv(65536).split(b" ")[1] for connection in flood]
    assert answers.count(b"401") == 90


def test_the_language_is_chosen_over_tls_alone(known: Accounts, tables: None):
    client = browser(known)
    sign_in(client)
    for language, expected in (("de", "de"), ("xx; Domain=evil", "en"), ("", "en")):
        cookie = post(client, "/language", language=language).headers["set-cookie"].lower()
        assert cookie.startswith(f"pbl_language={expected};")
        assert all(part in cookie for part in ("secure", "httponly", "samesite=strict", "path=/"))


def test_an_unknown_name_takes_as_long_as_a_known_one(known: Accounts, faults: Faults):
    asked = faults(accounts, "_key")
    known.check("A", "wrong password words")
    known.check("nobody", "wrong password words")
    assert asked[0][2:] == asked[1][2:]


# --------------------------------------------------------------------------------------------- where other machines are
@pytest.mark.parametrize(
    ("where", "code", "said"),
    [
        (Where("0.0.0.0"), "WEB_TLS", "without TLS"),
        (Where("192.0.2.1", hostnames=("gait.example",)), "WEB_TLS", "without TLS"),
        (Where("0.0.0.0", tls_cert=Path("c")), "USAGE", "--tls-key"),
        (Where("0.0.0.0", tls_cert=Path("c"), tls_key=Path("k"), behind_proxy="127.0.0.1"), "USAGE", "--tls-key"),
        (Where("0.0.0.0", behind_proxy="127.0.0.1"), "USAGE", "--hostname"),
        (Where("127.0.0.1", behind_proxy="127.0.0.1"), "USAGE", "--hostname"),
        (Where("0.0.0.0", behind_proxy="proxy", hostnames=("gait.example",)), "USAGE", "--behind-proxy proxy"),
        (Where("192.0.2.1", tls_cert=Path("none"), tls_key=Path("none")), "WEB_TLS", "as PEM"),
    ],
)
def test_what_is_not_safe_is_not_served(where: Where, code: str, said: str):
    with pytest.raises(PblError, match=re.escape(said)) as error:
        serve(where)
    assert error.value.code == code


def test_without_accounts_nobody_could_sign_in(tmp_path: Path):
    where = Where("127.0.0.1", 0, behind_proxy="127.0.0.1", hostnames=("gait.example",))
    with pytest.raises(PblError, match="pbl web account add") as error:
        serve(where, accounts=Accounts(tmp_path / "accounts.json"))
    assert error.value.code == "WEB_ACCOUNT"


def test_this_machine_alone_needs_neither():
    Where().check()
    assert Where().names == {"127.0.0.1", "localhost", "::1"}
    assert not Where().by_accounts


def asked(connection: socket.socket, host: str = "gait.example", more: str = "") -> bytes:
    connection.settimeout(10)
    connection.sendall(f"GET /visits HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{more}\r\n".encode())
    parts = []
    while part := connection.recv(65536):
        parts.append(part)
    return b"".join(parts)


@pytest.fixture
def by_tls(tmp_path: Path, environment: Environment) -> Where:
    """A page with a certificate."""
    environment(PBL_HOME=tmp_path)
    return Where("127.0.0.1", 0, *certificates.server_certificate(["gait.example"]), hostnames=("gait.example",))


def secured(address: str, port: int) -> ssl.SSLSocket:
    """A connection by TLS, which trusts the page's authority."""
    plain = socket.create_connection(("127.0.0.1", port), source_address=(address, 0), timeout=20)
    context = ssl.create_default_context(cafile=certificates.authority())
    return context.wrap_socket(plain, server_hostname="gait.example")


def test_tls_is_spoken_and_nothing_else(known: Accounts, by_tls: Where):
    by_tls.check()
    app = create_app(Options(hosts=by_tls.names, accounts=known, secure=True))
    with running(app, by_tls) as port:
        with secured("127.0.0.1", port) as secure:
            assert secure.version() in ("TLSv1.2", "TLSv1.3")
            assert b"401" in asked(secure).split(b"\r\n", 1)[0]
        with socket.create_connection(("127.0.0.1", port)) as plain, contextlib.suppress(ConnectionError):
            assert b"HTTP/1.1" not in asked(plain)


def test_only_the_proxy_is_answered_and_believed(known: Accounts):
    app = create_app(Options(hosts=frozenset({"gait.example"}), accounts=known, secure=True))
    elsewhere = Where("127.0.0.1", behind_proxy="192.0.2.0/24", hostnames=("gait.example",))
    with running(app, elsewhere) as port, socket.create_connection(("127.0.0.1", port)) as other:
        answer = b""
        with contextlib.suppress(ConnectionError):
            answer = asked(other)
        assert answer == b""
    seen = []

    async def tell(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            seen.append(scope["client"][0])
        await app(scope, receive, send)

    forged = "X-Forwarded-For: 198.51.100.7\r\n"
    for where, expected in (
        (Where("127.0.0.1", behind_proxy="127.0.0.1", hostnames=("gait.example",)), "198.51.100.7"),
        (Where("127.0.0.1", hostnames=("gait.example",)), "127.0.0.1"),
    ):
        with running(tell, where) as port, socket.create_connection(("127.0.0.1", port)) as client:
            asked(client, more=forged)
        assert seen[-1] == expected


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_page_that_is_ended_stops_the_database_that_it_started(tmp_path: Path, number: signal.Signals):
    script = """
import contextlib, sys
from pbl_workers.web import Where, serve
@contextlib.contextmanager
def database():
    try:
        yield
    finally:
        print("stopped", flush=True)
sys.modules["pbl_workers.web.serve"].database = database
serve(Where(port=0))
"""
    page = subprocess.Popen([sys.executable, "-u", "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert page.stdout is not None
        port = int(re.findall(r":(\d+)/enter", page.stdout.readline())[0])
        for _ in range(600):  # it listens soon after the link is printed
            with contextlib.suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)) as client:
                assert b"400" in asked(client, host="nothing")
                break
            time.sleep(0.1)
        page.send_signal(number)
        assert "stopped" in page.communicate(timeout=60)[0]
        assert page.returncode == 0
    finally:
        page.kill()


# -------------------------------------------------------------------------------------------------------- slow clients
@pytest.fixture
def given_up() -> threading.Event:
    """Set once an answer of the page `impatient` has ended, whether somebody took it or not."""
    return threading.Event()


@pytest.fixture
def impatient(given_up: threading.Event, limits: Limits) -> Iterator[int]:
    """A page that waits for half a second."""
    limits(connections, REQUEST_S=0.5, TAKE_S=0.5)

    async def large(scope: Any, receive: Any, send: Any) -> None:
        assert scope["type"] != "websocket"
        if scope["type"] != "http":
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(400 if scope["path"] == "/large" else 1):
            await send({"type": "http.response.body", "body": b"x" * 65536, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})
        given_up.set()

    with running(large, Where()) as port:
        yield port


def _is_closed(connection: socket.socket, drip: bytes, within_s: float = 60.0) -> bool:
    """Whether the other side closes, while it is sent a byte now and then."""
    until = time.monotonic() + within_s
    connection.settimeout(0.05)
    while time.monotonic() < until:
        try:
            if drip:
                connection.sendall(drip)
            if connection.recv(1) == b"":
                return True
        except TimeoutError:
            continue
        except ConnectionError:
            return True
    return False


@pytest.mark.parametrize("drip", [b"", b"x"])
def test_a_request_that_never_ends_keeps_no_connection(impatient: int, drip: bytes):
    with socket.create_connection(("127.0.0.1", impatient)) as slow:
        if drip:
            slow.sendall(b"GET / HTTP/1.1\r\nX: ")
        with socket.create_connection(("127.0.0.1", impatient)) as quick:  # others are served meanwhile
            assert b"200" in asked(quick)[:20]
        assert _is_closed(slow, drip)
    with socket.create_connection(("127.0.0.1", impatient)) as again:  # nor does a second one on the same connection
        again.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert again.recv(1 << 20)
        again.sendall(b"GET / HTTP/1.1\r\nX: ")
        assert _is_closed(again, b"")


def test_an_answer_that_nobody_takes_is_given_up(impatient: int, given_up: threading.Event):
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", impatient))
        slow.sendall(b"GET /large HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        assert given_up.wait(60)
        taken = 0
        slow.settimeout(60)
        with contextlib.suppress(ConnectionError):
            while part := slow.recv(1 << 20):
                taken += len(part)
        assert taken < 400 * 65536
    with socket.create_connection(("127.0.0.1", impatient)) as patient:
        patient.settimeout(60)
        patient.sendall(b"GET /large HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        taken = 0
        while part := patient.recv(1 << 16):
            taken += len(part)
        assert taken > 400 * 65536  # who takes it gets all


async def nothing(scope: Any, receive: Any, send: Any) -> None:
    """A page where nothing is found."""
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 404, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})


def test_one_address_does_not_take_all_connections(impatient: int, limits: Limits):
    limits(SERVER, _OF_ONE=3)

    with running(nothing, Where()) as port, contextlib.ExitStack() as stack:
        held = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(4)]
        held[3].settimeout(60)
        with contextlib.suppress(ConnectionError):
            assert held[3].recv(1) == b""
        held[0].settimeout(0.05)
        with pytest.raises(TimeoutError):
            held[0].recv(1)


@pytest.mark.parametrize("asks", [b"", b"GET /hang HTTP/1.1\r\nHost: x\r\n\r\n"])
def test_a_few_addresses_keep_no_one_out(asks: bytes, limits: Limits):
    """Two addresses that hold every connection, waiting or being answered, lose one to a third; a third loses none."""
    limits(SERVER, _OF_ONE=4, _CONNECTIONS=8)

    async def page(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        if scope["path"] == "/hang":
            await receive()
            await receive()  # until the client leaves
            return
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})

    def connected(stack: contextlib.ExitStack, address: str) -> socket.socket:
        made = stack.enter_context(socket.create_connection(("127.0.0.1", port), source_address=(address, 0)))
        made.settimeout(10)
        return made

    with running(page, Where()) as port, contextlib.ExitStack() as stack:
        patient = connected(stack, "127.0.0.9")
        patient.sendall(b"GET /hang HTTP/1.1\r\nHost: x\r\n\r\n")
        held = [connected(stack, address) for _ in range(4) for address in ("127.0.0.2", "127.0.0.3")]
        for one in held:
            with contextlib.suppress(ConnectionError):
                one.sendall(asks)
        for i in range(3):
            with contextlib.ExitStack() as short:
                assert b" 200 " in asked(connected(short, f"127.0.0.{4 + i}"))[:20]
        closed = sum(_is_closed(one, b"", 0.2) for one in held)
        assert 1 <= closed <= 4, closed
        assert not _is_closed(patient, b"", 0.2)


def client_hello() -> bytes:
    """First message of a handshake."""
    out = ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), out, server_hostname="gait.example").do_handshake()
    return out.read()


@pytest.mark.parametrize("begun", ["nothing", "half a hello", "a hello"])
def test_a_handshake_that_never_ends_keeps_no_connection(impatient: int, by_tls: Where, begun: str):
    """`impatient` is asked for the times that it sets."""
    hello = client_hello()
    sent = {"nothing": b"", "half a hello": hello[: len(hello) // 2], "a hello": hello}[begun]
    with running(nothing, by_tls) as port, socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(sent)
        slow.settimeout(20)
        with contextlib.suppress(ConnectionError):
            while slow.recv(1 << 16):
                continue


def test_handshakes_count_as_connections(by_tls: Where, limits: Limits):
    limits(SERVER, _OF_ONE=4, _CONNECTIONS=10)
    limits(connections, REQUEST_S=60.0)
    with running(nothing, by_tls) as port, contextlib.ExitStack() as stack:

        def held(address: str) -> socket.socket:
            made = socket.create_connection(("127.0.0.1", port), source_address=(address, 0))
            return stack.enter_context(made)

        with secured("127.0.0.9", port) as patient:  # one that was there before
            silent = [held(address) for _ in range(4) for address in ("127.0.0.2", "127.0.0.3")]
            assert _is_closed(held("127.0.0.2"), b"", 5.0)
            with secured("127.0.0.4", port) as other:
                assert b"404" in asked(other)[:20]
            assert 1 <= sum(_is_closed(one, b"", 0.2) for one in silent) <= 3
            assert b"404" in asked(patient)[:20]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("192.0.2.1", "192.0.2.1", True),
        ("192.0.2.1", "192.0.2.2", False),
        ("2001:db8:0:1::1", "2001:db8:0:1:ffff::1", True),
        ("2001:db8:0:1::1", "2001:db8:0:2::1", False),
        ("::ffff:192.0.2.1", "::ffff:192.0.2.2", False),  # a page on all addresses hears IPv4 so
        ("::ffff:192.0.2.1", "192.0.2.1", True),
    ],
)
def test_who_counts_as_one_address(one: str, other: str, same: bool):
    assert (connections.customer(one) == connections.customer(other)) == same
    attempts = Attempts(lambda: 0.0)
    for i in range(20):
        attempts.failed(f"n{i}", one)
    assert (attempts.wait_s("B", other) > 0) == same


def test_no_name_of_a_person_gets_into_a_path_or_a_log(known: Accounts, tables: None, caplog: pytest.LogCaptureFixture):
    number = new_visit("x", "P-SECRET")
    client = browser(known)
    sign_in(client, "my password by mistake", "A")
    sign_in(client)
    assert "P-SECRET" in client.get(f"/visits/{number}").text
    assert "a failed sign-in from" in caplog.text
    assert "mistake" not in caplog.text
    assert WORDS not in caplog.text
    assert "P-SECRET" not in caplog.text
