"""Links to where a person at a page does what an error or a check asks for, by its code."""

from __future__ import annotations

import re

from pbl_pipeline.errors import CALL, CODES, INPUT, MACHINE

#: Words of a link, which are those of what it leads to -> its address.
PLACES = {
    "decide.person": "/recordings/{recording}#decide",
    "byhand.title": "/recordings/{recording}#correct",
    "usable.mark": "/recordings/{recording}#usable",
    "upload.open": "/visits/{visit}/upload",
    "register.facts": "/visits/{visit}/facts",
    "compute.again": "/visits/{visit}#compute",
    "film.back": "/visits/{visit}",
    "visits.title": "/visits",
}
_OF_CAUSE = {INPUT: ("upload.open", "usable.mark"), MACHINE: ("compute.again",), CALL: ()}
#: What is done at the machine that serves: methods, models, norms, calibrations, sheets.
AT_THE_MACHINE = (
    "MODEL_INVALID", "MODEL_CHECKSUM", "NORM_INVALID", "NORM_UNKNOWN", "CALIBRATION_NO_BOARD", "CALIBRATION_FEW_VIEWS",
    "CALIBRATION_POOR", "SHEET_FORMAT", "SHEET_CONFLICT", "STUDY_INVALID", "BACKUP_INVALID", "MARKER_SET_UNKNOWN",
    "SOLVER_UNKNOWN", "USAGE", "WEB_ACCOUNT", "WEB_PORT", "WEB_TLS", "PYTHON_UNSUPPORTED",
)  # fmt: skip
#: Of these a page says what to do in words alone: the form is on it, or the phone shows it.
IN_WORDS = ("UPLOAD_REFUSED", "PHONE_LINK", "DECIDED_MEANWHILE", "WEB_REFUSED", "VIDEO_DUPLICATE", "SCORE_RANGE")
#: Code of an error or name of a check -> words of its links, where its cause does not say it.
WAYS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys((*AT_THE_MACHINE, *IN_WORDS), ()),
    "SUBJECT_NEEDS_CHOICE": ("decide.person",),
    "SUBJECT_UNKNOWN_PERSON": ("decide.person",),
    "VIEWS_DISAGREE": ("decide.person", "usable.mark"),
    "EVENTS_IMPLAUSIBLE": ("byhand.title",),
    "GAIT_INPUT": ("usable.mark",),
    "DB_NOT_FOUND": ("film.back", "visits.title"),
    "subject_choice": ("decide.person",),
    "event_order_breaks": ("byhand.title",),
    "cycles_of_odd_length": ("byhand.title",),
    "body_height_stated": ("register.facts",),
    "lengths_scale": ("register.facts",),
    "kinetics_scale": ("register.facts",),
    "camera_orientation_known": ("upload.open",),
    "gdi_cycles": ("upload.open",),
    "cycles_used": ("upload.open",),
}


def remedies(code: str, visit: int | None, recording: int | None = None) -> list[tuple[str, str]]:
    """Return words (`texts.toml`) and address of each link for an error or a check of a visit or a recording."""
    ways = WAYS[code] if code in WAYS else _OF_CAUSE[CODES[code].cause] if code in CODES else ()
    numbers = {"visit": visit, "recording": recording}
    places = [(way, PLACES[way]) for way in ways]
    return [(w, at.format(**numbers)) for w, at in places if all(f"{{{n}}}" not in at or numbers[n] for n in numbers)]


def remedies_of_path(code: str, path: str) -> list[tuple[str, str]]:
    """Return the links for an error of the page at an address below that of a visit or recording."""
    found = {kind: int(number) for kind, number in re.findall(r"^/(visit|recording)s/(\d+)/", path)}
    return remedies(code, found.get("visit"), found.get("recording"))
