"""Reference of a fit: joint angles and the path of the pelvis over time, and where they come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, load_npz, text_of, texts_of

#: The joints of our body, by its own axes.
QPOS = "qpos"
#: Hip, knee and ankle from the rotations of bodies (`body_rotation_angles`), for models that are not ours.
BODY_ROTATIONS = "body_rotations"
CONVENTIONS = (QPOS, BODY_ROTATIONS)
_FIELDS = ("time_s", "names", "angles_deg", "pelvis_m", "name", "source", "convention")


@dataclasses.dataclass(frozen=True)
class Reference:
    """Reference kinematics of one recording.

    Raises `PblError` REFERENCE_INPUT: time stamps out of order, shapes that do not belong together, an unknown
    convention.
    """

    name: str  # of the recording
    source: str  # where the angles come from: "optical markers", "several cameras", "synthetic",
    #: "qpos": the joints of our body. "body_rotations": hip, knee and ankle from relative body rotations as ZXY.
    convention: str
    time_s: np.ndarray  # (T,) increasing, on the reference's own clock
    #: Joint -> (T,) degrees under OpenSim's names, the knee as `knee_flexion_r/_l`, positive in flexion. Joints that
    #: are not known are absent; NaN where a joint is not known at that time.
    angles_deg: Mapping[str, np.ndarray]
    pelvis_m: np.ndarray | None = None  # (T, 3) origin of the pelvis in the reference's own z-up world, or None

    def __post_init__(self) -> None:
        time = np.asarray(self.time_s, float)
        angles = {k: np.asarray(v, float) for k, v in self.angles_deg.items()}
        object.__setattr__(self, "time_s", time)
        object.__setattr__(self, "angles_deg", angles)
        if self.convention not in CONVENTIONS:
            raise _refused(self.name, f"convention {self.convention!r}", " or ".join(CONVENTIONS))
        if time.ndim != 1 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
            raise _refused(self.name, "time stamps out of order or not finite", "(T,) increasing seconds")
        for joint, values in angles.items():
            if values.shape != time.shape:
                raise _refused(self.name, f"{joint} of shape {values.shape}", f"({time.size},), one value a time stamp")
        if self.pelvis_m is not None:
            pelvis = np.asarray(self.pelvis_m, float)
            object.__setattr__(self, "pelvis_m", pelvis)
            if pelvis.shape != (time.size, 3):
                raise _refused(self.name, f"pelvis_m of shape {pelvis.shape}", f"({time.size}, 3)")

    def save(self, path: str | Path) -> None:
        """Write as .npz: `time_s`, `names` (A,), `angles_deg` (T, A), `pelvis_m`, `name`, `source`, `convention`."""
        table = np.column_stack(list(self.angles_deg.values())) if self.angles_deg else np.zeros((self.time_s.size, 0))
        pelvis = np.full((self.time_s.size, 3), np.nan) if self.pelvis_m is None else self.pelvis_m
        np.savez_compressed(
            path,
            allow_pickle=False,
            time_s=self.time_s,
            names=np.asarray(list(self.angles_deg), dtype=str),
            angles_deg=table,
            pelvis_m=pelvis,
            name=np.asarray(self.name),
            source=np.asarray(self.source),
            convention=np.asarray(self.convention),
        )

    @classmethod
    def load(cls, path: str | Path) -> Reference:
        """Read what `save` wrote. A path of the pelvis that is NaN throughout is None.

        Raises `PblError` FILE_MISSING, FILE_FORMAT, REFERENCE_INPUT.
        """
        data = load_npz(path, _FIELDS)
        missing = [k for k in _FIELDS if k not in data]
        if missing:
            raise PblError(
                "FILE_FORMAT",
                found=f"it lacks {', '.join(missing)}",
                expected="a file that Reference.save wrote",
                next_step="see docs/validation.md, section The reference",
                key=str(path),
            )
        t, a = data["time_s"].size, data["names"].size
        check_numbers(path, data, {"time_s": (t,), "angles_deg": (t, a), "pelvis_m": (t, 3)})
        angles = {n: data["angles_deg"][:, i] for i, n in enumerate(texts_of(path, data, "names"))}
        pelvis = data["pelvis_m"] if np.any(np.isfinite(data["pelvis_m"])) else None
        name, source, convention = (text_of(path, data, k) for k in ("name", "source", "convention"))
        return cls(name, source, convention, data["time_s"], angles, pelvis)


def _refused(name: str, found: str, expected: str) -> PblError:
    return PblError(
        "REFERENCE_INPUT",
        found=found,
        expected=expected,
        next_step="see docs/validation.md, section The reference",
        key=name,
    )
