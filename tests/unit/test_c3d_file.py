"""Laboratory C3D files by the rules of the format: events, missing points, numbers of the header, counts of 16 bits."""

from __future__ import annotations

import functools
import io
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import gait_metrics, read_lab_feet, read_lab_trial
from tests.command import pbl

RATE, N = 100.0, 270
MARKERS = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")
INTEL, DEC, MIPS = 84, 85, 86
U16, F32 = functools.partial(np.asarray, dtype=np.uint16), functools.partial(np.asarray, dtype=np.float32)
#: Steps of a stride of 1 s, as (time, side, event).
EVENTS = sorted(
    [(k, "Left", "Foot Strike") for k in (1.0, 2.0)]
    + [(k + 0.6, "Left", "Foot Off") for k in (0.0, 1.0)]
    + [(k + 0.5, "Right", "Foot Strike") for k in (0.0, 1.0, 2.0)]
    + [(k + 0.1, "Right", "Foot Off") for k in (1.0, 2.0)]
)
TIMES = [t for t, _, _ in EVENTS]


def walk(n: int = N) -> dict[str, np.ndarray]:
    """Points (n, 3) by name: nine angles per side (degrees), markers of the feet and hips (mm)."""
    t = np.arange(n) / RATE
    points = {}
    for side, offset, y in (("L", 0.0, 90.0), ("R", 0.5, -90.0)):
        phase = t + offset + 1e-9
        part = np.clip(phase % 1 - 0.6, 0, None) / 0.4
        x = 1200 * (np.floor(phase) - offset + 0.5 - 0.5 * np.cos(np.pi * part))
        z = 120 * np.sin(np.pi * part)
        for name, ahead, high in (("HEE", -50, 40), ("TOE", 150, 30)):
            points[side + name] = np.stack([x + ahead, 0 * x + y, z + high], axis=1)
        points[side + "ASI"] = np.stack([1200 * t + 50, 0 * t + y, 0 * t + 950], axis=1)
        c, swing = np.cos(2 * np.pi * phase), np.exp(-(((phase % 1 - 0.73) / 0.12) ** 2))
        one = np.ones_like(t)
        for name, xyz in {
            "Pelvis": (10 * one, 3 * c, 4 * c),
            "Hip": (15 + 22 * c, 3 * c, 2 * one),
            "Knee": (8 + 55 * swing, one, one),
            "Ankle": (4 + 8 * np.sin(2 * np.pi * phase), one, one),
            "FootProgress": (one, one, -6 * one),
        }.items():
            points[f"{side}{name}Angles"] = np.stack(xyz, axis=1)
    return points


class Written:
    """Bytes of a C3D file, number by number: `header` and `parameters` hold what a test may change before `save`."""

    def __init__(self, points: dict[str, np.ndarray], processor: int = INTEL, scale: float = -1.0) -> None:
        self.labels, self.processor, self.scale = list(points), processor, scale
        xyz = np.stack(list(points.values()), axis=1)
        self.words = np.concatenate([xyz / (scale if scale > 0 else 1.0), np.zeros((*xyz.shape[:2], 1))], axis=-1)
        n = len(xyz)
        self.analog = np.zeros((n, 0))
        self.header: dict[str, Any] = {"points": len(points), "analog": 0, "first": 1, "last": n, "gap": 0}
        self.header |= {"scale": scale, "block": 0, "per_frame": 0, "rate": RATE}
        self.parameters: dict[str, Any] = {
            "POINT:USED": U16(len(points)),
            "POINT:FRAMES": U16(min(n, 65535)),
            "POINT:SCALE": F32(scale),
            "POINT:RATE": F32(RATE),
            "POINT:UNITS": ["mm"],
        }
        for k in range(0, len(points), 255):
            self.parameters[f"POINT:LABELS{k // 255 + 1 if k else ''}"] = self.labels[k : k + 255]

    def events(self, rows: Any = EVENTS, **changed: Any) -> Written:
        """Add the group EVENT; a value of None leaves a parameter out."""
        rows = list(rows)
        group = {
            "USED": U16(len(rows)),
            "CONTEXTS": [r[1] for r in rows],
            "LABELS": [r[2] for r in rows],
            "TIMES": F32([[r[0] // 60, r[0] % 60] for r in rows]),
            **changed,
        }
        self.parameters |= {f"EVENT:{k}": v for k, v in group.items() if v is not None}
        return self

    def _floats(self, values: Any) -> bytes:
        values = np.atleast_1d(np.asarray(values, np.float32))
        if self.processor == DEC:
            return (values * 4).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1].tobytes()
        return values.astype(">f4" if self.processor == MIPS else "<f4").tobytes()

    def _value(self, value: Any) -> bytes:
        """Type, dimensions (the fastest first) and data of a parameter."""
        if isinstance(value, list):
            width = max([len(v) for v in value], default=0)
            texts = b"".join(v.encode().ljust(width) for v in value)
            return struct.pack("bBBB", -1, 2, width, len(value)) + texts
        value = np.asarray(value)
        sizes = bytes([len(value.shape), *value.shape[::-1]])
        if value.dtype == np.float32:
            return b"\x04" + sizes + self._floats(value.ravel())
        return b"\x02" + sizes + value.astype(">u2" if self.processor == MIPS else "<u2").tobytes()

    def save(self, path: Path) -> Path:
        order = ">" if self.processor == MIPS else "<"
        groups = list(dict.fromkeys(key.split(":")[0] for key in self.parameters))
        section = b"".join(
            struct.pack("bb", len(g), -i) + g.encode() + struct.pack(f"{order}H", 3) + b"\0"
            for i, g in enumerate(groups, 1)
        )
        for key, value in self.parameters.items():
            group, name = key.split(":")
            data = self._value(value) + b"\0"
            section += struct.pack("bb", len(name), groups.index(group) + 1) + name.encode()
            section += struct.pack(f"{order}H", len(data) + 2) + data
        blocks = (4 + len(section) + 2 + 511) // 512
        h = self.header | {"block": self.header["block"] or 2 + blocks}
        head = bytes([2, 0x50]) + struct.pack(
            f"{order}5H", *(h[k] for k in ("points", "analog", "first", "last", "gap"))
        )
        head += (
            self._floats(h["scale"]) + struct.pack(f"{order}2H", h["block"], h["per_frame"]) + self._floats(h["rate"])
        )
        flat = np.concatenate([self.words.reshape(len(self.words), -1), self.analog], axis=1)
        if self.scale > 0:
            frames = np.round(flat).astype(">i2" if self.processor == MIPS else "<i2").tobytes()
        else:
            frames = self._floats(flat.ravel())
        frames += bytes(-len(frames) % 512)
        section = bytes([1, 0x50, blocks, self.processor]) + section
        path.write_bytes(head.ljust(512, b"\0") + section.ljust(512 * blocks, b"\0") + frames)
        return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "walk.c3d"


def notes(trial: Any) -> str:
    return "".join(c.advice for c in trial.events.qc if c.check == "input_assumptions")


def refused(code: str, path: Path, **options: Any) -> str:
    with pytest.raises(PblError, match=code) as error:
        read_lab_trial(path, **options)
    assert error.value.key == str(path)
    return error.value.found


def same_events(trial: Any, times: Any = TIMES) -> bool:
    rows = [(e.time_s, e.side, e.event) for e in trial.events.events]
    kind = {"Foot Strike": "foot_down", "Foot Off": "foot_up"}
    expected = [(t, side.lower(), kind[event]) for t, side, event in EVENTS]
    return (
        trial.events.method == "labels"
        and [r[1:] for r in rows] == [r[1:] for r in expected]
        and np.allclose([r[0] for r in rows], times, atol=1e-5)
    )


# -------------------------------------------------------------------------------------------------------------- events
PAIRS = F32([[0, t] for t in TIMES])


def test_a_plain_file_has_no_notes(file):
    trial = read_lab_trial(Written(walk()).events().save(file))
    assert same_events(trial)
    assert notes(trial) == ""


@pytest.mark.parametrize(
    "changed",
    [
        {"TIMES": PAIRS.ravel()},
        {"TIMES": PAIRS.ravel()[None]},
        {"TIMES": PAIRS.ravel()[:, None]},
        {"TIMES": PAIRS.T.copy()},
        {"USED": None},
        {"USED": F32(9)},
        {"USED": U16([9])},
        {"CONTEXTS": [side.upper() + " foot" for _, side, _ in EVENTS]},
        {"CONTEXTS": [side[0] for _, side, _ in EVENTS]},
        {"SUBJECTS": ["A"] * 9},
        {"SUBJECTS": ["A"] * 3},
    ],
    ids=["a row", "1 x 2N", "2N x 1", "N x 2", "no USED", "float", "array", "contexts", "initials", "one", "short"],
)
def test_the_same_events_in_other_shapes(file, changed):
    assert same_events(read_lab_trial(Written(walk()).events(**changed).save(file)))


@pytest.mark.parametrize(
    ("down", "up"),
    [
        ("HS", "TO"), ("IC", "FO"), ("Heel Strike", "Toe Off"), ("heel_strike", "toe-off"), ("FOOT STRIKE", "FOOT OFF"),
        ("Initial Contact", "FootOff"), ("foot contact", "Foot Up"), ("FS", "Lift-off"),
    ],
)  # fmt: skip
def test_labels_of_other_programs(file, down, up):
    """The side by its context, and in the label itself: before it or after it, as a letter or a word."""
    word = {"Foot Strike": down, "Foot Off": up}
    assert same_events(read_lab_trial(Written(walk()).events([(t, s, word[e]) for t, s, e in EVENTS]).save(file)))
    for form in ("{0[0]}{1}", "{0} {1}", "{1}_{0[0]}", "{1} {0}"):
        rows = [(t, "General", form.format(s, word[e])) for t, s, e in EVENTS]
        assert same_events(read_lab_trial(Written(walk()).events(rows).save(file)))
        assert same_events(read_lab_trial(Written(walk()).events(rows, CONTEXTS=None).save(file)))


def test_events_that_are_none(file):
    """General ones, unknown labels, and those that were deleted (beyond USED) are left out and named."""
    more = [(0.3, "General", "Foot Strike"), (0.4, "Left", "Force plate"), (0.45, "", "Foot Off")]
    trial = read_lab_trial(Written(walk()).events([*EVENTS, *more]).save(file))
    assert same_events(trial)
    assert "'General Foot Strike', 'Left Force plate', 'Foot Off'" in notes(trial)
    trial = read_lab_trial(Written(walk()).events([*EVENTS, (1.2, "Left", "Foot Off")], USED=U16(9)).save(file))
    assert same_events(trial)
    assert "beyond EVENT:USED (9)" in notes(trial)
    late = [(t + 0.2, s, e) for t, s, e in EVENTS]
    for changed in ({"USED": U16(0)}, {"CONTEXTS": None}):
        trial = read_lab_trial(Written(walk()).events(late, **changed).save(file), method="zeni-2008")
        assert trial.events.method == "zeni-2008"
        assert "events are found from the markers" in notes(trial)
    only_angles = {k: v for k, v in walk().items() if k not in MARKERS}
    assert "event labels" in refused("GAIT_INPUT", Written(only_angles).events(CONTEXTS=None).save(file))


def test_events_that_contradict_are_refused(file):
    rows = [(1.0, "Left", "RHS")]
    assert "RHS" in refused("FILE_FORMAT", Written(walk()).events(rows).save(file))
    assert "TIMES" in refused("FILE_FORMAT", Written(walk()).events(TIMES=F32(TIMES)).save(file))
    assert "TIMES" in refused("FILE_FORMAT", Written(walk()).events(TIMES=PAIRS[:5]).save(file))
    # As ezc3d writes 400 events: LABELS of 144.
    found = refused("FILE_FORMAT", Written(walk()).events(USED=U16(400)).save(file))
    assert found == "EVENT:LABELS holds 9 of 400 events"


def test_more_than_255_events(file):
    rows = sorted((k + t, side, e) for k in range(75) for t, side, e in EVENTS[:4])
    split: dict[str, Any] = {"USED": U16(300)}
    for k, suffix in ((0, ""), (255, "2")):
        split |= {
            f"CONTEXTS{suffix}": [r[1] for r in rows[k : k + 255]],
            f"LABELS{suffix}": [r[2] for r in rows[k : k + 255]],
        }
        split[f"TIMES{suffix}"] = F32([[r[0] // 60, r[0] % 60] for r in rows[k : k + 255]])
    trial = read_lab_trial(Written(walk(7600)).events(rows, **split).save(file))
    assert len(trial.events.events) == 300
    assert trial.events.events[-1].time_s == pytest.approx(rows[-1][0], abs=1e-4)
    # One row of 2N numbers holds 127 events, so that TIMES2 begins at another event than LABELS2.
    flat = F32([[r[0] // 60, r[0] % 60] for r in rows]).ravel()
    pieces = {f"TIMES{k // 254 + 1 if k else ''}": flat[k : k + 254] for k in range(0, 600, 254)}
    trial = read_lab_trial(Written(walk(7600)).events(rows, **(split | pieces)).save(file))
    assert len(trial.events.events) == 300


def test_events_outside_of_the_recording_are_counted(file):
    written = Written(walk()).events()
    written.header |= {"first": 1001, "last": 1270}
    assert "9 of 9 events are outside" in notes(read_lab_trial(written.save(file)))


# ------------------------------------------------------------------------------------------------------------- persons
def of_two() -> list[tuple]:
    return sorted([(*e, "Ann") for e in EVENTS] + [(t + 0.05, s, e, "Bea") for t, s, e in EVENTS])


def test_events_of_a_second_person(file):
    both = of_two()
    who = [r[3] for r in both]
    path = Written(walk()).events(both, SUBJECTS=who).save(file)
    assert refused("GAIT_INPUT", path) == "events of Ann, Bea"
    assert same_events(read_lab_trial(path, person="ann"))
    assert same_events(read_lab_trial(path, person="Bea"), np.add(TIMES, 0.05))
    assert refused("GAIT_INPUT", path, person="Cleo") == "events of Ann, Bea"
    out = file.with_suffix(".json")
    assert pbl("gait", path, "--out", out).error_code == "GAIT_INPUT"
    assert pbl("gait", path, "--out", out, "--person", "Ann").code == 0
    assert pbl("gait", file.with_name("a.fit.npz"), "--out", out, "--person", "Ann").error_code == "USAGE"
    # The file may say whose the points are.
    written = Written(walk()).events(both, SUBJECTS=who)
    written.parameters["SUBJECTS:NAMES"] = ["Bea"]
    trial = read_lab_trial(written.save(file))
    assert same_events(trial, np.add(TIMES, 0.05))
    assert "left out: Ann" in notes(trial)
    written = Written({f"Ann:{k}": v for k, v in walk().items()}).events(both, SUBJECTS=who)
    assert same_events(read_lab_trial(written.save(file)))


def test_points_of_two_persons(file):
    one = walk()
    other = {k: v + (0 if k.endswith("Angles") else [0, 2000, 0]) for k, v in one.items()}
    points = {f"Ann:{k}": v for k, v in one.items()} | {f"Bea:{k}": v for k, v in other.items()}
    path = Written(points).events(SUBJECTS=["Bea"] * 9).save(file)
    assert refused("GAIT_INPUT", path) == "points of Ann, Bea"
    bea = read_lab_trial(path, person="Bea")
    assert same_events(bea)
    assert bea.feet is not None
    assert bea.feet.heel_m[0, 0, 1] == pytest.approx(2.09)
    # Bea's events are not Ann's.
    assert read_lab_trial(path, person="Ann", method="zeni-2008").events.method == "zeni-2008"
    assert read_lab_feet(path, "Ann").heel_m[0, 0, 1] == pytest.approx(0.09)
    assert pbl("events", path, "--method", "zeni-2008", "--out", file.with_suffix(".csv")).error_code == "GAIT_INPUT"
    done = pbl("events", path, "--method", "zeni-2008", "--person", "Bea", "--out", file.with_suffix(".csv"))
    assert done.code == 0


def test_a_name_twice_is_refused_by_name(file):
    for name in ("LKneeAngles", "RTOE"):
        written = Written({**walk(), "extra": walk()["LHEE"]})
        written.parameters["POINT:LABELS"] = [*walk(), name]
        assert refused("FILE_FORMAT", written.save(file)) == f"more than one point named {name}"
    written = Written({**walk(), "Ann:LHEE": walk()["LHEE"]})
    assert "LHEE" in refused("FILE_FORMAT", written.save(file))
    # Points that are not read may be unnamed or named alike.
    written = Written({**walk(), "a": walk()["LHEE"], "b": walk()["LHEE"]}).events()
    written.parameters["POINT:LABELS"] = [*walk(), "*1", "*1"]
    assert same_events(read_lab_trial(written.save(file)))


def test_points_beyond_255(file):
    many = {f"*{k}": walk()["LHEE"] for k in range(600)}
    trial = read_lab_trial(Written(many | walk()).events().save(file))
    assert same_events(trial)
    assert trial.series.left["knee_flexion"][0] == pytest.approx(walk()["LKneeAngles"][0, 0])


# ------------------------------------------------------------------------------------------------------------- missing
@pytest.mark.parametrize(
    ("word", "scale"),
    [
        *(((0, 0, 0, 0), -1.0), ((7, 7, 7, -1), -1.0), ((7, np.nan, 7, 0), -1.0), ((7, 7, 7, -0.01), -1.0)),
        *(((0, 0, 0, 0), 0.1), ((7, 7, 7, -1), 0.1)),
    ],
)
def test_missing_samples(file, word, scale):
    written = Written(walk(), scale=scale).events()
    written.words[120:150, written.labels.index("LKneeAngles")] = word
    trial = read_lab_trial(written.save(file))
    gap = np.isnan(trial.series.left["knee_flexion"])
    assert np.flatnonzero(gap).tolist() == list(range(120, 150))
    assert not np.isnan(trial.series.right["knee_flexion"]).any()
    assert ("three zeros count as missing (30 samples): LKneeAngles" in notes(trial)) == (not np.any(word))


def test_zeros_that_were_measured_are_values(file):
    """One number or the residual is not 0."""
    for word in ((0, 0, 0, 3), (0, 1e-6, 0, 0)):
        written = Written(walk()).events()
        written.words[:, written.labels.index("LAnkleAngles")] = word
        trial = read_lab_trial(written.save(file))
        assert not trial.series.left["ankle_dorsiflexion"].any()
        assert notes(trial) == ""


def test_a_lost_heel_has_no_step_width(file):
    written = Written(walk()).events()
    written.words[:, written.labels.index("LHEE")] = 0
    trial = read_lab_trial(written.save(file))
    metrics = gait_metrics([trial], model="gillette-2008")
    assert metrics.spatiotemporal["step_width_m"] is None
    assert metrics.gdi.mean is not None
    assert "(270 samples): LHEE" in notes(trial)


# -------------------------------------------------------------------------------------------------------------- header
@pytest.mark.parametrize(
    "header",
    [
        {"scale": -0.01}, {"scale": 0.0}, {"scale": 0.5}, {"points": 0}, {"points": 99}, {"analog": 7},
        {"per_frame": 3}, {"rate": 0.0}, {"rate": 100.01}, {"block": 65535}, {"last": 5},
    ],
    ids=lambda h: " ".join(h),
)  # fmt: skip
def test_numbers_of_the_header_that_differ(file, header):
    written = Written(walk()).events()
    written.header |= header
    written.parameters["POINT:DATA_START"] = U16(0)
    size = written.save(file).stat().st_size - 512 * -(-written.words.size * 4 // 512)
    written.parameters["POINT:DATA_START"] = U16(size // 512 + 1)
    trial = read_lab_trial(written.save(file))
    assert same_events(trial)
    assert len(trial.series.time_s) == N
    np.testing.assert_allclose(trial.series.left["knee_flexion"], walk()["LKneeAngles"][:, 0], rtol=1e-6)


@pytest.mark.parametrize("scale", [-1.0, 0.1])
@pytest.mark.parametrize(
    ("words", "per_frame", "rate"), [(12, 4, 400), (3, 4, 400), (0, 0, 400), (12, 4, 0), (12, 0, 400), (12, 99, 399.98)]
)
def test_counts_of_analog_samples_that_differ(file, scale, words, per_frame, rate):
    """Three channels at 400 Hz: 12 words a frame, which the header or the parameters may state wrongly."""
    written = Written(walk(), scale=scale).events()
    written.analog = np.full((N, 12), 77.0)
    written.header |= {"analog": words, "per_frame": per_frame}
    written.parameters |= {"ANALOG:USED": U16(3), "ANALOG:RATE": F32(rate)}
    trial = read_lab_trial(written.save(file))
    assert same_events(trial)
    atol = abs(scale) if scale > 0 else 1e-4
    np.testing.assert_allclose(trial.series.left["knee_flexion"], walk()["LKneeAngles"][:, 0], atol=atol)
    written.header |= {"analog": 5, "per_frame": 0}
    written.parameters["ANALOG:RATE"] = F32(900)
    assert "neither fills the file" in refused("FILE_FORMAT", written.save(file))


def test_numbers_that_cannot_both_be_true(file):
    """Rates, and scales of integers: no size of the file tells which."""
    written = Written(walk()).events()
    written.header["rate"] = 50.0
    assert refused("FILE_FORMAT", written.save(file)) == "POINT:RATE is 100, and 50 in the header"
    written = Written(walk(), scale=0.1)
    written.header["scale"] = 0.05
    assert refused("FILE_FORMAT", written.save(file)) == "POINT:SCALE is 0.1, and 0.05 in the header"


def test_parameters_whose_names_differ_in_case(file):
    written = Written(walk()).events()
    written.parameters |= {"PROCESSING:Bodymass": F32(70), "PROCESSING:BODYMASS": F32(71)}
    written.parameters |= {"POINT:Rate": F32(RATE), "event:used": U16(9)}
    assert same_events(read_lab_trial(written.save(file)))
    written.parameters["POINT:Rate"] = F32(50)
    assert "POINT:RATE is stated 2 times" in refused("FILE_FORMAT", written.save(file))


def test_a_unit_that_is_not_stated_is_named(file):
    written = Written(walk()).events()
    del written.parameters["POINT:UNITS"]
    assert "mm is assumed" in notes(read_lab_trial(written.save(file)))
    written.parameters["POINT:UNITS"] = ["inch"]
    assert "inch" in refused("FILE_FORMAT", written.save(file))


# -------------------------------------------------------------------------------------------------------------- counts
def still(n: int) -> dict[str, np.ndarray]:
    """Six markers that move by 1 mm a frame: the first coordinate counts frames from 1."""
    return {m: np.stack([np.arange(1, n + 1), np.full(n, 9.0), np.full(n, 9.0)], axis=1) for m in MARKERS}


def pelvis(path: Path) -> tuple[np.ndarray, np.ndarray]:
    feet = read_lab_feet(path)
    return feet.time_s, 1000 * feet.heel_m[:, 0, 0]


@pytest.mark.parametrize("form", ["capped", "wrapped", "long", "trial"])
@pytest.mark.parametrize("n", [65_534, 65_535, 65_536, 66_001, 140_003])
def test_more_frames_than_16_bits_count(file, n, form):
    written = Written(still(n))
    count = min(n, 65535) if form == "capped" else n % 65536
    written.header["last"] = count
    written.parameters["POINT:FRAMES"] = U16(count)
    if form == "long":
        written.parameters["POINT:LONG_FRAMES"] = F32(n)
    if form == "trial":
        written.parameters["TRIAL:ACTUAL_START_FIELD"] = U16([1, 0])
        written.parameters["TRIAL:ACTUAL_END_FIELD"] = U16([n % 65536, n // 65536])
    time, x = pelvis(written.save(file))
    assert len(time) == n
    assert (time[-1], x[-1]) == (pytest.approx((n - 1) / RATE), pytest.approx(n))


@pytest.mark.parametrize("first", [1, 270, 65_535, 65_536, 70_000, 200_000])
def test_the_first_frame_is_that_of_the_trial(file, first):
    """Two words, the low one first; the header keeps 16 bits of it."""
    written = Written(still(300))
    last = first + 299
    written.parameters["TRIAL:ACTUAL_START_FIELD"] = U16([first % 65536, first // 65536])
    written.parameters["TRIAL:ACTUAL_END_FIELD"] = U16([last % 65536, last // 65536])
    for of_header in ((first % 65536, last % 65536), (min(first, 65535), min(last, 65535))):
        written.header["first"], written.header["last"] = of_header
        time, x = pelvis(written.save(file))
        assert (len(time), time[0], x[0]) == (300, pytest.approx((first - 1) / RATE), pytest.approx(1))


def test_a_trial_that_was_cut_later(file):
    """A program cut the frames and wrote its own header, but kept the group TRIAL."""
    written = Written(walk()).events([(t + 2.0, s, e) for t, s, e in EVENTS])
    written.parameters["TRIAL:ACTUAL_START_FIELD"] = U16([1, 0])
    written.parameters["TRIAL:ACTUAL_END_FIELD"] = U16([2000, 0])
    written.header |= {"first": 201, "last": 470}
    trial = read_lab_trial(written.save(file))
    assert (len(trial.series.time_s), trial.series.time_s[0]) == (N, pytest.approx(2.0))
    assert "first frame 201" in notes(trial)


def test_a_file_that_ends_early(file):
    path = Written(walk()).events().save(file)
    path.write_bytes(path.read_bytes()[:-20_000])
    assert 180 < len(read_lab_trial(path).series.time_s) < 230


# ------------------------------------------------------------------------------------------------------- number formats
@pytest.mark.parametrize("scale", [-1.0, -0.01, 0.1])
@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
def test_the_formats_of_numbers(file, processor, scale):
    """As py-c3d, another implementation, reads them."""
    import c3d

    written = Written(walk(), processor, scale).events()
    written.words[7, 3, 3] = -1
    path = written.save(file)
    trial = read_lab_trial(path)
    assert same_events(trial)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader: Any = c3d.Reader(io.BytesIO(path.read_bytes()))
        frames = np.array([p[:, :3] for _, p, _ in reader.read_frames()])
    knee = frames[:, written.labels.index("LKneeAngles"), 0]
    np.testing.assert_allclose(trial.series.left["knee_flexion"], knee, rtol=1e-6)
    assert trial.feet is not None
    np.testing.assert_allclose(trial.feet.time_s, np.arange(N) / RATE, rtol=1e-6)


def test_files_that_ezc3d_has_written_again(shared_data, tmp_path):
    """Header scale -1 beside POINT:SCALE -0.01."""
    import gzip

    ezc3d = pytest.importorskip("ezc3d")
    name = shared_data / "real" / "gait_lab_c3d" / "Straight_HC031A06.c3d.gz"
    (tmp_path / "first.c3d").write_bytes(gzip.decompress(name.read_bytes()))
    ezc3d.c3d(str(tmp_path / "first.c3d")).write(str(tmp_path / "again.c3d"))
    first, again = read_lab_trial(name), read_lab_trial(tmp_path / "again.c3d")
    for side in ("left", "right"):
        for angle, values in getattr(first.series, side).items():
            np.testing.assert_allclose(getattr(again.series, side)[angle], values, atol=1e-4)
    assert first.events.events == again.events.events


# ------------------------------------------------------------------------------------------- against the person
def test_units_and_rates_that_no_person_has_are_refused(file):
    written = Written(walk()).events()
    written.parameters["POINT:UNITS"] = ["m"]
    assert "millimetres read as metres" in refused("GAIT_INPUT", written.save(file))
    written = Written(walk(1200))
    written.parameters["POINT:RATE"] = F32(10 * RATE)
    written.header["rate"] = 10 * RATE
    assert "strides of 0.1 s" in refused("GAIT_INPUT", written.save(file))


@pytest.mark.parametrize(
    ("name", "change"),
    [("Knee", lambda x: -x), ("Hip", lambda x: x + 180), ("Ankle", lambda x: x - 150)],
)
def test_angles_that_no_joint_has_are_refused(file, name, change):
    points = {n: change(x) if n.endswith(name + "Angles") else x for n, x in walk().items()}
    with pytest.raises(PblError, match="GAIT_INPUT") as error:
        read_lab_trial(Written(points).events().save(file))
    assert name.lower() in error.value.found


def test_angles_of_the_other_side_are_refused(file):
    points = walk()
    other = {n: points[{"L": "R", "R": "L"}[n[0]] + n[1:]] if n.endswith("Angles") else x for n, x in points.items()}
    trial = read_lab_trial(Written(other).events().save(file))
    with pytest.raises(PblError, match="knees bent by 8 deg in what the events call swing"):
        gait_metrics([trial], model="gillette-2008")
