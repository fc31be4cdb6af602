"""A folder of `pbl run` in place of the tables: its visits and recordings, to look at and take along."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from pbl_pipeline import settings
from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError
from schemas.recording_page import RecordingFit, RecordingPage
from schemas.visit_list import Result
from schemas.visit_page import MeasureRow
from schemas.visit_progress import Progress

from .access import REPORT_POLICY
from .find import interval, number_of
from .judge import Judged
from .pages import Pages
from .tables import Asks
from .take import archive_of

if TYPE_CHECKING:
    from pbl_pipeline.export import ExportSession
    from pbl_pipeline.qc import Check

#: Most visits of a folder, and how deep in it they are looked for.
_MOST, _DEEP = 1000, 3
#: Visits whose fits are kept in memory at a time.
_KEPT = 4
#: Endings of a recording that is looked for beside its results.
_VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


@dataclasses.dataclass(frozen=True)
class FolderVisit:
    """The results of one call of `pbl run`. fits: its trials, with the numbers that their recordings have here."""

    number: int
    name: str
    path: Path
    fits: dict[int, Path]


@dataclasses.dataclass(frozen=True)
class FolderVisitPage:
    """A visit with its recordings (number and name), its index, measures and checks."""

    visit: FolderVisit
    recordings: tuple[tuple[int, str], ...]
    result: Result
    measures: tuple[MeasureRow, ...]
    checks: tuple[Check, ...]


class ResultsFolder:
    """Visits below a folder, each a folder with a `session.json` and fits.

    Parameters
    ----------
    path
        Of `pbl run --out`, or a folder of such folders.
    videos
        Where the recordings are looked for, by their names: the results hold none. None: beside the results and in the
        folder above.

    Raises
    ------
    PblError
        FILE_MISSING where no results are in it.
    """

    def __init__(self, path: Path, videos: Path | None = None) -> None:
        found = [p.parent for p in sorted(_sessions(path, _DEEP))][:_MOST]
        if not found:
            raise PblError(
                "FILE_MISSING",
                found=f"no session.json in {path}",
                expected="a folder that `pbl run` wrote, or a folder of such folders",
                next_step="`pbl run VIDEO --out FOLDER`, then `pbl web --folder FOLDER`",
                key=str(path),
            )
        self._videos, number = videos, 0
        self.visits: dict[int, FolderVisit] = {}
        for i, folder in enumerate(found, 1):
            fits = {}
            for fit in sorted(folder.glob("*.fit.npz")):
                fits[number := number + 1] = fit
            name = folder.relative_to(path).as_posix() if folder != path else folder.resolve().name
            self.visits[i] = FolderVisit(i, name, folder, fits)
        self._session = functools.lru_cache(_KEPT)(self._load)

    def session(self, visit: FolderVisit) -> ExportSession:
        """Fits, keypoints, events, cycles and measures of a visit, as `pbl gait` computes them; kept for a while."""
        return self._session(visit.number, tuple(path.stat().st_mtime_ns for path in visit.fits.values()))

    def _load(self, number: int, changed: tuple[int, ...]) -> ExportSession:
        from pbl_pipeline.cli.gait import fit_checks
        from pbl_pipeline.export import session_of_files
        from pbl_pipeline.fit import TrialFit

        paths = list(self.visits[number].fits.values())
        checks = fit_checks(paths, [TrialFit.load(path) for path in paths])
        return session_of_files(paths, fit_checks=checks)

    def visit(self, number: int) -> FolderVisit:
        """A visit by its number. Raises `PblError` DB_NOT_FOUND for a number that none has."""
        if number not in self.visits:
            raise _unknown("visit", number)
        return self.visits[number]

    def _of_recording(self, number: int) -> tuple[FolderVisit, Path]:
        for visit in self.visits.values():
            if number in visit.fits:
                return visit, visit.fits[number]
        raise _unknown("recording", number)

    def page(self, number: int) -> FolderVisitPage:
        """A visit, as its metrics.json has it. Raises `PblError` DB_NOT_FOUND, FILE_MISSING, FILE_FORMAT."""
        visit = self.visit(number)
        names = tuple((n, _name(path)) for n, path in visit.fits.items())
        return FolderVisitPage(visit, names, *_measured(visit.path / "metrics.json"))

    # -------------------------------------------------------------------------- recordings, as `look.Recordings` has it
    def about(self, number: int) -> RecordingPage:
        """A recording by its number. Raises `PblError` DB_NOT_FOUND, and what `session_of_files` raises."""
        visit, path = self._of_recording(number)
        trial = self.session(visit).trials[list(visit.fits).index(number)]
        (width, height), time = trial.fit.image_size_px, trial.fit.time_s
        return RecordingPage(
            video_id=number,
            name=trial.name,
            session_id=visit.number,
            subject="",
            label=visit.name,
            codec="",
            width=width or None,
            height=height or None,
            duration=float(time[-1] - time[0]),
            n_frames=len(time),
            has_pictures=width > 0,
            hidden_heads="",
            key={"fit": path.name},
            problem="",
            lead=None,
            events=trial.measured.events.events if trial.measured and trial.measured.events else (),
        )

    def path(self, number: int) -> Path:
        """The recording itself. Raises `PblError` DB_NOT_FOUND; VIDEO_MISSING where it is not found, and where only
        pictures with hidden heads may be shown (PBL_DEIDENTIFY)."""
        _, fit = self._of_recording(number)
        name = _name(fit)
        if how := settings.deidentify_how():
            raise _no_video(
                name,
                f"PBL_DEIDENTIFY={how}: the recording is not shown",
                "look at the video with the body drawn in, which `pbl run` made of a copy with hidden heads",
            )
        wanted = {f"{name}{end}".lower() for end in _VIDEOS}
        for folder in (self._videos,) if self._videos else (fit.parent, fit.parent.parent):
            for file in sorted(folder.iterdir()) if folder.is_dir() else ():
                if file.name.lower() in wanted and file.is_file():
                    return file
        raise _no_video(
            name,
            f"no {name}.mp4, .mov, ... beside the results",
            "start the page with --videos and the folder of the recordings; below is the video with the body drawn in",
        )

    def drawn(self, number: int) -> Path:
        """The video with the body drawn in. Raises `PblError` DB_NOT_FOUND, VIDEO_MISSING."""
        _, fit = self._of_recording(number)
        path = fit.with_name(f"{_name(fit)}.overlay.mp4")
        if not path.is_file():
            raise _no_video(path.name, f"no {path.name}", "`pbl run` again")
        return path

    def state(self, number: int) -> Hashable:
        """What tells apart what was fitted to a recording."""
        _, path = self._of_recording(number)
        return str(path), path.stat().st_mtime_ns

    def load(self, number: int) -> RecordingFit:
        """The fitted movement of a recording. Raises what `session_of_files` raises."""
        visit, _ = self._of_recording(number)
        trial = self.session(visit).trials[list(visit.fits).index(number)]
        measured = trial.measured
        events = measured.events.events if measured and measured.events else ()
        return RecordingFit(trial.fit, events, measured.cycles if measured else (), trial.keypoints)

    def people(self, about: RecordingPage) -> tuple[list[Any], list[str]]:
        """Nobody can be chosen: results hold one person."""
        return [], []

    def judged(self, number: int) -> Judged:
        """Nothing is decided about results in a folder."""
        return Judged(None, "", 0, None)

    def progress(self, session_id: int) -> Progress:
        return Progress(session_id, 0, (), ())


def routes(pages: Pages, files: Asks, folder: ResultsFolder) -> list[Route]:
    """The addresses of the visits of a folder."""

    async def visits(request: Request) -> Response:
        rows = [await files.ask(_line, folder, number) for number in folder.visits]
        return pages.show(request, "folder.html", rows=rows, interval=interval)

    async def visit(request: Request) -> Response:
        about = await files.ask(folder.page, number_of(request))
        return pages.show(request, "folder_visit.html", about=about, interval=interval)

    async def report(request: Request) -> Response:
        found = folder.visit(number_of(request))
        path = found.path / "report.html"
        if not path.is_file():
            raise _unknown("report of visit", found.number)
        headers = {"content-security-policy": REPORT_POLICY}
        return FileResponse(path, media_type="text/html; charset=utf-8", headers=headers)

    async def overlay(request: Request) -> Response:
        return FileResponse(await files.ask(folder.drawn, number_of(request)), media_type="video/mp4")

    async def export(request: Request) -> Response:
        found = folder.visit(number_of(request))
        return await archive_of(await files.ask(folder.session, found), f"visit_{found.number}.zip")

    return [
        Route("/visits", visits),
        Route("/visits/{number:int}", visit),
        Route("/visits/{number:int}/report", report),
        Route("/visits/{number:int}/export", export),
        Route("/recordings/{number:int}/overlay", overlay),
    ]


def _line(folder: ResultsFolder, number: int) -> tuple[FolderVisit, FolderVisitPage | None, PblError | None]:
    """A visit of the list; one whose files cannot be read keeps its line, with the error."""
    try:
        return folder.visits[number], folder.page(number), None
    except PblError as error:
        return folder.visits[number], None, error


def _sessions(path: Path, deep: int) -> Iterator[Path]:
    """Files `session.json` in a folder and those below it, without following links."""
    if not path.is_dir():
        return
    if (file := path / "session.json").is_file():
        yield file
    if deep:
        for folder in sorted(path.iterdir()):
            if folder.is_dir() and not folder.is_symlink():
                yield from _sessions(folder, deep - 1)


def _measured(path: Path) -> tuple[Result, tuple[MeasureRow, ...], tuple[Check, ...]]:
    """Index, measures and checks of a metrics.json."""
    from pbl_pipeline.gait import Measure
    from pbl_pipeline.paramset import structured
    from pbl_pipeline.qc import PASS, Check
    from pbl_pipeline.words import MEASURES

    if not path.is_file():
        raise PblError(
            "FILE_MISSING",
            found="no metrics.json",
            expected="the files of `pbl run` as it wrote them",
            next_step="`pbl run` again, or `pbl gait *.fit.npz --out metrics.json` in that folder",
            key=str(path),
        )
    try:
        content = read_json(path)
        said = content["session"]
        index, reasons = said["gdi"] or {}, said["reasons"]
        checks = tuple(structured(c, Check) for c in said["qc"])
        result = Result(
            kind="single",
            methods=("", "", str(content["gdi_model"]), str(index.get("norm", ""))),
            status=str(said["status"]),
            reason=str(said["reason"] or reasons.get("gdi", "")),
            index=index.get("mean"),
            sd=index.get("sd"),
            minimal_change=index.get("minimal_change"),
            outcome=str(said["outcome"]),
            worst=tuple(c.check for c in checks if c.outcome == said["outcome"] != PASS),
        )
        rows = tuple(
            MeasureRow(n, None if said.get(n) is None else structured(said[n], Measure), str(reasons.get(n, "")))
            for n in MEASURES
            if n in said
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise PblError(
            "FILE_FORMAT",
            found=f"{type(error).__name__}: {error}",
            expected="a metrics.json that `pbl run` wrote",
            next_step="`pbl run` again",
            key=str(path),
        ) from error
    return result, rows, checks


def _name(fit: Path) -> str:
    return fit.name.removesuffix(".fit.npz")


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
