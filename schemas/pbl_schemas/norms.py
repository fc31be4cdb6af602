"""Normative sets built from the gait cycles in the tables: data with a version, never rebuilt."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label, normalised_label
from pbl_pipeline.records import plain
from pbl_pipeline.temporary import new_folder

from . import fit, gait, gdi, lab, session, video
from .method_names import with_keys
from .reading.frames import newest_sets

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline.qc import Check

#: Form of a set's name: as the shipped ones, and short enough for its column.
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{1,39}")
#: Columns of one chain of methods: cycles of several chains are not one norm.
_CHAIN = ("fit_set_kind", "tracking_method", "keypoint_method", "fit_method", "gait_method")
_usage = functools.partial(PblError, "USAGE", next_step="see `pbl norm build --help`")


@dataclasses.dataclass(frozen=True)
class BuiltNorm:
    """A set in the tables: its key, whether it is new, the library's set and its checks, people and cycles."""

    norm: str
    new: bool
    set: lib.NormativeSet
    checks: tuple[Check, ...]
    n_people: int
    n_cycles: int


def build_norm(
    name: str,
    populations: Sequence[str] = ("healthy",),
    subjects: Sequence[str] = (),
    pooled_populations: Sequence[str] = (),
    restriction: Any = True,
    *,
    nine_angles: bool = False,
    variance: float = 0.95,
    source: str = "",
    pace: str = "self_selected",
) -> BuiltNorm:
    """Build a normative set from the used cycles of the current fits and register it as the next version of its name.

    Nothing that was registered changes: sessions keep the set they were planned with. If the cycles are those of
    the newest version, that version is returned.

    Raises `PblError` USAGE (name, no people, several chains of methods), DB_NOT_FOUND (no cycles, unknown
    population or subject), SOLVER_UNKNOWN (an unknown method), NORM_INVALID, ANGLE_UNITS.

    Parameters
    ----------
    name
        Small letters, digits and hyphens; not a name that ships with the code.
    populations, subjects
        People whose cycles are used: all of these populations, and these subjects. With subjects alone pass
        `populations=()`.
    pooled_populations
        Populations to whose cycles the components are also fitted (the paper pools patients and controls).
    restriction
        A DataJoint restriction of `fit.SessionFit * gait.GaitCycle` and the methods, such as
        `{"fit_method": "blazepose-v1"}`: needed where the tables hold several chains of methods.
    nine_angles
        All nine angles (for `gillette-2008`) instead of three.
    pace
        Cycles of videos that are walked at this pace; one of unknown pace counts as self-selected.
    """
    from pbl_pipeline import gait as lib

    if not _NAME.fullmatch(name) or name in lib.norm_names():
        raise _usage(f"the name {name!r}", "2 to 40 small letters, digits and hyphens, and no name that ships")
    check_label("--source", source, 255)
    if not populations and not subjects:
        raise _usage("neither populations nor subjects", "whose cycles make the norm")
    if isinstance(restriction, Mapping):
        restriction = with_keys(restriction)
    subjects = [normalised_label(code) for code in subjects]
    _must_exist(lab.Population, "population", [*populations, *pooled_populations])
    _must_exist(lab.Subject, "subject", subjects)
    chosen = [{"population": p} for p in populations] + [{"subject": s} for s in subjects]
    keys = _cycle_keys(chosen, restriction, pace)
    others = [{"population": p} for p in pooled_populations]
    patients = _cycle_keys(others, restriction, pace) if others else []
    if not keys:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no gait cycles of {', '.join([*populations, *subjects])} at the pace {pace!r}",
            expected="fitted sessions of these people (`pbl ingest --population`, `pbl populate`)",
            next_step="`pbl status` shows what is done",
        )
    chains = sorted({tuple(k[c] or fit.LABORATORY for c in _CHAIN) for k in (*keys, *patients)})
    if len(chains) > 1:
        raise _usage(
            f"cycles of {len(chains)} chains of methods: " + "; ".join(", ".join(c) for c in chains[:4]),
            "one chain: restrict by " + ", ".join(_CHAIN),
        )
    cycles, people = _cycles(keys)
    query = {
        "populations": sorted(populations),
        "subjects": sorted({k["subject"] for k in keys}),
        "pooled_populations": sorted(pooled_populations),
        "fit_sets": sorted({k["fit_set"] for k in keys}),
        "methods": {k: keys[0][k] for k in _CHAIN},
        "variance": variance,
        "pace": pace,
    }
    rows = (gdi.NormativeSet & {"norm_name": name}).proj("norm_version", "norm_sha256")
    newest = next(iter(rows.to_dicts(order_by="norm_version DESC")), None)
    norm, checks = lib.norm_from_cycles(
        cycles,
        people,
        name=name,
        version=newest["norm_version"] if newest else 1,
        source=source or f"built here from the cycles of {', '.join([*populations, *subjects])}",
        variables=lib.NINE_ANGLES if nine_angles else lib.THREE_ANGLES,
        variance=variance,
        pooled=_cycles(patients)[0],
    )
    made = {"checks": checks, "n_people": len(set(people)), "n_cycles": norm.n}
    with new_folder() as folder:
        file = folder / "norm.json"
        sha256 = norm.save(file, digits=None)
        if newest:
            # Under the number of the newest version the same cycles make the same bytes: nothing to register then.
            if sha256 == newest["norm_sha256"]:
                return BuiltNorm(norm=newest["norm"], new=False, set=norm, **made)
            norm = dataclasses.replace(norm, version=norm.version + 1)
            sha256 = norm.save(file, digits=None)
        row = gdi.norm_row(dataclasses.replace(norm, sha256=sha256))
        gdi.NormativeSet.insert1({**row, "norm_file": file, "norm_query": plain(query)})
        return BuiltNorm(norm=row["norm"], new=True, set=norm, **made)


def load_norm(norm: str) -> lib.NormativeSet:
    """Return the library's set of a key (`name-v2`) or name (its newest version). Raises `PblError` NORM_UNKNOWN."""
    return gdi.norm_of_row(*gdi.norm_ref({"norm": gdi.norm_keys(norm)[0]}))


def _cycle_keys(people: Sequence[dict], restriction: Any, pace: str) -> list[dict[str, Any]]:
    """Keys of GaitCycle of the current fits of these people who walk at this pace, with subject and methods."""
    found = (
        newest_sets()
        * session.Session.proj("subject")
        * lab.Subject.proj("population")
        * fit.FitSet.Video.proj("tracking_method", "keypoint_method")
        * gait.GaitCycle.proj()
    )
    query = found & list(people) & restriction
    done = video.conditions(query.proj())
    return [k for k in query.to_dicts(order_by="KEY") if done[k["video_id"]].pooled(pace)]


def _cycles(keys: Sequence[dict[str, Any]]) -> tuple[list[lib.GaitCycle], list[str]]:
    cycles, people = [], []
    for key in keys:
        found = gait.load_cycles({k: key[k] for k in gait.GaitCycle.primary_key}, str(key["video_id"]))
        cycles += found
        people += [key["subject"]] * len(found)
    return cycles, people


def _must_exist(table: Any, column: str, wanted: Sequence[str]) -> None:
    known = set(table.to_arrays(column))
    absent = [w for w in wanted if w not in known]
    if absent:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no {column} {', '.join(absent)}",
            expected="one of " + ", ".join(sorted(map(str, known))) if known else f"a registered {column}",
            next_step="choose one of these",
        )
