"""Nightly summary: finished and failed work, workers, free disk space; as text and as a page."""

from __future__ import annotations

import dataclasses
import datetime
import html
from collections import Counter
from pathlib import Path

from pbl_pipeline.code_version import code_version
from pbl_schemas import computed_tables, session, video
from pbl_schemas.reading.status import Status, error_counts, pipeline_status, queue_counts
from pbl_schemas.rows import utc_now


@dataclasses.dataclass(frozen=True)
class Summary:
    """Figures of the time since `since` (UTC): rows per table, new videos and sessions; the state now."""

    since: datetime.datetime
    until: datetime.datetime
    new_videos: int
    new_sessions: int
    done: dict[str, int]
    codes: Counter[str]  # of the jobs in error
    status: Status


def make_summary(hours: float = 24.0) -> Summary:
    """Count the last hours."""
    until = utc_now()
    since = until - datetime.timedelta(hours=hours)
    text = f"'{since:%Y-%m-%d %H:%M:%S}'"
    done = {}
    for table in computed_tables():
        column = next(n for n in table.heading.names if n.endswith("_computed"))
        done[table.__name__] = len(table & f"{column} >= {text}")
    server, codes = video.Video.connection, Counter[str]()
    for (_, code), n in error_counts(server, queue_counts(server)).items():
        codes[code] += n
    return Summary(
        since,
        until,
        len(video.Video & f"video_created >= {text}"),
        len(session.Session & f"session_created >= {text}"),
        done,
        codes,
        pipeline_status(most=0),
    )


def rows(found: Summary) -> list[tuple[str, str]]:
    """Heading and value of each line."""
    state = found.status
    out = [
        ("from, to (UTC)", f"{found.since:%Y-%m-%d %H:%M} to {found.until:%Y-%m-%d %H:%M}"),
        ("new videos", str(found.new_videos)),
        ("new sessions", str(found.new_sessions)),
        ("videos in all", str(state.videos)),
    ]
    for table in state.tables:
        failed = f", {table.error} errors" if table.error else ""
        waits = f", {table.waiting} wait for a choice" if table.waiting else ""
        left = f", {table.pending} pending" if table.pending else ""
        out.append((table.table, f"{found.done[table.table]} new of {table.done}{left}{failed}{waits}"))
    out += [(f"error {code}", str(n)) for code, n in found.codes.most_common()]
    lost = f", {state.workers_lost} lost in the last hour" if state.workers_lost else ""
    out.append(("workers alive", f"{len(state.workers)}{lost}"))
    out += [(f"cron {one.name}", one.text()) for one in state.cron]
    out += [(f"disk {name}", f"{free:.1f} of {total:.1f} GB free") for name, free, total in state.disks]
    return out + [row for machine in state.machines for row in machine.rows()]


def as_text(found: Summary) -> str:
    """Return the summary for a terminal or a mail."""
    width = max(len(name) for name, _ in rows(found))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows(found)) + "\n"


def as_html(found: Summary) -> str:
    """Return the summary as one page without external resources."""
    lines = "".join(f"<tr><th>{html.escape(n)}</th><td>{html.escape(v)}</td></tr>" for n, v in rows(found))
    style = (
        "body{font-family:system-ui,sans-serif;margin:2rem;color:#1a1a1a}table{border-collapse:collapse}"
        "th,td{text-align:left;padding:.3rem 1.2rem .3rem 0;border-bottom:1px solid #ddd;font-weight:normal}"
        "th{color:#555}"
    )
    title = f"PBL, {found.until:%Y-%m-%d}"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{style}</style>'
        f"<h1>{title}</h1><table>{lines}</table><p>pbl-pipeline {html.escape(code_version())}</p></html>\n"
    )


def write(found: Summary, folder: Path) -> list[Path]:
    """Write `summary-DATE.txt` and `.html`."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for ending, text in (("txt", as_text(found)), ("html", as_html(found))):
        path = folder / f"summary-{found.until:%Y-%m-%d}.{ending}"
        path.write_text(text, encoding="utf-8")
        out.append(path)
    return out
