"""Normative sets: a fitted basis, the mean curves that ship, and the definition of their pelvis and hip angles."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from pbl_pipeline.bounded import parse_json, read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import canonical_json, structured
from pbl_pipeline.records import record
from pbl_pipeline.results.cycles import BODY_ANGLES
from pbl_pipeline.results.index import NormFacts

#: The original index (Schwartz & Rozumalski 2008): nine angles x 51 points.
NINE_ANGLES: tuple[str, ...] = (
    "pelvis_tilt",
    "pelvis_obliquity",
    "pelvis_rotation",
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "foot_progression",
)
#: The paper's index.
THREE_ANGLES: tuple[str, ...] = ("hip_flexion", "hip_adduction", "knee_flexion")


#: Angles of a laboratory marker model of Plug-in-Gait kind: the pelvis' forward axis runs from the posterior to the
#: anterior spines and falls forward in neutral standing.
PLUG_IN_GAIT = "plug_in_gait"
ANGLE_MODELS: dict[str, str] = {
    BODY_ANGLES: "the fitted OpenSim body: pelvis level in neutral standing",
    PLUG_IN_GAIT: "laboratory marker model of Plug-in-Gait kind: pelvis axis from the posterior to the anterior spines",
}

#: Slope of the line between the spines in the pelvis frame of the body (deg). In neutral standing that frame is level,
#: and walking controls of the marker model have a mean pelvic tilt of 12 (Schwartz 2008: 11.0 to 11.6 up to free speed;
#: the 166 controls of Gillette: 12). Two OpenSim experts' solutions of two walks and a laboratory's of a third have a
#: mean tilt of -3 to 0 and a hip flexion that is 11 less than those controls' (docs/measures.md).
PELVIS_SLOPE_DEG = 12.0
#: Marker model's angle less the body's (deg). Both models turn the pelvis about its lateral axis first and measure hip
#: flexion about that axis, so another slope adds a constant to hip flexion and does not change hip adduction and
#: rotation; of the pelvis' angles it changes the tilt. (This is exact only if obliquity and rotation are zero; if both
#: are 10 deg, the tilt is 0.1 deg off, and obliquity and rotation change by 2.3 deg.)
OFFSET_DEG = {"hip_flexion": PELVIS_SLOPE_DEG, "pelvis_tilt": PELVIS_SLOPE_DEG}
_invalid = functools.partial(
    PblError,
    "NORM_INVALID",
    next_step="add cycles or correct the data, and build the set again (docs/measures.md, section Normative sets)",
)


def offset_deg(angle: str, source: str, target: str) -> float:
    """Offset (deg) from an angle of the model `source` to that of `target`. Raises `PblError` NORM_INVALID."""
    for model in (source, target):
        if model not in ANGLE_MODELS:
            raise PblError(
                "NORM_INVALID",
                found=f"angles of the model {model!r}",
                expected=f"one of {', '.join(ANGLE_MODELS)}",
                next_step="name one of these as the angle model of the set",
            )
    per_model = {PLUG_IN_GAIT: OFFSET_DEG.get(angle, 0.0), BODY_ANGLES: 0.0}
    return per_model[target] - per_model[source]


def check_degrees(values: np.ndarray, about: str) -> None:
    """Refuse angles that cannot be degrees of a gait cycle: all within 2 pi (radians), or beyond a full turn.

    In degrees every gait cycle has larger values: a knee bends by 15 and more in swing, a hip by 20. NaN are ignored.

    Raises `PblError` ANGLE_UNITS.
    """
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if not len(known):
        return
    largest = float(np.abs(known).max())
    if 2 * np.pi < largest <= 360.0:
        return
    kind = "radians" if largest <= 2 * np.pi else "degrees that were converted twice, or another unit"
    raise PblError(
        "ANGLE_UNITS",
        found=f"angles of at most {largest:.3g} in a gait cycle: {kind}",
        expected="degrees, with some value beyond 6.3 and none beyond 360",
        next_step="write the angles in degrees",
        key=about,
    )


#: Fewest normative vectors that can carry mean and sd of the log distance.
MIN_VECTORS = 30
#: The controls' three angles as the fitted body's joints count them.
DEFAULT_NORM = "gillette-166-body-angles"
_FOLDER = resources.files("pbl_pipeline.gait.normative").joinpath("data")


@record(kw_only=True)
class NormativeSet(NormFacts):
    """Healthy gait with which a cycle is compared. `variables` are names of `ANGLE_NAMES`."""

    percent: np.ndarray  # (P,) of the cycle, at which each angle stands in the feature vector
    mean_deg: np.ndarray  # (V * P,) mean normative vector
    #: (K, V * P) orthonormal principal components, largest variance first, the largest entry of each positive.
    components: np.ndarray
    explained_variance: np.ndarray  # (K,) deg^2 (n - 1)
    explained_share: float  # fraction of the variance of the normative vectors in the K components
    #: Of the natural logarithm of the distance over the normative vectors (n - 1).
    ln_mean: float
    ln_sd: float
    #: name -> {"percent", "mean_deg", "sd_deg"}: the band of a report, also for angles outside the index.
    curves: dict[str, dict[str, np.ndarray]]
    source_sha256: str = ""  # of the file the set was built from
    mapped_from: str = ""  # the definition in which they were measured, if they were mapped from another one

    def log_distance(self, vectors: np.ndarray) -> np.ndarray:
        """ln of the Euclidean distance of the component scores of (N, V * P) vectors to the normative mean."""
        return _log_length(self.scores(np.atleast_2d(vectors)))

    def scores(self, vectors: np.ndarray) -> np.ndarray:
        """Return the component scores (..., K) of (..., V * P) vectors (deg)."""
        return (vectors - self.mean_deg) @ self.components.T

    def index(self, vectors: np.ndarray) -> np.ndarray:
        """100 - 10 z of (N, V * P) vectors: 100 is the normative mean, 10 one normative standard deviation."""
        return self.index_of_scores(self.scores(np.atleast_2d(vectors)))

    def index_of_scores(self, scores: np.ndarray) -> np.ndarray:
        """Return the index (...) of component scores (..., K)."""
        return 100.0 - 10.0 * (_log_length(scores) - self.ln_mean) / self.ln_sd

    def save(self, path: str | Path, digits: int | None = 7) -> str:
        """Write the set as JSON with the checksum of what was written, and return that (SHA-256).

        `digits` significant digits; None writes every number whole (an index to 1e-6 needs it).
        """
        text = _to_json(self, digits)
        text["sha256"] = _checksum(text)
        lines = json.dumps(text, indent=None, separators=(",", ":")).replace(',"', ',\n"') + "\n"
        Path(path).write_text(lines, encoding="utf-8")
        return text["sha256"]


def fit_norm(
    vectors: np.ndarray,
    *,
    name: str,
    version: int,
    variables: Sequence[str],
    percent: np.ndarray,
    source: str,
    licence: str,
    convention: str,
    curves: dict[str, dict[str, np.ndarray]] | None = None,
    variance: float = 0.95,
    n_components: int | None = None,
    pooled: np.ndarray | None = None,
    angle_model: str = PLUG_IN_GAIT,
    mapped_from: str = "",
    source_sha256: str = "",
) -> NormativeSet:
    """Fit principal components that explain `variance` of normative vectors (N, V * P), and their log distances.

    Schwartz & Rozumalski 2008 (Gait & Posture 28:351-357) for the index; components of the covariance matrix of the
    normative vectors alone or, as in the paper, of these together with the vectors `pooled` (M, V * P) of patients:
    mean and log distances are those of the normative vectors either way. `n_components` replaces `variance`.

    Raises `PblError` NORM_INVALID for too few vectors in all or for the components, another length or values that are
    not finite; ANGLE_UNITS.
    """
    vectors = _vectors(vectors, variables, percent)
    _enough(len(vectors), n_components or 0)
    if angle_model not in ANGLE_MODELS:
        raise _invalid(f"angle model {angle_model!r}", f"one of {', '.join(ANGLE_MODELS)}")
    mean = vectors.mean(axis=0)
    everyone = vectors if pooled is None else np.vstack([vectors, _vectors(pooled, variables, percent)])
    _, singular, rows = np.linalg.svd(everyone - everyone.mean(axis=0), full_matrices=False)
    spread = singular**2 / (len(everyone) - 1)
    if not spread.sum() > 0:
        raise _invalid("vectors without any variance", "different people")
    fraction = np.cumsum(spread) / spread.sum()
    k = n_components or int(np.searchsorted(fraction, variance - 1e-12) + 1)
    _enough(len(vectors), k)
    if k > len(fraction):
        raise _invalid(f"{len(fraction)} components in all", f"at least {k}")
    components = rows[:k]
    # The sign of a component is arbitrary: fixed so that two machines write the same file.
    components = components * np.sign(components[np.arange(k), np.abs(components).argmax(axis=1)])[:, None]
    distance = np.log(np.linalg.norm((vectors - mean) @ components.T, axis=1))
    return NormativeSet(
        name=name,
        version=version,
        n=len(vectors),
        source=source,
        licence=licence,
        convention=convention,
        variables=tuple(variables),
        percent=np.asarray(percent, float),
        mean_deg=mean,
        components=components,
        explained_variance=spread[:k],
        explained_share=float(fraction[k - 1]),
        ln_mean=float(distance.mean()),
        ln_sd=float(distance.std(ddof=1)),
        curves=curves or {},
        source_sha256=source_sha256,
        angle_model=angle_model,
        mapped_from=mapped_from,
    )


def _vectors(vectors: np.ndarray, variables: Sequence[str], percent: np.ndarray) -> np.ndarray:
    """The vectors as (N, V * P) floats. Raises `PblError` NORM_INVALID, ANGLE_UNITS."""
    vectors = np.asarray(vectors, float)
    length = len(variables) * len(percent)
    if vectors.ndim != 2 or vectors.shape[1] != length:
        raise _invalid(f"vectors of shape {vectors.shape}", f"(N, {length}): {len(variables)} angles x {len(percent)}")
    if not np.all(np.isfinite(vectors)):
        raise _invalid("values that are not finite", "complete curves")
    for i, vector in enumerate(vectors):
        check_degrees(vector, f"normative vector {i}")
    return vectors


def norm_names() -> tuple[str, ...]:
    """Names of the sets that ship."""
    return tuple(sorted(f.name.removesuffix(".json") for f in _FOLDER.iterdir() if f.name.endswith(".json")))


def _log_length(scores: np.ndarray) -> np.ndarray:
    # A vector equal to the mean has no logarithm; a millionth of a degree is far below any real distance.
    return np.log(np.maximum(np.linalg.norm(scores, axis=-1), 1e-6))


def load_norm(name: str = DEFAULT_NORM) -> NormativeSet:
    """A set that ships, by name, or a file of `NormativeSet.save`, by a path that ends in .json.

    Raises `PblError` NORM_UNKNOWN; NORM_INVALID if the file is damaged or has too few people for its components;
    ANGLE_UNITS.
    """
    shipped = not name.endswith(".json")
    if name not in norm_names() if shipped else not Path(name).is_file():
        raise PblError(
            "NORM_UNKNOWN",
            found=f"normative set {name!r}",
            expected=f"one of {', '.join(norm_names())}, or a .json file of build_norm",
            next_step="name one of these with --norm",
        )
    try:
        data = parse_json(_FOLDER.joinpath(name + ".json").read_text(encoding="utf-8")) if shipped else read_json(name)
        checksum = data.pop("sha256")
        if _checksum(data) != checksum:
            raise ValueError("the numbers are not those the checksum was made of")
        return _from_json(data, checksum)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise _invalid(f"{name}: {error}", "a file that build_norm wrote, unchanged") from error


def _to_json(norm: NormativeSet, digits: int | None) -> dict:
    names = (field.name for field in dataclasses.fields(norm))
    out = {name: _plain(getattr(norm, name), digits) for name in names if name != "sha256"}
    # Left out where they are the default: the first set was written before there was another.
    for name, default in (("angle_model", PLUG_IN_GAIT), ("mapped_from", "")):
        if out[name] == default:
            del out[name]
    return out


def _plain(value: object, digits: int | None) -> object:
    if isinstance(value, np.ndarray):
        return [_plain(v, digits) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if digits is None else float(f"{value:.{digits}g}")
    if isinstance(value, tuple | list):
        return [_plain(v, digits) for v in value]
    if isinstance(value, dict):
        return {k: _plain(v, digits) for k, v in value.items()}
    return value


def _checksum(data: dict) -> str:
    return hashlib.sha256(canonical_json({k: v for k, v in data.items() if k != "sha256"}).encode()).hexdigest()


def _from_json(data: dict, checksum: str) -> NormativeSet:
    norm = structured({**data, "sha256": checksum}, NormativeSet)
    bands = [np.stack([band[key] for key in ("percent", "mean_deg", "sd_deg")]) for band in norm.curves.values()]
    numbers = [norm.percent, norm.mean_deg, norm.components, norm.explained_variance, *bands]
    if norm.percent.ndim != 1 or not all(np.isfinite(n).all() for n in [*numbers, norm.ln_mean, norm.ln_sd]):
        raise ValueError("numbers that are not finite, or percent that is not a list")
    length = len(norm.variables) * len(norm.percent)
    k = len(norm.components)
    if (
        norm.mean_deg.shape != (length,)
        or norm.components.shape != (k, length)
        or norm.explained_variance.shape != (k,)
    ):
        raise ValueError("sizes of mean, components and variables do not fit together")
    if not norm.ln_sd > 0:
        raise ValueError("log distances without a spread")
    if norm.angle_model not in ANGLE_MODELS:
        raise ValueError(f"angle model {norm.angle_model!r}")
    _enough(norm.n, k)
    check_degrees(norm.mean_deg, f"mean of {norm.name}")
    return norm


def _enough(n: int, k: int) -> None:
    """Raise `PblError` NORM_INVALID unless `n` vectors suffice for an index of `k` components."""
    if n < MIN_VECTORS:
        raise _invalid(f"{n} vectors", f"at least {MIN_VECTORS}")
    if k >= n:
        raise _invalid(f"{n} vectors for {k} components", "more normative vectors than components")
