"""README.md, docs/web.md and docs/capture.md read to the letter: each in an empty folder with an empty home.

Every command of the pages runs as it is printed, in order, and what their numbered lists print in bold is pressed on
the page that `pbl web` serves, until the letter is there, or the phone's recording. This is done without a browser, in
a Chromium at 390 and 1280 px, and in a Firefox. Beside ELSEWHERE only this differs:

- `walk.mp4` is a small film of coloured frames; stand-ins detect and fit;
- visit 3 is visit 1 here, the port is a free one, and `pbl capture link` names the address that `pbl web` printed;
- `cert.pem` and `key.pem`, which an institution has, are made here; `clinic.csv` is the sheet in docs/capture.md;
- without a browser links are followed, forms sent, and the phone's recording is sent as its script sends it;
- a browser has a camera that shows a moving picture, and takes any certificate.
"""

import contextlib
import functools
import hashlib
import html
import os
import re
import shutil
import signal
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import httpx2
import pytest

from pbl_schemas.operations import embedded
from pbl_workers.web import certificates
from tests import Environment, database, pages, windows
from tests.source import ROOT
from tests.videos import constant_rate, numbered_frames, write_video

pytestmark = [pytest.mark.slow, pytest.mark.database, database.embedded_only]

PAGES = ("README.md", "docs/web.md", "docs/capture.md")
#: Page and command of those that are not run there, and where or why.
ELSEWHERE = {
    ("README.md", "make demo"): "tests/end_to_end/test_demo.py",
    ("README.md", "make test"): "it runs this",
    ("README.md", ". .venv/bin/activate"): "the environment of the test is active",
    ("docs/web.md", "pbl web --folder results"): "README.md, after `pbl run`",
    ("docs/web.md", "pbl web --tls"): "docs/capture.md",
}
#: What is not pressed here, and where or why.
UNPRESSED = {
    "Open the camera": "on an iPhone alone",
    "Delete and film again": "instead of Keep and send",
}
#: Real browsers and the width and height (px) of their windows.
BROWSERS = {
    "Chromium 390": (390, 844),
    "Chromium 1280": (1280, 900),
    "Firefox 390": (390, 844),
    "Firefox 1280": (1280, 900),
}
#: On the page of a visit with an index.
RESULT = '<span class="big">'
NOTHING: Mapping[str, str] = MappingProxyType({})
PASSWORD = "correct horse battery staple"
#: `pbl`, which detects and fits by stand-ins.
STAND_IN = f"""#!{sys.executable}
import sys
sys.path.insert(0, {str(ROOT)!r})
if __name__ != "__main__" or sys.argv[1] in ("run", "populate"):  # also in the processes of `pbl web`
    import pytest
    from tests.integration import chain
    chain.install(pytest.MonkeyPatch())
if __name__ == "__main__":
    from pbl_pipeline.cli import main
    main()
"""


def printed(page: str) -> list[str]:
    """The commands of the page's shell blocks, without comments."""
    lines = [line for b in pages.blocks(page) if b.language == "sh" for line in b.code.splitlines()]
    return [command for line in lines if (command := re.sub(r"(^|\s+)#.*", "", line).strip())]


def to_press(page: str) -> list[str]:
    """Bold words of the numbered lists of the page."""
    steps = re.findall(r"^\d+\. .*(?:\n   .*)*", pages.prose(page), re.MULTILINE)
    return [name for step in steps for name in re.findall(r"\*\*(.+?)\*\*", step)]


class Shown(Protocol):
    """One browser; `text` is the page that it shows."""

    @property
    def text(self) -> str: ...
    def open(self, path: str) -> None: ...
    def press(self, name: str, typed: Mapping[str, str] = NOTHING, file: Path | None = None) -> None: ...
    def film(self) -> None: ...


class Browser:
    """A browser without scripts."""

    def __init__(self, address: str, trusted: Path, host: str | None = None) -> None:
        """trusted: certificate of the authority, which need not be there; host: name by which it asks."""
        tls = ssl.create_default_context(cafile=trusted if trusted.exists() else None)
        headers = {"accept-language": "en"} | ({"host": host} if host else {})
        base, ask = httpx2.URL(address).join("/"), {"follow_redirects": True, "trust_env": False, "timeout": 120}
        self.client = httpx2.Client(base_url=base, verify=tls, headers=headers, **ask)
        self.text = ""

    def show(self, answer: httpx2.Response) -> None:
        self.text = answer.text
        assert answer.status_code == 200 or "<h1>Sign in</h1>" in self.text, (answer.url, self.text)

    def open(self, path: str) -> None:
        self.show(self.client.get(path))

    def press(self, name: str, typed: Mapping[str, str] = NOTHING, file: Path | None = None) -> None:
        """Follow the link, or send the form with the button, of this name; wait for the result of a computation."""
        files = {"files": (file.name, file.read_bytes())} if file else None
        if link := re.search(rf'<a [^>]*href="([^"]+)"[^>]*>{re.escape(name)}</a>', self.text):
            self.show(self.client.get(html.unescape(link[1])))
            return
        forms = re.findall(r"<form .*?</form>", self.text, re.DOTALL)
        (form,) = (f for f in forms if f">{name}</button>" in f)
        action = re.search(r'action="([^"]+)"', form)
        assert action
        boxes = re.compile(r'<(input type="(checkbox|radio)"|option)[^>]*>')
        fields = dict(re.findall(r'name="([\w:]+)" value="([^"]*)"', boxes.sub("", form)))
        answer = self.client.post(action[1], data={**fields, **typed}, files=files)
        self.show(answer)
        end = time.monotonic() + 300
        while name == "Compute now" and RESULT not in self.text:
            assert time.monotonic() < end, self.text
            time.sleep(0.5)
            self.open(str(answer.url.path))

    def film(self) -> None:
        """Send a film as the script of the phone's page does, which makes one part of it."""
        film = small_film()
        n, part = len(film), hashlib.sha256(film)
        stated = {"sha256": hashlib.sha256(part.digest()).hexdigest(), "video_bytes": n, "log_bytes": 0}
        number = self.client.post("/phone/recordings.json", json=stated).json()["number"]
        headers = {"content-range": f"bytes 0-{n - 1}/{n}", "x-sha256": part.hexdigest()}
        headers |= {"content-type": "application/octet-stream"}
        answer = self.client.put(f"/phone/recordings/{number}.json", content=film, headers=headers)
        assert answer.status_code == 204, answer.text
        assert self.client.post(f"/phone/finish/{number}.json", json={}).json()["state"] == "received"


class Real:
    """A window of a real browser."""

    def __init__(self, address: str, window: windows.Window) -> None:
        self.base, self.window = address.partition("/enter")[0].rstrip("/"), window

    @property
    def text(self) -> str:
        told = "() => document.readyState === 'complete' && document.documentElement.outerHTML"
        return windows.until(lambda: self.window.evaluate(told), "a page")

    def open(self, path: str) -> None:
        self.window.goto(path if path.startswith("http") else self.base + path)

    def press(self, name: str, typed: Mapping[str, str] = NOTHING, file: Path | None = None) -> None:
        """Click what has this name, with its fields filled in; wait for the next page, or for a computed result."""
        fill = "([name, value]) => { document.querySelector(`[name=${name}]`).value = value; return true; }"
        for field in typed.items():
            windows.until(functools.partial(self.window.evaluate, fill, list(field)), field)
        if file:
            self.window.choose_file("input[type=file]", file)
        self.window.evaluate("() => { globalThis.before = true; }")
        windows.click(self.window, name)
        follow = "() => !globalThis.before && document.readyState === 'complete'"
        windows.until(lambda: self.window.evaluate(follow), name)
        if name == "Compute now":  # the page loads itself
            windows.until(lambda: RESULT in self.text, RESULT)

    def film(self) -> None:
        """Press Start, Stop and Keep and send; wait for the result below the button."""
        windows.click(self.window, "Start")
        filming = "() => document.querySelector('main').dataset.filming === 'yes'"
        windows.until(lambda: self.window.evaluate(filming), "filming")
        time.sleep(3)
        windows.click(self.window, "Stop")
        windows.click(self.window, "Keep and send")
        latest = "() => document.querySelector('.latest').textContent"
        windows.until(lambda: re.match("Usable|Film again:", self.window.evaluate(latest)), "the result")


class Reader:
    """Does what a page prints, in an empty folder with an empty home."""

    def __init__(self, page: str, folder: Path, home: Path, window: Callable[[], windows.Window] | None = None) -> None:
        """window: opens one of a real browser."""
        self.page, self.folder, self.home, self.address, self.window = page, folder, home, "", window
        self.env = {**os.environ, "PBL_HOME": str(home), "PATH": f"{folder.parent / 'bin'}:{os.environ['PATH']}"}
        self.served, self.left, self.last = contextlib.ExitStack(), to_press(page), ""

    @contextlib.contextmanager
    def reading(self) -> Iterator[None]:
        """Do all that the page prints; what its last `pbl web` serves is still there."""
        with self.served:
            for command in printed(self.page):
                if (self.page, command) not in ELSEWHERE:
                    self.do(command)
            assert not self.left
            yield

    def do(self, command: str) -> None:
        """Run a command; `pbl web` until the page prints the next one."""
        here = command.replace("--visit 3", "--visit 1").replace("https://192.168.1.20:8484", self.address)
        if command.startswith("pbl web") and "account" not in command:
            self.served.close()
            self.address = self.served.enter_context(self.serving(f"{here} --port 0"))
            self.look(command)
            return
        done = subprocess.run(
            ["bash", "-c", here], cwd=self.folder, env=self.env, input=f"{PASSWORD}\n" * 2, capture_output=True,
            text=True, start_new_session=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, (command, done.stdout, done.stderr[-2000:])

    @contextlib.contextmanager
    def serving(self, command: str) -> Iterator[str]:
        """Address that `pbl web` prints; Ctrl-C at the end."""
        words = command.split()
        with subprocess.Popen(words, cwd=self.folder, env=self.env, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout
            try:
                said = [process.stdout.readline()]
                while not re.match("open once|Serving", said[-1]):
                    assert said[-1], said
                    said.append(process.stdout.readline())
                port, found = re.search(r":(\d+)", said[-1]), re.search(r"https?://[^\s,]+", said[-1])
                assert port
                yield found[0] if found else f"http://gait.example.org:{port[1]}"
            finally:
                process.send_signal(signal.SIGINT)
                rest = process.stdout.read()
        assert process.returncode == 0, rest

    def browser(self) -> Shown:
        if self.window and "gait.example.org" not in self.address:
            return Real(self.address, self.window())
        if "gait.example.org" not in self.address:
            return Browser(self.address, self.home / "web" / "tls" / "authority.crt")
        # A name that the network of an institution finds.
        scheme, host = self.address.split("://")
        return Browser(f"{scheme}://127.0.0.1:{host.rpartition(':')[2]}", self.folder / "authority.pem", host)

    def look(self, command: str) -> None:
        """Open the address; press there what the page says, the first time."""
        browser = self.browser()
        browser.open(httpx2.URL(self.address).raw_path.decode())
        if "--folder" in command:
            assert "/visits/1" in browser.text
            return
        if "Sign in" in browser.text:
            browser.press("Sign in", {"name": "R.Viewer", "password": PASSWORD})
        assert ("<h1>P017" in browser.text) == ("--visit" in command)
        while self.left:
            browser = self.press(browser, self.left.pop(0))
            self.last = browser.text

    def press(self, browser: Shown, name: str) -> Shown:
        """Press what has this name, with what belongs into the fields before it; the browser in which it goes on."""
        if name in UNPRESSED or name in ("Start", "Stop"):
            assert name in browser.text
        elif name == "Keep and send":
            browser.film()
        elif name == "Send":
            browser.press(name, file=self.folder / "walk.mp4")
        else:
            browser.press(name, {"subject": "P017"} if name == "Register the visit" else NOTHING)
        if name != "Film with a phone":
            return browser
        link, phone = re.search(r"<code>(http[^<]+)", browser.text), self.browser()
        assert link
        phone.open(html.unescape(link[1]))
        if isinstance(phone, Browser):
            phone.press("Film with this phone")  # a script of the page does
        else:
            windows.until(lambda: "data-ready" in phone.text, "the phone's page")
        return phone

    def rows(self, table: str) -> int:
        with embedded.admin(embedded.Folder(self.home / "db")) as connection, connection.cursor() as cursor:
            cursor.execute(f"SELECT COUNT(*) FROM {table}")
            return cursor.fetchone()[0]


@functools.cache
def small_film() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write_video(Path(folder) / "walk.mp4", numbered_frames(240, 360, 640), constant_rate(240)).read_bytes()


@pytest.fixture(params=["", *(pytest.param(name, marks=pytest.mark.long) for name in BROWSERS)])
def window(request: pytest.FixtureRequest) -> Iterator[Callable[[], windows.Window] | None]:
    """Opens windows of a real browser; None where none is needed."""
    name, size = request.param, BROWSERS.get(request.param, (0, 0))
    if "Firefox" in name:
        with windows.firefox() as opened:
            yield lambda: opened(*size)
    elif name:
        browser = request.getfixturevalue("chromium")
        camera = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream", "--no-sandbox"]
        program = shutil.which("chromium") or shutil.which("google-chrome")
        with browser.browser_type.launch(executable_path=program, args=camera) as own:
            yield lambda: windows.Chromium(own, *size)
    else:
        yield None


@pytest.fixture
def reader(
    tmp_path: Path, environment: Environment, window: Callable[[], windows.Window] | None
) -> Iterator[Callable[[str], Reader]]:
    folder, home = tmp_path / "empty", database.new_home()
    for made in (folder, tmp_path / "bin"):
        made.mkdir()
    (tmp_path / "bin" / "pbl").write_text(STAND_IN)
    (tmp_path / "bin" / "pbl").chmod(0o755)
    (folder / "walk.mp4").write_bytes(small_film())
    (sheet,) = (b.code for b in pages.blocks("docs/capture.md") if b.language == "text")
    (folder / "clinic.csv").write_text(sheet)
    environment(PBL_HOME=tmp_path / "institution")
    cert, key = certificates.server_certificate(("gait.example.org", "127.0.0.1"))
    for path, name in ((cert, "cert.pem"), (key, "key.pem"), (certificates.authority(), "authority.pem")):
        shutil.copy(path, folder / name)
    yield lambda page: Reader(page, folder, home, window)
    database.remove_home(home)


def test_readme(reader: Callable[[str], Reader]):
    one = reader("README.md")
    with one.reading():
        assert one.rows("pbl_gdi.`__session_gdi`") == 1
    assert list((one.folder / "results").glob("*.html"))


def test_the_page_from_nothing(reader: Callable[[str], Reader]):
    one = reader("docs/web.md")
    with one.reading():
        assert one.rows("pbl_video.video") == one.rows("pbl_gdi.`__session_gdi`") == 1
        assert "<h1>Letter for the record</h1>" in one.last
        assert RESULT in one.last


def test_filming_from_nothing(reader: Callable[[str], Reader]):
    one = reader("docs/capture.md")
    with one.reading():
        assert one.rows("pbl_video.video") == one.rows("pbl_capture.phone_recording") == 1
        assert one.rows("pbl_video.`~~video_info`") + one.rows("pbl_video.`__video_info`") == 1


def test_no_command_is_overlooked_and_what_is_left_out_is_printed():
    others = [b.code for page in PAGES for b in pages.blocks(page) if b.language != "sh"]
    assert not [command for code in others for command in pages.commands(code)]
    assert set(ELSEWHERE) <= {(page, command) for page in PAGES for command in printed(page)}
    assert set(UNPRESSED) <= {name for page in PAGES for name in to_press(page)}
