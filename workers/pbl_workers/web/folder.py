"""A folder that `pbl run` wrote, or one of such folders, as the source of the pages."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from pbl_pipeline import settings
from pbl_pipeline.change import result_of
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import VIDEO_ENDINGS
from pbl_pipeline.visit import FIT, OVERLAY, REPORT, SESSION, Held, Recording, Visit, load_visit, name_of_fit
from pbl_pipeline.words import MEASURES
from pbl_schemas.reading.shown import Pooled, ShownCheck, ShownRecording, ShownVisit, video_facts
from pbl_schemas.reading.visit_list import INCOMPLETE, Page, VisitRow
from pbl_schemas.subject_codes import day_of

from . import pages, site
from .access import REPORT_POLICY
from .address import Address, interval, number_of, page
from .source import Source

if TYPE_CHECKING:
    from pbl_pipeline.gait import Measure

#: Most visits of a folder, and how deep in it they are looked for.
_MOST, _DEEP = 1000, 3
#: Visits that are kept in memory at a time.
_KEPT = 4


@dataclasses.dataclass(frozen=True)
class _Place:
    """Name and folder of a visit, and the numbers of its recordings here."""

    name: str
    path: Path
    recordings: dict[str, int]


class ResultsFolder(Source):
    """Visits below a folder, each a folder with a `session.json` or, of a run that was ended, with fits alone.

    Raises `PblError` FILE_MISSING if no results are in it.

    `path`: of `pbl run --out`, or a folder of such folders. `videos`: folder of the recordings, which are found by
    their names (None: beside the results and in the folder above).
    """

    def __init__(self, path: Path, videos: Path | None = None) -> None:
        found = sorted(_visits(path, _DEEP))[:_MOST]
        if not found:
            expected = "a folder that `pbl run` wrote, or a folder of such folders"
            next_step = "`pbl run VIDEO --out FOLDER`, then `pbl web --folder FOLDER`"
            raise PblError("FILE_MISSING", f"no {SESSION} and no fit in {path}", expected, next_step, key=str(path))
        self._videos, number = videos, 0
        self._places: dict[int, _Place] = {}
        for i, folder in enumerate(found, 1):
            names = [name_of_fit(fit) for fit in sorted(folder.glob(f"*.{FIT}"))]
            name = folder.relative_to(path).as_posix() if folder != path else folder.resolve().name
            self._places[i] = _Place(name, folder, {n: number + j for j, n in enumerate(names, 1)})
            number += len(names)
        self._load = functools.lru_cache(_KEPT)(self._read)

    def listed(self) -> Page:
        """Return a line for each visit; one whose files cannot be read keeps its line, with the error."""
        return Page(tuple(self._row(number) for number in self._places), None, len(self._places))

    def visit(self, number: int, result: int) -> ShownVisit:
        """Return as `Source.visit`. Raises `PblError` FILE_MISSING, FILE_FORMAT for files that cannot be read."""
        visit, row = self._visit(number), self._row(number)
        checks = visit.checks if visit.judged is None else visit.judged.checks
        return ShownVisit(
            row=row,
            recordings=visit.recordings,
            load_visit=Held(visit),
            load_pooled=functools.partial(_pooled, visit),
            measures=_measures(visit),
            tasks=_tasks(visit),
            lacks=visit.lacks,
            results=() if row.result is None else (dataclasses.replace(row.result, filming=visit.filming),),
            shown=None if row.result is None else 0,
            checks=tuple(ShownCheck(i, check, None) for i, check in enumerate(checks, 1)),
        )

    def recording(self, number: int) -> ShownRecording:
        """Return as `Source.recording`. Raises as `visit`."""
        of, _ = self._of_recording(number)
        visit = self._visit(of)
        found = next((r for r in visit.recordings if r.number == number), None)
        if found is None:
            raise _unknown("recording", number)
        return ShownRecording(
            found,
            number,
            of,
            subject=_subject(visit),
            label=self._places[of].name,
            pictures=visit.kind != "markers",
            **(video_facts(found) or _facts_of_fit(found)),
        )

    def state(self, number: int) -> Hashable:
        """Return a value that changes with the fit of a recording and with its measures."""
        of, name = self._of_recording(number)
        return name, str(self._places[of].path), self._changed(of)

    def video(self, number: int) -> Path:
        """Return the video. Raises `PblError` DB_NOT_FOUND; VIDEO_MISSING if it is not found.

        Also where only pictures with hidden heads may be shown (PBL_DEIDENTIFY).
        """
        of, name = self._of_recording(number)
        results = self._places[of].path
        if how := settings.deidentify_how():
            raise _no_video(
                name,
                f"PBL_DEIDENTIFY={how}: the recording is not shown",
                "look at the video with the body drawn in, which `pbl run` made of a copy with hidden heads",
            )
        wanted = {f"{name}{end}".lower() for end in VIDEO_ENDINGS}
        for folder in (self._videos,) if self._videos else (results, results.parent):
            for file in sorted(folder.iterdir()) if folder.is_dir() else ():
                if file.name.lower() in wanted and file.is_file():
                    return file
        raise _no_video(
            name,
            f"no {name}.mp4, .mov, ... beside the results",
            "copy the recording beside its results; below is the video with the body drawn in",
        )

    def overlay(self, number: int) -> Path:
        """Return the video with the body drawn over it. Raises `PblError` DB_NOT_FOUND, VIDEO_MISSING."""
        of, name = self._of_recording(number)
        path = self._places[of].path / f"{name}.{OVERLAY}"
        if not path.is_file():
            raise _no_video(path.name, f"no {path.name}", "`pbl run` again")
        return path

    def report(self, number: int) -> Path:
        """Return the report. Raises `PblError` DB_NOT_FOUND if there is none."""
        path = self._place(number).path / REPORT
        if not path.is_file():
            raise _unknown("report of visit", number)
        return path

    def to_export(self, number: int, result: int) -> Visit:
        """Return a visit. Raises as `visit`."""
        return self._visit(number)

    def _place(self, number: int) -> _Place:
        if number not in self._places:
            raise _unknown("visit", number)
        return self._places[number]

    def _of_recording(self, number: int) -> tuple[int, str]:
        """Return the number of the visit of a recording, and the recording's name."""
        for of, place in self._places.items():
            for name, own in place.recordings.items():
                if own == number:
                    return of, name
        raise _unknown("recording", number)

    def _visit(self, number: int) -> Visit:
        return self._load(number, self._changed(number))

    def _changed(self, number: int) -> tuple[tuple[str, int], ...]:
        """Return the files of a visit, any of which may be read, and when they were written."""
        return tuple((p.name, p.stat().st_mtime_ns) for p in sorted(self._place(number).path.iterdir()))

    def _read(self, number: int, changed: tuple[tuple[str, int], ...]) -> Visit:
        place = self._places[number]
        visit = load_visit(place.path)
        recordings = tuple(dataclasses.replace(r, number=place.recordings.get(r.name)) for r in visit.recordings)
        return dataclasses.replace(visit, recordings=recordings)

    def _row(self, number: int) -> VisitRow:
        place = self._place(number)
        try:
            visit, problem = self._visit(number), ""
        except PblError as error:
            visit, problem = None, f"{error.code}: {error.found}. {error.next_step}"
        state = "failed" if visit is None else INCOMPLETE if visit.measures is None else "computed"
        return VisitRow(
            session_id=number,
            subject="" if visit is None else _subject(visit),
            label=place.name,
            day=None if visit is None else day_of(visit.date),
            role="",
            videos=len(place.recordings) if visit is None else len(visit.recordings),
            state=state,
            problem=problem,
            result=None if visit is None else result_of(visit),
            more=0,
            trend=None,
        )


def _folder(request: Request) -> ResultsFolder:
    found = site.of(request).source
    assert isinstance(found, ResultsFolder)
    return found


async def visits(request: Request) -> Response:
    listed = await site.ask(request, _folder(request).listed)
    more = {"bad": False, "older": "", "newest": "", "is_first": True, "interval": interval}
    return pages.show(request, "visits.html", page=listed, choices={}, **more)


async def report(request: Request) -> Response:
    path, headers = _folder(request).report(number_of(request)), {"content-security-policy": REPORT_POLICY}
    return FileResponse(path, media_type="text/html; charset=utf-8", headers=headers)


async def overlay(request: Request) -> Response:
    return FileResponse(await site.ask(request, _folder(request).overlay, number_of(request)), media_type="video/mp4")


#: Addresses that a folder answers in its own way: the list, and files that are there already.
ROUTES = [
    *page("/visits", visits, "look"),
    Address("/visits/{session_id:int}/report", report, "look", look="report"),
    Address("/recordings/{video_id:int}/overlay", overlay, "look", look="overlay"),
]


def _pooled(visit: Visit) -> Pooled | None:
    scale = None if visit.solution is None else visit.solution.scale
    found = visit.measures
    return None if found is None else Pooled(found.cycles, scale, visit.kinetics)


def _measures(visit: Visit) -> dict[str, tuple[Measure | None, str]]:
    """Return each measure by its name, with the reason where it is not known; nothing before they are computed."""
    if visit.measures is None:
        return {}
    found = visit.measures.spatiotemporal
    return {n: (found[n], found.reasons.get(n, "")) for n in MEASURES if n in found.measures or n in found.reasons}


def _tasks(visit: Visit) -> dict[str, dict[str, tuple[Measure | None, str]]]:
    """Return the measures of tasks by the recording's name, as `_measures`."""
    found = {r.name: r.measured.spatiotemporal for r in visit.recordings if r.measured is not None}
    return {
        name: {n: (m, s.reasons.get(n, "")) for n, m in s.of_task.items()} for name, s in found.items() if s.of_task
    }


def _subject(visit: Visit) -> str:
    return "" if visit.subject == "-" else visit.subject


def _facts_of_fit(recording: Recording) -> dict[str, Any]:
    """Return what `video_facts` returns, from the fit: files of an older version have no facts of the video."""
    fit = recording.fit
    if fit is None or not fit.image_size_px[0]:
        return {}
    width, height = (int(v) for v in fit.image_size_px)
    duration = float(fit.time_s[-1] - fit.time_s[0])
    return {"duration_s": duration, "n_frames": len(fit.time_s), "width_px": width, "height_px": height}


def _visits(path: Path, deep: int) -> Iterator[Path]:
    """Folders of visits: this one and those below it, without following links."""
    if not path.is_dir():
        return
    if (path / SESSION).is_file() or any(path.glob(f"*.{FIT}")):
        yield path
    if deep:
        for folder in sorted(path.iterdir()):
            if folder.is_dir() and not folder.is_symlink():
                yield from _visits(folder, deep - 1)


def _unknown(what: str, number: int) -> PblError:
    return PblError(
        "DB_NOT_FOUND",
        found=f"no {what} {number} in this folder",
        expected="one that the list leads to",
        next_step="open the list; after another `pbl run` start the page again",
    )


def _no_video(key: str, found: str, next_step: str) -> PblError:
    expected = "the recording that the results were made of"
    return PblError("VIDEO_MISSING", found=found, expected=expected, next_step=next_step, key=key)
