"""Comparing two visits: their fields, texts and exports, with the rounding that files and tables have."""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.export import ExportOptions, write_export
from pbl_pipeline.gait import GaitEvent, Gdi, GdiCycle, Measure, MovementProfile
from pbl_pipeline.kinetics import CycleKinetics, KineticMeasure
from pbl_pipeline.qc import Check
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.visit import Recording, Solution, Visit

#: What the rounding in the files of a visit changes at most, by the class that holds the number: metrics.json and
#: kinetics.json round a measure to 4 decimals (of a cycle to 5), index and profile to 3; events.csv times to 4 and
#: probabilities to 3; session.json seconds to 3, scale and loss to 5. Curves, keypoints and boxes of people are stored
#: as float32, from which the tables compute the index, checks and the choice of the person. Everything else comes back
#: as it was.
ROUNDED = {
    Measure: 5.1e-5,
    KineticMeasure: 5.1e-5,
    CycleKinetics: 5.1e-6,
    Gdi: 5.1e-4,
    MovementProfile: 5.1e-4,
    GaitEvent: 5.1e-4,
    Solution: 5.1e-4,
    GdiCycle: 1e-5,
    SubjectChoice: 1e-6,
    Check: 5.1e-5,
}


def as_stored(visit: Visit) -> Visit:
    """The visit without what its folder does not hold: paths, and the frames' times of a recording without a fit. Its
    measures are judged by the checks before them."""

    def stored(r: Recording) -> Recording:
        video = r.video
        if video is not None:
            time = video.time_s if r.fitted else np.full(video.n_frames, np.nan)
            video = dataclasses.replace(video, path=Path(video.path).name, time_s=time)
        return dataclasses.replace(r, path=None, video=video)

    judged = visit.judged
    return dataclasses.replace(visit, recordings=tuple(map(stored, visit.recordings)), measures=judged)


def fields(value: Any) -> dict[str, Any]:
    """The fields of a dataclass; of a recording what its functions load."""
    found = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Recording):
        loaded = {n.removeprefix("load_"): getattr(value, n.removeprefix("load_")) for n in found if "load_" in n}
        return {n: v for n, v in found.items() if "load_" not in n} | loaded
    return found


def assert_same(a: Any, b: Any, where: str = "visit", atol: float = 0.0) -> None:
    """Compare two values field by field, with what the rounding of the files allows (`ROUNDED`)."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        one, other = fields(a), fields(b)
        for name in one:
            assert_same(one[name], other[name], f"{where}.{name}", ROUNDED.get(type(a), 0.0))
    elif isinstance(a, Mapping):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]", atol)
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{i}]", atol)
    elif isinstance(a, np.ndarray) and a.dtype.kind in "fiub":
        np.testing.assert_allclose(b, a, rtol=1e-6, atol=atol, err_msg=where)
    elif isinstance(a, float) and isinstance(b, float):
        assert b == pytest.approx(a, rel=0, abs=atol, nan_ok=True), where
    else:
        assert a == b, where


def assert_same_text(a: object, b: object, where: str) -> None:
    """Compare two texts, and each number in them up to one unit of its last digit."""
    number = r"\d+(?:\.\d+)?"
    assert re.sub(number, "#", str(a)) == re.sub(number, "#", str(b)), where
    for one, other in zip(re.findall(number, str(a)), re.findall(number, str(b)), strict=True):
        if one == other:
            continue
        decimals = len(one.partition(".")[2])
        assert float(other) == pytest.approx(float(one), rel=0, abs=1.01 * 10.0**-decimals), where


def leaves(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of nested mappings and lists with its place."""
    parts = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    yield from ((where, value),) if not isinstance(value, Mapping | list | tuple) else ()
    for key, part in parts:
        yield from leaves(part, f"{where}/{key}")


_NUMBER = r"((?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]))"
#: What float32, as which the tables store movements, changes in an exported number: a part of it, and of its unit; of
#: millimetres, a place 7 m away from which the height of the floor was taken off.
FLOAT32, FLOAT32_MM = (5e-7, 2e-6), 1e-3


def assert_same_exports(visit: Visit, loaded: Visit, formats: list[str], tmp_path: Path, float32: bool = False) -> None:
    """Compare what both are exported as: measures up to the rounding of metrics.json, events up to that of events.csv,
    all else exactly; with `float32` movements up to `FLOAT32`."""
    rtol, atol = FLOAT32 if float32 else (0.0, 0.0)
    options = ExportOptions(allow_failed=True)
    out = [tmp_path / "memory", tmp_path / "files"]
    files = [write_export(v, formats, o, options) for v, o in zip((visit, loaded), out, strict=True)]
    assert [p.relative_to(out[0]) for p in files[0]] == [p.relative_to(out[1]) for p in files[1]]
    for one, other in zip(*files, strict=True):
        if (one.parent == out[0] and one.suffix == ".csv") or one.name.endswith("_events.tsv"):
            between = "," if one.suffix == ".csv" else "\t"
            tables = [pd.read_csv(p, sep=between, keep_default_na=False, na_values=[""]) for p in (one, other)]
            pd.testing.assert_frame_equal(tables[0], tables[1], rtol=0, atol=5.1e-4, obj=one.name)
        elif one.suffix == ".parquet":
            pd.testing.assert_frame_equal(
                pd.read_parquet(one), pd.read_parquet(other), rtol=0, atol=5.1e-4, check_categorical=False
            )
        elif one.suffix == ".c3d":
            import ezc3d

            a, b = (ezc3d.c3d(str(p)) for p in (one, other))
            mm = FLOAT32_MM if float32 else 0.0
            for kind in ("points", "rotations", "analogs"):
                np.testing.assert_allclose(a["data"][kind], b["data"][kind], err_msg=one.name, rtol=rtol, atol=mm)
            events = [f["parameters"]["EVENT"] for f in (a, b)]
            assert events[0].keys() == events[1].keys()
            if "TIMES" in events[0]:
                np.testing.assert_allclose(events[0]["TIMES"]["value"], events[1]["TIMES"]["value"], atol=1e-4)
                assert events[0]["LABELS"]["value"] == events[1]["LABELS"]["value"]
                assert events[0]["CONTEXTS"]["value"] == events[1]["CONTEXTS"]["value"]
        elif float32:
            texts = [re.split(_NUMBER, p.read_text()) for p in (one, other)]
            assert texts[0][::2] == texts[1][::2], one.name
            numbers = [np.array(t[1::2], float) for t in texts]
            off = FLOAT32_MM if one.suffix == ".trc" else atol
            np.testing.assert_allclose(numbers[0], numbers[1], err_msg=one.name, rtol=rtol, atol=off)
        else:
            assert one.read_bytes() == other.read_bytes(), one.name
