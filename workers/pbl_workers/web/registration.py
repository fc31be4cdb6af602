"""Register visits, send recordings for them, and correct what is stated of them. Each change is a row of Decision."""

from __future__ import annotations

import asyncio
import datetime
import functools
import math
from collections.abc import Mapping, Sequence

from markupsafe import Markup, escape
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline import texts
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.files import VIDEO_ENDINGS
from pbl_pipeline.names import whole_number
from pbl_pipeline.sensors import SEGMENTS
from pbl_pipeline.words import capital
from pbl_schemas import lab
from pbl_schemas.fit import worn_logs
from pbl_schemas.intake import Sensors
from pbl_schemas.intake.uploads import LARGEST_LOG
from pbl_schemas.operations.archive import busy
from pbl_schemas.studies import visit_forms

from .. import browser_uploads
from ..browser_uploads import Arriving, Place, Received
from ..incoming import Copy, check_room
from . import pages, site
from .access import BODY_BYTES, Refused, check_fields, check_token, form_of, sender
from .address import Address, number_of, page
from .connections import MORE_TIME
from .multipart import Part, is_multipart, parts
from .pages import NOTHING, in_field, reader_language
from .tables import on_disk

#: Bytes that are written at a time; seconds in which registration waits for an import of the drop folder.
_BLOCK, _WAIT_S = 2**20, 60.0
_NEXT_STEP = "tell who runs the server"
_on_disk = functools.partial(on_disk, _NEXT_STEP)
_NO_FILE = "no file", "at least one video", "choose a video, then send it"
_NO_LOG = "no file", "logs of sensors", "choose the logs, all of them together"


async def new(
    request: Request, values: Mapping[str, str] | None = None, errors: Mapping[str, PblError] = NOTHING
) -> Response:
    values = {"visit": f"{datetime.datetime.now():%Y-%m-%d}"} if values is None else values  # today where the clinic is
    known = {name: values.get(name, "") for name in (*visit_forms.NEW, "height_m", visit_forms.DISTINCT)}
    longest = {**visit_forms.NEW, "height_m": visit_forms.FACTS["height_m"]}
    more = {"usual_roles": visit_forms.USUAL_ROLES, "populations": await site.ask(request, _populations)}
    return pages.show(request, "new_visit.html", values=known, errors=errors, longest=longest, **more)


async def register(request: Request) -> Response:
    fields = await form_of(request)
    number, errors = await site.ask(request, visit_forms.register_visit, fields, sender(request))
    if errors:
        return await new(request, fields, errors)
    return RedirectResponse(f"/visits/{number}", 303)


async def facts(
    request: Request, values: Mapping[str, str] = NOTHING, errors: Mapping[str, PblError] = NOTHING
) -> Response:
    from pbl_pipeline.gait import ACTIVITIES, PACES

    stored, language = await site.ask(request, visit_forms.facts_form, number_of(request)), reader_language(request)
    numbers = {n: in_field(language, stored.values[n]) for n in ("height_m", "mass_kg")}
    words = {n: texts.coded(language, n, stored.values[n]) for n in ("population", "orthosis")}
    values = {**stored.values, **numbers, **words, **values}
    more = {"longest": visit_forms.FACTS, "choices": {"activity": ACTIVITIES, "pace": PACES}}
    more["populations"] = await site.ask(request, _populations)
    return pages.show(request, "facts.html", facts=stored, values=values, errors=errors, **more)


async def correct(request: Request) -> Response:
    fields = dict(await form_of(request))
    number, seen, reason = number_of(request), fields.pop("seen", ""), fields.pop("reason", "").strip()
    _, errors = await site.ask(request, visit_forms.correct_facts, number, fields, sender(request), seen, reason)
    if errors:
        return await facts(request, fields, errors)
    return RedirectResponse(f"/visits/{number}", 303)


async def upload(request: Request) -> Response:
    return upload_page(request, await site.ask(request, browser_uploads.place, number_of(request)), {}, [])


def upload_page(request: Request, to: Place, values: Mapping[str, str], outcomes: Sequence[Received]) -> Response:
    from pbl_pipeline.gait import ACTIVITIES, PACES

    values = {"activity": "walking", "pace": "", "segment": "", **values}
    more = {"choices": {"activity": ACTIVITIES, "pace": PACES}, "accepted": ", ".join(VIDEO_ENDINGS)}
    more |= {"segments": SEGMENTS, "words": functools.partial(words, reader_language(request))}
    return pages.show(request, "upload.html", to=to, values=values, outcomes=outcomes, **more)


def words(language: str, one: Received) -> Markup:
    """Return what was done with a file that was sent, or why it is refused and what to do."""
    on_page = functools.partial(texts.on_page, language)
    if one.error is None:
        done = texts.text(language, f"upload.{'registered' if one.status == 'registered' else 'known'}")
        return Markup("{}: {}").format(done, on_page(one.note)) if one.note else escape(done)
    if one.error.found.startswith("a photo"):
        return escape(texts.text(language, "upload.photo"))
    if not one.worn and (name := f"upload.{one.error.code}") in texts.catalogue():
        return Markup("{} ({})").format(texts.text(language, name), on_page(one.error.found))
    found, more = on_page(one.error.found), on_page(one.error.next_step, False) or on_page(one.error.next_step)
    return Markup("{}. {}.").format(found if one.name else capital(found), capital(more.rstrip(".")))


async def send(request: Request) -> Response:
    if not is_multipart(request):
        await form_of(request)
        raise Refused("form")
    to = await site.ask(request, browser_uploads.place, number_of(request), sender(request))
    stated, outcomes = await received(request, to)
    if all(one.status == "registered" and not one.note for one in outcomes):
        return RedirectResponse(f"/visits/{to.session_id}", 303)
    return upload_page(request, to, stated, outcomes)


async def received(request: Request, to: Place) -> tuple[dict[str, str], list[Received]]:
    """Take in the files of a form; returns what it states of them, and their outcomes. Of a phone, which has no token,
    logs of wearable sensors alone. Raises as `_receive`."""
    request.scope.get(MORE_TIME, lambda: None)()
    await _on_disk(check_room, whole_number(request.headers.get("content-length", "0")) or 0, _NEXT_STEP)
    arriving: list[Arriving] = []
    try:
        fields, outcomes, whole = await _receive(request, to, arriving)
        stated = {name: fields[name][:100] for name in ("activity", "pace", "segment") if name in fields}
        if (segment := stated.get("segment", "")) not in ("", *SEGMENTS):
            raise Refused("form")
        of_visit = await site.ask(request, worn_logs, {"session_id": to.session_id})
        good, worn, refused = await _on_disk(browser_uploads.check, whole, segment, of_visit)
        outcomes += refused
        if not whole and not outcomes:
            nothing = PblError("USAGE", *(_NO_LOG if "segment" in stated else _NO_FILE))
            outcomes.append(Received("", "refused", error=nothing, worn="segment" in stated))
        outcomes += await taken_in(request, to, good, worn, stated)
    finally:
        for one in arriving:
            await asyncio.to_thread(one.discard)
    return stated, outcomes


async def taken_in(
    request: Request, to: Place, good: list[tuple[Arriving, Copy]], worn: Sensors, stated: Mapping[str, str]
) -> list[Received]:
    for _ in range(int(_WAIT_S) if good or worn else 0):
        about = stated.get("activity", ""), stated.get("pace", "")
        done = await site.ask(request, browser_uploads.register, to, good, worn, *about)
        if done is not None:
            return done
        await asyncio.sleep(1.0)
    names = [one.name for one, _ in good] + [one.file.name for one in worn.imu]
    return [
        Received(name, "refused", error=busy("send it again in some minutes", name)) for name in dict.fromkeys(names)
    ]


ROUTES = [
    *page("/visits/new", new, "decide"),
    Address("/visits/new", register, "decide", methods=["POST"]),
    *page("/visits/{session_id:int}/facts", facts, "look"),
    Address("/visits/{session_id:int}/facts", correct, "decide", methods=["POST"]),
    *page("/visits/{session_id:int}/upload", upload, "decide"),
    Address("/visits/{session_id:int}/upload", send, "decide", methods=["POST"]),
]


async def _receive(
    request: Request, to: Place, arriving: list[Arriving]
) -> tuple[dict[str, str], list[Received], list[tuple[Arriving, Copy]]]:
    """Return the fields of a form, the files that are refused immediately, and those that are on disk.

    `arriving` gets every file that was begun. Nothing is written before the form's token was read (not of a phone).

    Raises `Refused` "token", "form", "size"; `PblError` USAGE, UPLOAD_REFUSED, FILE_UNWRITABLE.
    """
    fields: dict[str, bytearray] = {}
    outcomes: list[Received] = []
    whole: list[tuple[Arriving, Copy]] = []
    text: bytearray | None = None
    file: Arriving | None = None
    kept = bytearray()
    check = functools.partial(check_token, request) if to.link is None else lambda _: None
    left = math.inf if to.link is None else LARGEST_LOG  # bytes that may still come

    async def end() -> None:
        if file is not None:
            await _on_disk(file.write, bytes(kept))
            whole.append((file, await _on_disk(file.finish)))

    async for found in parts(request):
        if isinstance(found, bytes):
            if (left := left - len(found)) < 0:
                much = said("logs of more than {n:.0f} MB", n=LARGEST_LOG / 1e6)
                raise PblError("UPLOAD_REFUSED", much, "fewer at a time", "leave out what is not of this visit")
            if text is not None:
                text += found
                if len(text) > BODY_BYTES:
                    raise Refused("size")
            elif file is not None:
                kept += found
                if len(kept) >= _BLOCK:
                    await _on_disk(file.write, bytes(kept))
                    kept.clear()
            continue
        await end()
        text, file = None, None
        kept.clear()
        if found.file is None:
            text = fields[found.name] = bytearray()
        elif found.file:  # an empty one: nothing was chosen
            check(fields.get("token", bytearray()).decode(errors="replace"))
            if to.link is not None and found.name != "worn":
                raise Refused("form")
            file = await _begin(to, found, outcomes)
            arriving += [] if file is None else [file]
    await end()
    stated = {name: bytes(value).decode(errors="replace") for name, value in fields.items()}
    check(stated.pop("token", ""))
    check_fields(stated)
    return stated, outcomes, whole


async def _begin(to: Place, part: Part, outcomes: list[Received]) -> Arriving | None:
    """Return the file that begins; one that is refused becomes an outcome, and its bytes are not kept."""
    assert part.file is not None
    check_fields({part.name: part.file})
    try:
        return await _on_disk(Arriving, to, part.file, part.name == "worn")
    except PblError as error:
        if error.code != "UPLOAD_REFUSED":
            raise
        outcomes.append(Received(str(error.key), "refused", error=error))
        return None


def _populations() -> list[str]:
    return [str(p) for p in lab.Population().to_arrays("population") if p != "unknown"]
