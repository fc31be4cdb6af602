"""The clinical scores that ship: rows of `study.ClinicalInstrument`."""

from __future__ import annotations

from typing import Any

_MJOA = "the scale: Benzel et al. 1991, J Spinal Disord 4:286-295"
_PERERA = "Perera et al. 2006, J Am Geriatr Soc 54:743-749 (doi 10.1111/j.1532-5415.2006.00701.x)"
_BOUNDS = "no scale: bounds that only mistakes exceed"


def _instrument(
    key: str,
    name: str,
    unit: str,
    limits: tuple[float, float],
    source: str,
    *,
    better: bool,
    ordinal: bool,
    change: float | None = None,
    change_source: str = "",
    classes: str = "",
) -> dict[str, Any]:
    return {
        "instrument": key,
        "instrument_name": name,
        "instrument_unit": unit,
        "instrument_low": limits[0],
        "instrument_high": limits[1],
        "instrument_source": source,
        "higher_is_better": better,
        "ordinal": ordinal,
        "minimal_change": change,
        "minimal_change_source": change_source,
        "instrument_classes": classes,
    }


def _mjoa_part(key: str, name: str, high: float) -> dict[str, Any]:
    return _instrument(f"mJOA-{key}", f"mJOA, {name}", "points", (0, high), _MJOA, better=True, ordinal=True)


INSTRUMENTS = (
    _instrument(
        "mJOA",
        "modified Japanese Orthopaedic Association score",
        "points",
        (0, 18),
        _MJOA,
        better=True,
        ordinal=True,
        change=2,
        change_source="ROC analysis, degenerative cervical myelopathy 12 months after surgery, depends on severity: "
        "Tetreault et al. 2015, Spine 40:1653-1659",
        classes="0 severe; 12 moderate; 15 mild; 18 none",
    ),
    _mjoa_part("UE", "motor, upper extremities", 5),
    _mjoa_part("LE", "motor, lower extremities", 7),
    _mjoa_part("S", "sensation, upper extremities", 3),
    _mjoa_part("B", "bladder", 3),
    _instrument("10MWT_s", "10 metre walk test, time", "s", (1, 600), _BOUNDS, better=False, ordinal=False),
    _instrument(
        "10MWT_m_per_s",
        "10 metre walk test, speed",
        "m/s",
        (0, 10),
        _BOUNDS,
        better=True,
        ordinal=False,
        change=0.1,
        change_source=f"substantial change of gait speed in older adults (a small one is 0.05): {_PERERA}",
    ),
    _instrument(
        "BBS",
        "Berg Balance Scale",
        "points",
        (0, 56),
        "the scale: Berg et al. 1992, Can J Public Health 83 Suppl 2:S7-11",
        better=True,
        ordinal=True,
        classes="0 high risk; 21 medium risk; 41 low risk",
    ),
    _instrument(
        "6MWT",
        "6 minute walk test",
        "m",
        (0, 1200),
        _BOUNDS,
        better=True,
        ordinal=False,
        change=50,
        change_source=f"substantial change in older adults (a small one is 20): {_PERERA}",
    ),
    _instrument(
        "TUG",
        "Timed Up and Go",
        "s",
        (1, 600),
        _BOUNDS,
        better=False,
        ordinal=False,
        change=3.4,
        change_source="mean of three methods, after surgery for lumbar degenerative disc disease: "
        "Gautschi et al. 2017, Neurosurgery 80:380-385",
    ),
    _instrument(
        "mRS",
        "modified Rankin Scale",
        "points",
        (0, 6),
        "the scale: van Swieten et al. 1988, Stroke 19:604-607",
        better=False,
        ordinal=True,
    ),
)
