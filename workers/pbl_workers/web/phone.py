"""Film with a phone: the link of a visit as a QR code, and the phone's page, which sends recordings of that visit."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import logging
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import segno
from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response

from pbl_pipeline import texts
from pbl_pipeline.bounded import parse_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import whole_number
from pbl_pipeline.sensors import SEGMENTS
from pbl_pipeline.words import capital
from pbl_schemas.capture import UPLOADING
from pbl_schemas.intake import phone_recordings
from pbl_schemas.intake.phone_recordings import MOST_HOURS, PART_BYTES, Phone, Sent
from pbl_schemas.intake.protocols import steps_of
from pbl_schemas.operations.archive import UNFINISHED_DAYS
from pbl_schemas.reading.usable import PENDING, Next, Usable, next_pass, usual_seconds
from pbl_schemas.reading.visit_state import RESULTS, state_of

from .. import phone_uploads
from ..browser_uploads import Place
from . import certificates, pages, registration, site
from .access import BODY_BYTES, Refused, form_of, read_body, read_form, sender
from .address import FILM, OPEN, Address, number_of
from .computing import begin as compute
from .pages import reader_language
from .tables import on_disk

if TYPE_CHECKING:
    from pbl_pipeline.keypoints.framing import Framing

#: The phone's page may use its camera and sensors.
_MAY = {
    "permissions-policy": "camera=(self), microphone=(), geolocation=(), accelerometer=(self), gyroscope=(self), "
    "screen-wake-lock=(self)"
}
#: Hours for which a link can be made on the page.
HOURS = ("2", "8")
#: Longer checks are told in minutes (s).
_SECONDS = 90.0
#: Answers that are kept, by visit and language.
_KEPT = 200
_RANGE = re.compile(r"bytes (0|[1-9][0-9]{0,11})-(0|[1-9][0-9]{0,11})/([1-9][0-9]{0,11})")
#: Group of the catalogue with the texts of the script.
_SAID = "capture."
_NEXT_STEP = "tell who runs the server; the recording stays on the phone until there is room"
_on_disk = functools.partial(on_disk, _NEXT_STEP)
#: Recordings of all visits that are put together and opened at a time.
_OPENED_AT_ONCE = 4
#: Longest picture (byte) that is looked at while filming.
_LOOK_BYTES = 262_144
log = logging.getLogger(__name__)


async def make(request: Request) -> Response:
    fields = await form_of(request)
    number, hours = number_of(request), fields.get("hours", "")
    if hours not in HOURS:
        raise Refused("form")
    make_link = functools.partial(phone_recordings.make_link, protocol=fields.get("protocol") or None)
    link, key = await site.ask(request, make_link, number, sender(request), float(hours))
    page = f"{request.url.scheme}://{request.headers['host']}/phone"
    address, secure = f"{page}/open?key={key}", request.url.scheme == "https"
    trust = qr_code(f"{page}/authority.crt") if certificates.authority().is_file() else ""
    shown = {"number": number, "link": link, "address": address, "hours": hours, "secure": secure, "trust": trust}
    return pages.show(request, "film.html", code=qr_code(address), **shown)


async def end(request: Request) -> Response:
    fields = await form_of(request)
    number = number_of(request)
    if (link := whole_number(fields.get("link", ""))) is None:
        raise Refused("form")
    await site.ask(request, phone_recordings.end_link, number, link)
    return RedirectResponse(f"/visits/{number}#film", 303)


async def ask(request: Request) -> Response:
    """Ask whether this is the phone: what only looks at an address (a preview, HEAD) does not take the link."""
    key = request.query_params.get("key", "")
    if await site.ask(request, phone_recordings.is_open, key, site.of(request).phone_cookie.of(request)):
        return RedirectResponse("/phone", 303)
    return pages.show(request, "open.html", key=key)


async def opened(request: Request) -> Response:
    key, mine = (await read_form(request)).get("key", ""), site.of(request).phone_cookie.of(request)
    cookie = await site.ask(request, phone_recordings.use_link, key, mine)
    response = RedirectResponse("/phone", 303)
    if cookie is not None:
        site.of(request).phone_cookie.set(response, cookie, int(3600 * MOST_HOURS))
    return response


async def page(request: Request) -> Response:
    from pbl_pipeline.gait import ACTIVITIES, PACES

    every = texts.catalogue()
    said = {
        **{f"is_{name}": {k: capital(v) for k, v in every[f"library.{name}"].items()} for name in ACTIVITIES},
        **{f"is_{name}": every[f"library.{name}"] for name in PACES},
        **{name.removeprefix(_SAID): own for name, own in every.items() if name.startswith(_SAID)},
    }
    usual = usual_words(reader_language(request), await site.ask(request, usual_seconds))
    values = {"phone": request.state.phone, "words": json.dumps(said), "usual": usual, "part_bytes": PART_BYTES}
    values["segments"] = SEGMENTS
    return pages.show(request, "capture.html", 200, _MAY, **values)


async def begin(request: Request) -> Response:
    try:
        stated = parse_json((await _body(request, "application/json", BODY_BYTES)).decode())
    except ValueError:
        raise Refused("form") from None
    sent = await site.ask(request, phone_recordings.begin, request.state.phone, stated)
    return await told(request, sent)


async def part(request: Request) -> Response:
    sent = await recording(request)
    found = _RANGE.fullmatch(request.headers.get("content-range", ""))
    if found is None:
        raise Refused("form")
    number = phone_uploads.check_part(sent, *(int(n) for n in found.groups()))
    body = await _body(request, "application/octet-stream", PART_BYTES)
    if len(body) != int(found[2]) - int(found[1]) + 1:
        raise phone_recordings.upload_refused("a part of another length than it states")
    sha256 = request.headers.get("x-sha256", "")
    await _on_disk(phone_uploads.keep_part, request.state.phone, sent, number, body, sha256)
    try:
        sent = await recording(request)
    except PblError as error:
        await removed(request, sent, error)
        raise
    if sent.state != UPLOADING:  # it was finished while this part came again
        await asyncio.to_thread(phone_uploads.discard, request.state.phone, sent)
    return Response(status_code=204)


async def recording(request: Request) -> Sent:
    return await site.ask(request, phone_recordings.recording, request.state.phone, number_of(request))


async def removed(request: Request, sent: Sent, error: PblError) -> None:
    """Remove the parts of a recording whose visit was removed while they came."""
    if error.code == "DB_NOT_FOUND":
        await asyncio.to_thread(phone_uploads.discard, request.state.phone, sent)


async def told(request: Request, sent: Sent) -> Response:
    if sent.state != UPLOADING:  # here alone: also those that a killed server left, when the phone asks again
        await asyncio.to_thread(phone_uploads.discard, request.state.phone, sent)
    missing = await _on_disk(phone_uploads.missing, request.state.phone, sent)
    if len(missing) == sent.n_parts:
        begun = await site.ask(request, phone_recordings.begun_bytes, UNFINISHED_DAYS)
        try:
            await _on_disk(phone_uploads.check_promised, begun, _NEXT_STEP)
        except PblError:
            await site.ask(request, phone_recordings.not_begun, sent.number)
            await asyncio.to_thread(phone_uploads.discard, request.state.phone, sent)
            raise
    return JSONResponse({**_shown(reader_language(request), sent, None), "missing": missing})


async def worker(request: Request) -> Response:
    """Serve a script of a separate thread below the page's address, so that it is also available offline."""
    path = Path(__file__).parent / "static" / f"capture_{request.url.path.rpartition('/')[2]}"
    return FileResponse(path, media_type="text/javascript", headers={"service-worker-allowed": "/phone"})


async def authority(request: Request) -> Response:
    if not certificates.authority().is_file():
        raise HTTPException(404)
    return FileResponse(certificates.authority(), media_type="application/x-x509-ca-cert", filename="laboratory.crt")


async def worn(request: Request) -> Response:
    """Take logs of wearable sensors, as the page that adds recordings to a visit does."""
    phone: Phone = request.state.phone
    to = Place(phone.session_id, phone.subject, phone.label, phone.by, phone.link)
    _, outcomes = await registration.received(request, to)
    if any(one.status == "registered" for one in outcomes):
        with contextlib.suppress(PblError):  # others wait
            compute(request, phone.session_id, False)
    said = functools.partial(registration.words, reader_language(request))
    told = [{"name": one.name, "taken": one.error is None, "said": said(one).striptags()} for one in outcomes]
    return JSONResponse({"outcomes": told})


class Phones:
    """Views that remember: what was said of the last visits, and which recordings are being finished."""

    def __init__(self) -> None:
        #: Answers by visit and language, and the gain of one more pass by visit, with the rows that they are of.
        self._said: dict[tuple[int, str], tuple[dict[str, str], tuple[bytes, str]]] = {}
        self._worth: dict[int, tuple[list[str | None], Next | None]] = {}
        #: Of each visit one recording at a time is finished; of all, as many are opened at once.
        self._finishing: WeakValueDictionary[int, asyncio.Lock] = WeakValueDictionary()
        self._opening = asyncio.Semaphore(_OPENED_AT_ONCE)
        #: One picture at a time is looked at.
        self._looking = asyncio.Lock()

    async def state(self, request: Request) -> Response:
        phone: Phone = request.state.phone
        body, tag = await site.ask(request, self._answer, phone.session_id, reader_language(request))
        headers = {"etag": tag}
        if tag in request.headers.get("if-none-match", ""):  # a proxy may have called it weak
            return Response(status_code=304, headers=headers)
        return Response(body, media_type="application/json", headers=headers)

    def _answer(self, session_id: int, language: str) -> tuple[bytes, str]:
        """Return what a phone is told of its visit, and the tag of that text."""
        rows = state_of(session_id)
        if (kept := self._said.get((session_id, language))) is not None and kept[0] == rows:
            return kept[1]
        if len(self._said) >= _KEPT:
            self._said.clear()
            self._worth.clear()
        results = [rows.get(name) for name in RESULTS]
        if session_id not in self._worth or self._worth[session_id][0] != results:
            self._worth[session_id] = results, next_pass(session_id)
        sent = phone_recordings.recordings(session_id)
        missing = texts.text(language, "worn.missing") if phone_recordings.log_missing(session_id, sent) else ""
        told = {
            "visit": session_id,
            "recordings": [_shown(language, one, judged) for one, judged in sent],
            "checked": sum(judged is not None and judged.state == PENDING for _, judged in sent),
            "next": f"{missing} {next_words(language, self._worth[session_id][1])}".strip(),
            "protocol": [dataclasses.asdict(step) for step in steps_of(session_id, sent)],
        }
        body = json.dumps(told).encode()
        self._said[session_id, language] = rows, (body, f'"{hashlib.sha256(body).hexdigest()[:32]}"')
        return self._said[session_id, language][1]

    async def look(self, request: Request) -> Response:
        """Say what a picture cuts off of the person; 204 where another one is being looked at. It is not kept."""
        body = await _body(request, "image/jpeg", _LOOK_BYTES)
        if self._looking.locked():
            return Response(status_code=204)
        async with self._looking:
            return JSONResponse({"cut": await asyncio.to_thread(self._cut_off, body)})

    @functools.cached_property
    def _framing(self) -> Framing | None:
        """The networks that look, once a picture came; None if they are not on this machine."""
        from pbl_pipeline.keypoints.framing import Framing

        try:
            return Framing()
        except PblError as error:
            log.warning("no hint while filming, until the next start: %s", error.short())
            return None

    def _cut_off(self, picture: bytes) -> str | None:
        from pbl_pipeline.keypoints.framing import read_picture

        image = read_picture(picture)
        if image is None:
            raise Refused("form")
        return None if self._framing is None else self._framing.cut_off(image)

    async def finish(self, request: Request) -> Response:
        await _body(request, "application/json", BODY_BYTES)
        phone: Phone = request.state.phone
        async with self._finishing.setdefault(phone.session_id, asyncio.Lock()):
            sent = await recording(request)
            if sent.state == UPLOADING:
                try:
                    async with self._opening:
                        copies = await _on_disk(phone_uploads.put_together, phone, sent)
                    await site.ask(request, phone_uploads.register, phone, sent, copies)
                except PblError as error:
                    await _on_disk(phone_uploads.remove_joined, phone, sent)
                    if not error.final:
                        if error.code == "MACHINE_SHORT":
                            log.warning("recording %d of visit %d: %s", sent.number, phone.session_id, error.short())
                            await site.ask(request, phone_recordings.not_yet, sent.number, error)
                        await removed(request, sent, error)
                        raise
                    await site.ask(request, phone_recordings.refused, sent.number, error)
                else:
                    with contextlib.suppress(PblError):  # others wait: its jobs are the first in the queue
                        compute(request, phone.session_id, False)
        return await told(request, await recording(request))


def routes() -> list[Address]:
    phones = Phones()
    return [
        Address("/visits/{session_id:int}/film", make, "decide", methods=["POST"]),
        Address("/visits/{session_id:int}/film/end", end, "decide", methods=["POST"]),
        Address("/phone/open", ask, OPEN),
        Address("/phone/open", opened, OPEN, methods=["POST"]),
        Address("/phone", page, FILM),
        Address("/phone/offline.js", worker, OPEN),
        Address("/phone/store.js", worker, OPEN),
        Address("/phone/authority.crt", authority, OPEN),
        Address("/phone/state.json", phones.state, FILM),
        Address("/phone/look.json", phones.look, FILM, methods=["POST"]),
        Address("/phone/recordings.json", begin, FILM, methods=["POST"]),
        Address("/phone/recordings/{phone_recording:int}.json", part, FILM, methods=["PUT"]),
        Address("/phone/sensors.json", worn, FILM, methods=["POST"]),
        Address("/phone/finish/{phone_recording:int}.json", phones.finish, FILM, methods=["POST"]),
    ]


def verdict(language: str, judged: Usable | None) -> str:
    """Return in a sentence whether a recording can be used; empty of one that is not registered."""
    if judged is None:
        return ""
    why = [texts.library_words(language, said) for said in judged.said]
    if judged.cycles is not None and not any(judged.cycles):
        why.append(texts.text(language, "capture.no_cycles"))
    said = texts.text(language, f"capture.{judged.state}", why="; ".join(why))
    if judged.cycles is not None and any(judged.cycles):
        left, right = judged.cycles
        said = f"{said}. {texts.text(language, 'capture.cycles', left=left, right=right)}"
    return said.removesuffix(".") + "."


def usual_words(language: str, seconds: float | None) -> str:
    """Return how long a check usually takes, in a sentence; empty if that is not known."""
    if seconds is None:
        return ""
    minutes = seconds > _SECONDS
    n = math.ceil(seconds / 60.0) if minutes else max(5, 5 * round(seconds / 5.0))
    return texts.text(language, "capture.usual_min" if minutes else "capture.usual_s", n=n)


def next_words(language: str, more: Next | None) -> str:
    """Return what one more pass would bring, in two sentences; empty if that is not known."""
    if more is None:
        return ""
    now = texts.text(language, "capture.index", now=f"{more.now:.0f}")
    if round(more.then) >= round(more.now):
        return now
    return f"{now} {texts.text(language, f'capture.next_{more.side}', then=f'{more.then:.0f}')}"


def qr_code(address: str) -> Markup:
    """Return a QR code as SVG, black on white in light and dark."""
    out = io.BytesIO()
    code = segno.make(address, error="m", micro=False)
    code.save(out, kind="svg", border=4, light="#fff", dark="#000", xmldecl=False, svgclass="qr", lineclass=None,
              omitsize=True)  # fmt: skip
    return Markup(out.getvalue().decode())  # noqa: S704  made here, of nothing but squares


async def _body(request: Request, kind: str, most: int) -> bytes:
    """Return the body of a request. Raises `Refused` for another type, or more bytes than `most`."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != kind:
        raise Refused("form")
    announced = whole_number(request.headers.get("content-length", "0"))
    if announced is None or announced > most:
        raise Refused("size")
    return await read_body(request, most)


def _shown(language: str, sent: Sent, judged: Usable | None) -> dict[str, Any]:
    why = texts.library_words(language, sent.error.found) if sent.error else ""
    return {
        "number": sent.number,
        "sha256": sent.sha256,
        "state": sent.state,
        "error": sent.error.short() if sent.error else "",
        "about": sent.about,
        "verdict": texts.text(language, "capture.refused", why=why) if why else verdict(language, judged),
    }
