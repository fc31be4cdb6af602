"""Sensors that a person names for a visit: on the command line (`shank_r=FILE`), or in a file that lists them."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.errors import PblError, as_said, said, unread_file

from .checked import checked
from .formats.read import read_samples
from .formats.samples import Samples, log_error
from .log import SEGMENTS, SensorLog

#: Words of a sensor's name by which its segment is known.
_WORDS = {
    "pelvis": "pelvis|sacrum|lumbar|waist",
    "thigh": "thigh|femur|upper ?leg",
    "shank": "shank|tibia|lower ?leg|calf|ankle",
    "foot": "foot|calcn|instep",
}
#: Words for directions of a segment, along its axes forward, up and to the right.
_DIRECTIONS = {
    word: sign * np.eye(3)[axis]
    for axis, words in enumerate((("forward", "back"), ("up", "down"), ("right", "left")))
    for word, sign in zip(words, (1.0, -1.0), strict=True)
}
#: Sensors of one recording whose logs overlap by less than this share are not of one recording.
_OVERLAP = 0.5
_TOGETHER = "name all logs of one recording together; `pbl ingest FILE --imu none` takes older ones away"
#: Reads the sensors in a file: `read_samples`, or what remembers them (`functools.cache`).
Read = Callable[[Path, float | None, str | None], Sequence[Samples]]


@dataclasses.dataclass(frozen=True)
class Given:
    """A sensor that a person names. segment: None where the names of the sensors in the file say it; sensor: one of
    several in the file; rate_hz: samples a second, for a file that does not state them; called: name of the file of
    which this one is a copy; mount: where two of its axes point, such as `x up, z back`."""

    file: Path
    segment: str | None = None
    sensor: str | None = None
    rate_hz: float | None = None
    called: str | None = None
    mount: str | None = None

    @property
    def shown(self) -> Path:
        """The name of the file for an error: of the one that was given, not of its copy."""
        return Path(self.called or self.file)


def segment_of(name: str) -> str | None:
    """The segment that the name of a sensor says (`Right Ankle`, `tibia_r_imu`), None if none or several."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|[^a-zA-Z]+", " ", name).lower()
    found = [segment for segment, pattern in _WORDS.items() if re.search(pattern, words)]
    sides = [side for side, pattern in (("r", r"\b(right|r)\b"), ("l", r"\b(left|l)\b")) if re.search(pattern, words)]
    if len(found) != 1 or (found != ["pelvis"] and len(sides) != 1):
        return None
    return "pelvis" if found == ["pelvis"] else f"{found[0]}_{sides[0]}"


def given_sensors(text: str, folder: Path = Path()) -> list[Given]:
    """What `SEGMENT=FILE`, `SEGMENT=FILE#SENSOR` or `FILE` on the command line, or in a sheet of `folder`, means.

    A file without a segment is a list of sensors (`.toml`; `.csv` with the columns segment, file; OpenSense's `.xml`)
    or a log whose sensors have the names of segments.

    Raises `PblError` USAGE for another segment or mount, FILE_MISSING, FILE_FORMAT for a list that cannot be read.
    """
    segment, equals, rest = text.partition("=")
    if equals and "/" not in segment and "\\" not in segment:
        file, _, sensor = rest.partition("#") if not (folder / rest).exists() else (rest, "", "")
        return [Given(folder / file, _known(segment), sensor or None)]
    path = folder / text
    try:
        if path.suffix.lower() == ".toml":
            rows = [(k, v if isinstance(v, dict) else {"file": v}) for k, v in bounded.read_toml(path).items()]
            return _rows(path, [{"segment": k, **v} for k, v in rows])
        if path.suffix.lower() == ".xml":
            return _opensense(path)
        if path.suffix.lower() == ".csv" and b"segment" in bounded.read_start(path, 16):
            text = bounded.read_text(path)
            separator = ";" if ";" in text.split("\n", 1)[0] else ","
            rows = list(csv.DictReader(io.StringIO(text), delimiter=separator, restkey="", restval=""))
            if any(any(row.pop("", ())) for row in rows):
                raise ValueError("a row with more cells than names")
            return _rows(path, [{k.strip(): v.strip() for k, v in row.items()} for row in rows])
    except (OSError, ValueError, KeyError, TypeError, csv.Error, ElementTree.ParseError) as error:
        raise unread_file(error, "a list of sensors and their segments", "see docs/imu.md", path) from error
    return [Given(path)]


def _known(segment: str) -> str:
    if segment not in SEGMENTS:
        unknown = said("a sensor on {segment}", segment=segment)
        raise PblError("USAGE", unknown, ", ".join(SEGMENTS), "name one of these segments")
    return segment


def _rows(path: Path, rows: Sequence[dict[str, Any]]) -> list[Given]:
    """The sensors that the rows of a list name. Raises `PblError` USAGE; KeyError, TypeError, ValueError."""
    out = []
    for row in rows:
        if not row["file"]:
            raise ValueError("a row without a file")
        hz, mount = row.get("rate_hz") or None, str(row.get("mount") or "") or None
        if mount is not None:
            mounting_of(mount)
        segment, sensor = _known(row["segment"]), row.get("sensor") or None
        out.append(Given(path.parent / row["file"], segment, sensor, float(hz) if hz else None, mount=mount))
    if not out:
        raise ValueError("no sensors")
    return out


def mounting_of(mount: str) -> np.ndarray:
    """The rotation (quaternion, scalar first) from a sensor's axes to its segment's, by the directions of two of them:
    `x up, z back`. Raises `PblError` USAGE."""
    text = mount.lower()
    found = dict(pairs := re.findall(r"\b([xyz])\s+([a-z]+)", text))
    rest = re.sub(r"\b[xyz]\s+[a-z]+|[\s,;]", "", text)
    if rest or not len(pairs) == len(found) == 2 or not set(found.values()) <= set(_DIRECTIONS):
        found = {}
    axes = np.zeros((3, 3))
    for axis, word in found.items():
        axes[:, "xyz".index(axis)] = _DIRECTIONS[word]
    (third,) = np.flatnonzero(~axes.any(axis=0)) if found else (0,)
    axes[:, third] = np.cross(axes[:, third - 2], axes[:, third - 1])
    if abs(np.linalg.det(axes) - 1) > 0.01:
        expected = said("where two of its axes point: x, y or z, and {words}", words=", ".join(_DIRECTIONS))
        raise PblError("USAGE", said("a mount {text}", text=mount[:80]), expected, "such as: x up, z back")
    return Rotation.from_matrix(axes).as_quat(scalar_first=True)


def _opensense(path: Path) -> list[Given]:
    """The sensors of OpenSense's settings of a reader; those on other parts of the body are left out."""
    text = bounded.read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type, which settings do not have")
    root = ElementTree.fromstring(text)  # noqa: S314  without entities
    if root.find(".//trial_prefix") is None:
        raise ValueError("no settings of a reader of Xsens, whose trial_prefix names the files")
    prefix, out = (root.findtext(".//trial_prefix") or "").strip(), []
    for sensor in root.iter("ExperimentalSensor"):
        segment = segment_of(sensor.findtext("name_in_model") or "")
        name = f"{prefix}{sensor.get('name', '')}.txt"
        if segment is not None:
            packed = path.parent / f"{name}.gz"
            out.append(Given(packed if packed.exists() else path.parent / name, segment))
    if not out:
        raise ValueError("no ExperimentalSensor on pelvis, thighs, shanks or feet")
    return out


def read_given(given: Sequence[Given], read: Read = read_samples) -> tuple[SensorLog, ...]:
    """Read sensors of a visit and bring them to one clock, whose time 0 is the start of the first of them.

    Raises `PblError` FILE_MISSING, SENSOR_LOG as `read_samples` and `checked`, and for logs that are not of one
    recording; USAGE: a segment or a sensor is named twice, or the one of a file is not known.
    """
    found = once(sensors_in(given, read))
    clocks = {x.clock: w.shown.name for _, x, w in found}
    if len(clocks) > 1:
        named = ", ".join(f"{clock} ({file})" for clock, file in sorted(clocks.items()))
        apart = said("sensors on different clocks: {clocks}", clocks=named)
        expected = "sensors that were synchronised in one recording"
        raise log_error(apart, expected, next_step=_TOGETHER, key=found[0][2].shown)
    found = [(segment, _mounted(_unwrapped(x, found[0][1]), g), g) for segment, x, g in found]
    begin = min((float(np.nanmin(x.stamp)) for _, x, _ in found if np.isfinite(x.stamp).any()), default=0.0)
    logs = tuple(checked(x, segment, w.shown, begin) for segment, x, w in found)
    spans = [(x.time[-1], x.time[0], w.shown.name) for x, (_, _, w) in zip(logs, found, strict=True)]
    first, last = (min(spans), max(spans, key=lambda span: span[1])) if spans else ((0.0, 0.0, ""),) * 2
    if (s := first[0] - last[1]) < _OVERLAP * min((end - start for end, start, _ in spans), default=0.0):
        common = said("logs {a} and {b}, which have {s:.3g} s in common", a=first[2], b=last[2], s=max(s, 0.0))
        raise log_error(common, "sensors of one recording", next_step=_TOGETHER, key=found[0][2].shown)
    return logs


def _mounted(samples: Samples, given: Given) -> Samples:
    return samples if given.mount is None else dataclasses.replace(samples, mounting=mounting_of(given.mount))


def _unwrapped(samples: Samples, first: Samples) -> Samples:
    """Samples whose clock begins at 0 again, in that turn of it in which they start nearest to the first sensor."""
    start, to = (x.stamp[np.isfinite(x.stamp)][:1] for x in (samples, first))
    if not samples.wraps_s or not len(start) or not len(to):
        return samples
    more = samples.wraps_s * round(float(to[0] - start[0]) / samples.wraps_s)
    utc = None if samples.start_utc is None else samples.start_utc - more
    return dataclasses.replace(samples, stamp=samples.stamp + more, start_utc=utc)


def sensors_in(given: Sequence[Given], read: Read = read_samples) -> list[tuple[str, Samples, Given]]:
    """Read the files: segments, the sensors on them, and by what each was given. A file is read once.

    Raises `PblError` FILE_MISSING, SENSOR_LOG as `read_samples`; USAGE: the sensor or segment of a file is not known.
    """
    wanted = {(g.file, g.rate_hz, g.called) for g in given}
    files = {one: read(*one) for one in sorted(wanted, key=str)}
    return [(*pair, g) for g in given for pair in _chosen(g, files[g.file, g.rate_hz, g.called])]


def once(found: list[tuple[str, Samples, Given]]) -> list[tuple[str, Samples, Given]]:
    """Return what `sensors_in` found. Raises `PblError` USAGE if a segment or a sensor is in it twice."""
    values = [(x.rate, x.acceleration, x.orientation) for _, x, _ in found]
    measured = [b"".join(v.tobytes() for v in each if v is not None).strip(b"\0") for each in values]
    for i, (segment, samples, one) in enumerate(found):
        before = zip(found[:i], measured, strict=False)
        if same := [w for (s, _, w), m in before if s == segment or (m and m == measured[i])]:
            twice = said(
                "the sensor {name} on {segment}: one of them twice ({file}, {other})",
                name=samples.name,
                segment=as_said(segment),
                file=one.shown.name,
                other=same[0].shown.name,
            )
            raise PblError("USAGE", twice, "one sensor on each segment", "name each sensor once")
    return found


def named(one: Given, read: Read = read_samples) -> list[Given]:
    """A file without a segment as its sensors whose names say one; itself where none does or its format is
    not known. Raises `PblError` SENSOR_LOG as `read_samples`."""
    if one.segment is not None:
        return [one]
    try:
        return [dataclasses.replace(one, segment=segment, sensor=x.name) for segment, x, _ in sensors_in([one], read)]
    except PblError as error:
        if error.code == "SENSOR_LOG":
            raise
        return [one]


def _chosen(given: Given, samples: Sequence[Samples]) -> list[tuple[str, Samples]]:
    """Segments and sensors of a file that are named. Raises `PblError` USAGE."""
    by_name = [(segment_of(x.name), x) for x in samples]
    if given.segment is None:
        pairs = [(s, x) for s, x in by_name if s is not None]
    elif given.sensor is not None:
        pairs = [(given.segment, x) for x in samples if x.name == given.sensor]
    else:
        ours = [x for s, x in by_name if s == given.segment] if len(samples) > 1 else samples
        pairs = [(given.segment, x) for x in ours]
    if not pairs or (given.segment is not None and len(pairs) > 1):
        names, on = ", ".join(x.name for x in samples)[:200], as_said(given.segment or "which segment")
        file = given.shown.name
        raise PblError(
            "USAGE",
            said("which sensor of {file} is on {segment} is not known: {names}", file=file, segment=on, names=names),
            expected="a sensor for each segment",
            next_step="state where it was worn; --imu shank_r=FILE#SENSOR, or --imu shank_r=FILE of a single sensor",
            key=given.shown,
        )
    return pairs
