"""Frame rate of the 3D view of `pbl web`.

    python -m research.benchmarks.web_3d               # 2,000 frames at 1280 x 720 in a Chromium without windows

Needs `pip install -e .[browser]` and a Chromium of the machine. Without a graphics processor the browser draws in
software; the renderer is printed. Bar: 50 frames a second. "drawn" waits after each frame until it is finished;
"shown" draws a frame each time the browser asks for one, which it does at most 60 times a second. "processor_ms" is
what a frame takes of all of the browser's processes together (mean of both), which says what idle processors would do
while other processes compute. "shown" comes first: a canvas whose pixels were read is shown at half the rate.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import click
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from pbl_pipeline.body import load_body
from pbl_pipeline.visit import Recording
from pbl_workers import web
from pbl_workers.web.movement import Movement
from tests.walking_fit import walking_fit

PAGE = '<!doctype html><link rel="stylesheet" href="/static/page.css"><canvas></canvas>'
DRAW = """
async ([width, height]) => {
  const [{ Poses }, { Space, THREE_AT }] = await Promise.all(["body", "space"].map((n) => import(`/static/${n}.js`)));
  const m = await (await fetch("/movement")).json();
  const poses = new Poses(m.body, await (await fetch("/body")).arrayBuffer(), m.time.length);
  const space = new Space(document.querySelector("canvas"), m, poses, await import(THREE_AT));
  space.resize(width, height);
  const n = m.time.length;
  let frame = 0, first = 0, last = 0;
  await new Promise((done) => {
    const tick = (now) => {
      first ||= now;
      last = now;
      space.orbit.turn(0.003, 0);
      space.draw(frame++);
      if (frame < n) requestAnimationFrame(tick); else done();
    };
    requestAnimationFrame(tick);
  });
  const gl = space.renderer.getContext(), pixel = new Uint8Array(4);
  const draw = (frame) => { space.draw(frame); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); };
  for (let frame = 0; frame < 50; frame++) draw(frame);
  const begun = performance.now();
  for (let frame = 0; frame < n; frame++) draw(frame);
  const drawn = 1000 * n / (performance.now() - begun);
  const about = gl.getExtension("WEBGL_debug_renderer_info"), { triangles, calls } = space.renderer.info.render;
  return { drawn, shown: 1000 * (n - 1) / (last - first), triangles, calls, renderer: gl.getParameter(about.UNMASKED_RENDERER_WEBGL) };
}
"""  # noqa: E501


def app_of(n_frames: int) -> Starlette:
    """The page's scripts over a walk of so many frames."""
    body, files = load_body(), Path(web.__file__).parent
    found = Movement.of(Recording.of("walk", walking_fit(body.joint_names, body.sha256, n_frames=n_frames)))

    async def page(request: Request) -> Response:
        return HTMLResponse(PAGE)

    async def movement(request: Request) -> Response:
        return Response(found.movement, media_type="application/json")

    async def numbers(request: Request) -> Response:
        return Response(found.body, media_type="application/octet-stream")

    static = [Mount(f"/{name}", StaticFiles(directory=files / name)) for name in ("static", "vendor")]
    return Starlette(routes=[Route("/", page), Route("/movement", movement), Route("/body", numbers), *static])


@contextlib.contextmanager
def served(app: Starlette) -> Iterator[str]:
    """Address of an application on this machine."""
    listening = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def processor_s() -> float:
    """Seconds that all processes below this one, the browser's among them, have computed."""
    parent, used = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            pid = int(stat.parent.name)
            parent[pid], used[pid] = int(fields[1]), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def below(pid: int) -> bool:
        while pid in parent:
            pid = parent[pid]
            if pid == os.getpid():
                return True
        return False

    return sum(s for pid, s in used.items() if below(pid))


@click.command()
@click.option("--frames", default=2000, show_default=True)
@click.option("--size", default=(1280, 720), show_default=True, type=(int, int))
def main(frames: int, size: tuple[int, int]) -> None:
    """Draw the walk and print the figures as JSON."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, served(app_of(frames)) as address:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(address)
        before = processor_s()
        found = page.evaluate(DRAW, list(size))
        found["processor_ms"] = 1000 * (processor_s() - before) / (2 * frames)
        browser.close()
    click.echo(json.dumps({k: round(v, 1) if isinstance(v, float) else v for k, v in found.items()}))


if __name__ == "__main__":
    main()
