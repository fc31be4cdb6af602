"""Windows of real browsers with a pointer and a camera: Chromium through Playwright, Firefox through WebDriver BiDi.

Playwright 1.65 starts a Firefox that is not its own build too, but asks it for `emulation.setMediaFeaturesOverride`,
which Firefox 153 does not have.
"""

import contextlib
import functools
import itertools
import json
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import pytest

#: Middle of the first link or button of a name that can be seen and clicked; null where there is none.
FOUND = """(name) => {
  for (const e of document.querySelectorAll("a, button")) {
    if (e.textContent.trim() !== name || !e.checkVisibility()) continue;
    e.scrollIntoView({block: "center"});
    const [r] = e.getClientRects();
    const at = [r.x + r.width / 2, r.y + r.height / 2];
    if (e.contains(document.elementFromPoint(...at))) return at;
  }
  return null;
}"""


class Window(Protocol):
    """One window. `evaluate` calls a function of JavaScript with one argument."""

    def goto(self, address: str) -> None: ...
    def evaluate(self, function: str, arg: Any = None) -> Any: ...
    def click_at(self, x: float, y: float) -> None: ...
    def choose_file(self, selector: str, path: Path) -> None: ...


def until(found: Callable[[], Any], what: object, seconds: float = 300.0) -> Any:
    """Wait for something that is true; a page that is just being replaced answers nothing."""
    end, last = time.monotonic() + seconds, None
    while time.monotonic() < end:
        try:
            if last := found():
                return last
        except Exception as error:  # noqa: BLE001  of either driver
            last = error
        time.sleep(0.1)
    raise AssertionError((what, last))


def click(window: Window, name: str) -> None:
    """Click the link or button of this name."""
    window.click_at(*until(lambda: window.evaluate(FOUND, name), name))


class Chromium:
    """A window of a Chromium of Playwright."""

    def __init__(self, browser: Any, width: int, height: int) -> None:
        size = {"width": width, "height": height}
        self.page = browser.new_context(ignore_https_errors=True, locale="en", viewport=size).new_page()

    def goto(self, address: str) -> None:
        self.page.goto(address)

    def evaluate(self, function: str, arg: Any = None) -> Any:
        return self.page.evaluate(function, arg)

    def click_at(self, x: float, y: float) -> None:
        self.page.mouse.click(x, y)

    def choose_file(self, selector: str, path: Path) -> None:
        self.page.set_input_files(selector, path)


class Firefox:
    """A window of a Firefox, with its own cookies."""

    def __init__(self, send: Callable[..., Any], width: int, height: int) -> None:
        self._send = send
        user = send("browser.createUserContext")["userContext"]
        self._context = send("browsingContext.create", type="window", userContext=user)["context"]
        size = {"width": width, "height": height}
        send("browsingContext.setViewport", context=self._context, viewport=size)

    def goto(self, address: str) -> None:
        """Open a page, and the one to which its script may go at once: to wait for the first would then fail."""
        self.evaluate("() => { globalThis.before = true; }")
        self._send("browsingContext.navigate", context=self._context, url=address, wait="none")
        there = "() => !globalThis.before && document.readyState === 'complete'"
        until(functools.partial(self.evaluate, there), address)

    def evaluate(self, function: str, arg: Any = None) -> Any:
        told = self._send(
            "script.callFunction",
            functionDeclaration=f"async () => JSON.stringify(await ({function})({json.dumps(arg)}))",
            target={"context": self._context}, awaitPromise=True,
        )  # fmt: skip
        assert told["type"] == "success", told
        return json.loads(told["result"].get("value", "null"))

    def click_at(self, x: float, y: float) -> None:
        steps = [{"type": "pointerMove", "x": round(x), "y": round(y)}]
        steps += [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        pointer = {"type": "pointer", "id": "mouse", "actions": steps}
        self._send("input.performActions", context=self._context, actions=[pointer])

    def choose_file(self, selector: str, path: Path) -> None:
        locator = {"type": "css", "value": selector}
        found = self._send("browsingContext.locateNodes", context=self._context, locator=locator)
        element = {"sharedId": found["nodes"][0]["sharedId"]}
        self._send("input.setFiles", context=self._context, element=element, files=[str(path)])


@contextlib.contextmanager
def firefox() -> Iterator[Callable[[int, int], Firefox]]:
    """Start the Firefox of the machine, whose camera is a picture that moves and is allowed."""
    connect = pytest.importorskip("websockets.sync.client").connect
    if (program := shutil.which("firefox")) is None:
        pytest.skip("there is no Firefox on this machine")
    settings = {
        "media.navigator.streams.fake": True, "media.navigator.permission.disabled": True, "remote.active-protocols": 1,
        "intl.accept_languages": "en", "browser.shell.checkDefaultBrowser": False, "app.update.enabled": False,
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="pbl-firefox-") as profile, contextlib.ExitStack() as opened:
        lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});" for name, value in settings.items()]
        (Path(profile) / "user.js").write_text("\n".join(lines))
        words = [program, "--headless", "--no-remote", "--profile", profile, "--remote-debugging-port", "0"]
        process = opened.enter_context(
            subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        )
        opened.callback(process.terminate)
        assert process.stderr
        address = next(m[1] for line in process.stderr if (m := re.search(r"listening on (ws://\S+)", line)))
        socket = opened.enter_context(connect(f"{address}/session", max_size=None))
        numbers = itertools.count(1)

        def send(method: str, **params: Any) -> Any:
            number = next(numbers)
            socket.send(json.dumps({"id": number, "method": method, "params": params}))
            while (told := json.loads(socket.recv(120))).get("id") != number:
                pass
            assert told["type"] == "success", (method, told)
            return told["result"]

        send("session.new", capabilities={"alwaysMatch": {"acceptInsecureCerts": True}})
        yield lambda width, height: Firefox(send, width, height)
        send("session.end")
