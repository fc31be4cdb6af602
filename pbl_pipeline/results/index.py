"""Index of a trial or a visit, its Movement Analysis Profile, and all measures of a visit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pbl_pipeline.qc import Check
from pbl_pipeline.records import column, plain, record
from pbl_pipeline.words import number

from .events import RIGHT
from .measures import MINIMAL_CHANGE, Spatiotemporal, interval_90

#: The paper's index, and the original one (Schwartz & Rozumalski 2008).
GDI_MODEL, GILLETTE_MODEL = "pbl-2025-three-angles", "gillette-2008"
#: The index of three angles by the paper's own recipe: the mean of the indices of all steps of a session, nothing taken
#: back. Its components are those of norm and patients together in a set of `norm_from_cycles(pooled=...)`.
PAPER_INDEX = "paper-2025"
_NAMES = {
    GDI_MODEL: "GDI of three angles",
    PAPER_INDEX: "GDI of three angles, the paper's recipe",
    GILLETTE_MODEL: "GDI (Schwartz & Rozumalski 2008)",
}
#: Index with its error, as lists of visits show it.
WITH_ERROR = ("mean", "sd", "minimal_change")
#: Numbers of an index: fields of `Gdi`, statistics of files.
NUMBERS = ("mean", "left", "right", "sd", "minimal_change", "unshrunk", "unshrunk_sd")


@record(kw_only=True)
class NormFacts:
    """Identity of a normative set, number of its normative vectors, their source and definition of their angles."""

    name: str = column("norm_name", type="varchar(40)")
    version: int = column("norm_version", type="int16")
    sha256: str = column("norm_sha256", "of its numbers", "char(64)", default="")  # checked at loading
    n: int = column("norm_n", "normative vectors", "int32")
    variables: tuple[str, ...] = column("norm_variables", "angles of the index, in order", "json")
    source: str = column("norm_source", "who measured whom, and where it is published", "varchar(1000)", cut=True)
    convention: str = column("norm_convention", "how its angles are defined", "varchar(1000)", cut=True)
    licence: str = column("norm_licence", type="varchar(500)", cut=True)
    angle_model: str = column(  # one of `ANGLE_MODELS`
        "norm_angle_model",
        "how pelvis and hip are defined: plug_in_gait or pbl_body",
        "varchar(32)",
        old="plug_in_gait",
        default="plug_in_gait",
    )


@record
class VariableScore:
    """Gait Variable Score (deg) of an angle, None for a side without cycles."""

    angle: str = column("{}_angle", "name", "varchar(32)", key=True)
    left: float | None = column("{}_score_left", "(deg) root mean square distance from the normative mean curve")
    right: float | None = column("{}_score_right", "(deg)")


@record
class MovementProfile:
    """Gait Variable Scores (deg) per side and angle: together the Movement Analysis Profile.

    A score is the root mean square, over the cycle, of the distance from the normative mean curve; of several cycles
    their mean. `gps_left`, `gps_right` are the Gait Profile Scores of a side and `gps` that of the person, None unless
    the norm has all nine angles (`NINE_ANGLES`). Empty sides have no scores.
    """

    left: dict[str, float]
    right: dict[str, float]
    gps_left: float | None = column("{}_gps_left", "(deg)")
    gps_right: float | None = column("{}_gps_right", "(deg)")
    gps: float | None = column(
        "{}_gps", "(deg) Gait Profile Score of the person; null unless the norm has nine angles", before="gps_left"
    )

    def of_side(self, side: str) -> dict[str, float]:
        """The scores of "left" or "right"."""
        return self.right if side == RIGHT else self.left

    @property
    def scores(self) -> tuple[VariableScore, ...]:
        """The scores by angle."""
        return tuple(VariableScore(k, self.left.get(k), self.right.get(k)) for k in {**self.left, **self.right})


@record
class GdiCycle:
    """The index of one cycle. `z` is the standardised log distance; `explained` the fraction (0..1) of the squared
    deviation from the normative mean that lies in the normative components; the rest does not count."""

    trial: str
    number: int = column("cycle_no", type="int16", key=True)
    side: str
    gdi: float = column("cycle_gdi", "(-)")
    z: float = column("cycle_z", "(-) standardised log distance to the normative mean")
    explained: float = column("cycle_explained", "(0..1) share of the deviation that the index sees")


@record
class Gdi:
    """The index of one trial or session, of its `n` used cycles; None if these are too few (`reason`).

    `left`, `right` and `mean` are of the mean curves of each side and the mean of the two, or means over the cycles of
    a side and over all (`GdiParams.average`). Status PASS or EMPTY. `profile`: deviation of each angle, None without an
    index. `sd`: standard deviation of the error of `mean`, None if the angles' is not known; `minimal_change` as of
    `Measure`. `unshrunk`: the index without people's distribution as prior knowledge of this person, for correlations
    and means over people; `mean` where that knows nothing of them either; None where it is too uncertain
    (`measurement.MOST_UNSURE`); `unshrunk_sd`: standard deviation of its error.
    """

    status: str = column("{}_status", type="enum('PASS', 'EMPTY')")
    reason: str = column("{}_reason", "why there is no index", "varchar(1000)", cut=True)
    left: float | None = column("{}_left", "(-)")
    right: float | None = column("{}_right", "(-)")
    mean: float | None = column("{}", "(-) mean over all used cycles", before="left")
    n: int = column("{}_n", "cycles with an index", "int16", before="(end)")
    n_left: int
    n_right: int
    norm: str
    model: str
    params_hash: str
    cycles: tuple[GdiCycle, ...]
    qc: tuple[Check, ...]
    profile: MovementProfile | None = None
    sd: float | None = column(
        "{}_sd",
        "(-) standard deviation of the error of {}",
        meaning="standard deviation of the error of mean",
        default=None,
    )
    minimal_change: float | None = column(
        "{}_minimal_change", f"(-) {MINIMAL_CHANGE} between two such visits", default=None
    )
    unshrunk: float | None = column(
        "{}_unshrunk",
        "(-) not drawn towards the mean of people: for correlations and means over people",
        meaning="index that is not drawn towards the mean of people: for correlations and means over people",
        default=None,
    )
    unshrunk_sd: float | None = column(
        "{}_unshrunk_sd",
        "(-) standard deviation of the error of {}_unshrunk",
        meaning="standard deviation of the error of unshrunk",
        default=None,
    )

    @property
    def interval(self) -> tuple[float, float] | None:
        """90 % interval of the true index; None if `sd` is not known."""
        return interval_90(self.mean, self.sd)

    def error_words(self, decimals: int = 0) -> str:
        """The 90 % interval and the minimal detectable change in words; "" if the angles' error is not known."""
        if self.interval is None or self.minimal_change is None:
            return ""
        low, high, change = (number(v, decimals) for v in (*self.interval, self.minimal_change))
        return f"90 % interval {low} to {high}, minimal change {change}"

    @property
    def title(self) -> str:
        """Display name of the index."""
        return _NAMES.get(self.model, self.model)

    def to_dict(self) -> dict:
        """`gdi` of metrics.json."""
        rounded = {name: plain(getattr(self, name), 3) for name in NUMBERS}
        # As a reader of the file computes it.
        own = {**rounded, "interval": plain(interval_90(rounded["mean"], rounded["sd"]), 3)}
        own |= {name: getattr(self, name) for name in ("n", "n_left", "n_right", "norm", "params_hash")}
        return {**own, "cycles": plain(self.cycles)}


@record
class SessionMetrics:
    """Measures and index over all used cycles of the pooled trials of a session, with their checks `qc`.

    `params_hash` identifies the method of the events and the parameters of the index together.
    """

    status: str = column("session_status", type="enum('PASS', 'EMPTY')")
    reason: str = column("session_reason", "why EMPTY", "varchar(2000)", cut=True)
    spatiotemporal: Spatiotemporal
    gdi: Gdi
    qc: tuple[Check, ...]
    params_hash: str = column(
        "session_params_hash", "hash over the parameters of events and index together", "char(16)"
    )


def numbers_of(told: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the `NUMBERS` of an index that `Gdi.to_dict` wrote. Raises KeyError, TypeError, ValueError."""
    numbers = {n: told.get(n) for n in NUMBERS} | {n: told[n] for n in ("left", "right", "mean")}
    if (numbers["sd"] is None) != (numbers["minimal_change"] is None):
        raise ValueError("an index with one of sd and minimal_change")
    return {n: None if value is None else float(value) for n, value in numbers.items()}
