"""A study as one folder of tidy CSV files, with new codes for its persons if wanted."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from pbl_pipeline.bounded import MAX_ROWS, MIB, read_bytes, read_json
from pbl_pipeline.csv_cells import frame_to_csv, unquoted_frame
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.files import check_out_folder
from pbl_pipeline.paramset import structured

from .types import FRAMES, StudyData, StudyDescription

_missing = functools.partial(
    os_errors_as,
    "FILE_MISSING",
    "the folder of a study: study.json, visits.csv, ... (docs/study.md)",
    "check the path, and that all files of the folder were copied",
)
_format = functools.partial(PblError, "FILE_FORMAT")


def deidentified(study: StudyData) -> tuple[StudyData, pd.DataFrame]:
    """Replace the codes of a study, and return it with the key: `subject, visit, new_subject, new_visit`.

    Persons are numbered in random order, and each person's visits V1, V2, ... in order of their days, since a visit is
    often named by its date. Rows are sorted by the new codes. Columns of `visits` beyond those of `FRAMES` are dropped.
    `reason` and the texts of the description are kept: read them before you pass the study on, and keep the key apart.
    """
    visits: Any = study.visits.sort_values(["subject", "days", "visit"])
    persons = list(dict.fromkeys(visits["subject"]))
    secrets.SystemRandom().shuffle(persons)
    width = max(3, len(str(len(persons))))
    codes = {old: f"P{i:0{width}d}" for i, old in enumerate(persons, 1)}
    key: Any = visits[["subject", "visit"]].assign(
        new_subject=visits["subject"].map(codes),
        new_visit=[f"V{n}" for n in visits.groupby("subject").cumcount() + 1],
    )

    def renamed(name: str, frame: Any) -> Any:
        columns = [c.name for c in FRAMES[name]]
        if "visit" not in columns:
            return frame
        new = frame[columns].merge(key, on=["subject", "visit"])
        new = new.assign(subject=new["new_subject"], visit=new["new_visit"])[columns]
        return new.sort_values(["subject", "visit"], kind="stable", ignore_index=True)

    changed = {name: renamed(name, getattr(study, name)) for name in FRAMES}
    return dataclasses.replace(study, **changed), key.sort_values(["new_subject", "new_visit"], ignore_index=True)


FORMAT = "pbl-study-1"
_ABOUT, _DICTIONARY, _SCRIPT = "study.json", "dictionary.csv", "make_report.py"
#: Most bytes of a file that is read; curves are wide.
_MAX_BYTES = {"curves": 128 * MIB}
_MAX_HEADER = 64 * 1024
#: Format of numbers; curves have a thousandth of a degree.
_DIGITS = {"curves": "%.6g"}


def write_study(study: StudyData, folder: str | Path) -> list[Path]:
    """Write a study as `<frame>.csv`, `dictionary.csv`, `study.json` and `make_report.py`; return the paths.

    Numbers have 8 digits, curves 6. The folder is made; files of these names in it are replaced.

    Raises `PblError` FILE_UNWRITABLE.
    """
    folder = Path(folder)
    check_out_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    contents = {f"{name}.csv": _csv(name, getattr(study, name)) for name in FRAMES}
    about = {
        "format": FORMAT,
        "n_subjects": study.n_subjects,
        "n_visits": study.n_visits,
        **{k: dict(v) if isinstance(v, Mapping) else v for k, v in vars(study.description).items()},
        "files": {name: _sha256(data) for name, data in contents.items()},
    }
    contents[_DICTIONARY] = frame_to_csv(data_dictionary(study), "%.8g").encode()
    contents[_SCRIPT] = (Path(__file__).with_name("templates") / "make_report.py.txt").read_bytes()
    contents[_ABOUT] = (json.dumps(about, indent=1, ensure_ascii=False) + "\n").encode()
    paths = []
    for name, data in contents.items():
        paths.append(folder / name)
        paths[-1].write_bytes(data)
    return paths


def read_study(folder: str | Path) -> StudyData:
    """Read the folder of `write_study`.

    Raises `PblError` FILE_MISSING: no such folder, no `study.json` or a file that it names. FILE_FORMAT: a file that
    cannot be read, is too large, or has not the SHA-256 in `study.json` (without the key `files` none is compared).
    STUDY_INVALID: as `StudyData`, and numbers of persons or visits that differ from those of `study.json`.
    """
    folder = Path(folder)
    about = _about(folder / _ABOUT)
    sums = about.get("files")
    frames: dict[str, Any] = {}
    for name in FRAMES:
        path = folder / f"{name}.csv"
        if name != "visits" and not path.exists() and not (sums and path.name in sums):
            continue
        data = _read(path, _MAX_BYTES.get(name, 32 * MIB))
        if sums is not None and sums.get(path.name) != _sha256(data):
            raise _format(
                "another content than study.json names",
                "the file as it was written",
                "copy the folder again; if the change is meant, remove the key files from study.json",
                path,
            )
        frames[name] = _frame(path, name, data)
    try:
        fields = {f.name for f in dataclasses.fields(StudyDescription)}
        description = structured({k: v for k, v in about.items() if k in fields}, StudyDescription)
    except (TypeError, ValueError) as error:
        raise _format(str(error), "the fields of docs/study.md", "export the study again", folder / _ABOUT) from error
    try:
        study = StudyData(**frames, description=description)
    except PblError as error:
        parts = {"found": error.found, "expected": error.expected, "next_step": error.next_step}
        raise PblError(error.code, **parts, key=folder / f"{error.key}.csv") from error
    for name in ("n_subjects", "n_visits"):
        if name in about and about[name] != getattr(study, name):
            raise PblError(
                "STUDY_INVALID",
                found=f"{name} {about[name]} in study.json, {getattr(study, name)} in visits.csv",
                expected="the same number",
                next_step="copy the folder again; if the change is meant, remove that key from study.json",
                key=folder,
            )
    return study


def data_dictionary(study: StudyData) -> pd.DataFrame:
    """Describe the columns of each file, in rows of `file, column, kind, unit, meaning`."""
    rows = [
        {"file": f"{n}.csv", "column": c.name, "kind": c.kind, "unit": c.unit, "meaning": c.meaning}
        for n, columns in FRAMES.items()
        for c in columns
    ]
    known = {c.name for c in FRAMES["visits"]}
    rows += [
        {"file": "visits.csv", "column": name, "kind": "", "unit": "", "meaning": "carried along from the source"}
        for name in study.visits
        if name not in known
    ]
    return pd.DataFrame(rows)


def content_hash(study: StudyData) -> str:
    """First 16 digits of the SHA-256 of the frames as they are written: equal for equal studies."""
    parts = "".join(_sha256(_csv(name, getattr(study, name))) for name in FRAMES)
    return _sha256(parts.encode())[:16]


def _csv(name: str, frame: Any) -> bytes:
    flags = {c.name: frame[c.name].map({True: "true", False: "false"}) for c in FRAMES[name] if c.kind == "flag"}
    return frame_to_csv(frame.assign(**flags), _DIGITS.get(name, "%.8g")).encode()


def _about(path: Path) -> dict[str, Any]:
    try:
        with _missing(path):
            about = read_json(path)
    except ValueError as error:
        raise _format(str(error), "a JSON object", "copy the folder again", path) from error
    if not isinstance(about, dict) or about.get("format") != FORMAT or not isinstance(about.get("files", {}), dict):
        raise _format("another format", f"a study of the format {FORMAT}", "export the study again", path)
    return about


def _read(path: Path, at_most: int) -> bytes:
    try:
        with _missing(path):
            return read_bytes(path, at_most)
    except ValueError as error:
        raise _format(str(error), "a CSV file of a study", "split the study", path) from error


def _frame(path: Path, name: str, data: bytes) -> pd.DataFrame:
    texts: Any = {c.name: str for c in FRAMES[name] if c.kind != "number"}
    try:
        if data.count(b"\n") > MAX_ROWS:
            raise ValueError(f"more than {MAX_ROWS:,} rows")
        if len(data.split(b"\n", 1)[0]) > _MAX_HEADER:
            raise ValueError("a header that is too long")
        read = pd.read_csv(
            io.BytesIO(data), dtype=texts, keep_default_na=False, na_values=[""], encoding="utf-8-sig", low_memory=False
        )
        return unquoted_frame(read)
    except (ValueError, OverflowError) as error:  # pandas' ParserError and UnicodeDecodeError are ValueErrors
        raise _format(f"{error}"[:200], "a CSV file as docs/study.md describes it", "copy it again", path) from error


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
