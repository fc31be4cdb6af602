"""Gait Deviation Index of each trial and of the session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import definition, to_row
from pbl_pipeline.results.index import Gdi, GdiCycle, MovementProfile, NormFacts, SessionMetrics, VariableScore
from pbl_pipeline.results.measures import Measure

from . import fit, gait, session, video  # noqa: F401  a definition refers to session
from .datajoint_setup import dj
from .method_rows import method_row, method_table, one_of, resolve_method
from .origin import Origin, computes, origin_columns
from .record_parts import measures_of, part_of
from .rows import InputChanged, Rows, one, row_of, stored_rows, utc_now
from .stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib

schema = dj.Schema()


@schema
class NormativeSet(dj.Lookup):
    definition = f"""
    # healthy gait that an index compares with
    norm                : varchar(48)          # name and version
    ---
    {definition(NormFacts)}
    norm_components=null : int16               # components of the index
    norm_file=null      : <object@arrays>      # JSON of the whole set; null for one that ships with the code
    norm_query=null     : json                 # whose cycles it was built from; null for one that ships
    norm_created=null   : datetime             # when registered, UTC
    unique index (norm_sha256)
    """


GdiModel = schema(method_table("GdiModel", "gdi", "gdi", "the index"))


@schema
class GdiPlan(dj.Manual):
    definition = """
    # which sessions get which index against which norm
    -> session.Session
    -> GdiModel
    -> NormativeSet
    """


@schema
class GDI(dj.Computed):
    definition = f"""
    # index of a trial: 100 is normative, 10 points are one normative standard deviation
    -> gait.GaitCycle
    -> GdiModel
    -> NormativeSet
    ---
    -> session.Session
    {definition(Gdi, "gdi")}
    {definition(MovementProfile, "gdi")}
    {origin_columns("gdi")}
    index (gdi_status)
    """

    Cycle = part_of("Cycle", GdiCycle, key="-> gait.GaitCycle.Cycle")

    Profile = part_of(
        "Profile", VariableScore, "gdi", "Movement Analysis Profile: how far each angle of the norm is from it"
    )

    Check = part_of("Check", Quality, "index", "quality checks of the index")

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * GdiPlan
        return (gait.GaitCycle.proj() * GdiModel.proj() * NormativeSet.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        name = one(fit.SessionFit.Trial & key, "trial_name")
        rows = (gait.GaitCycle.Cycle & key).to_dicts(order_by="cycle_no")
        cycles = [{k: v for k, v in r.items() if k not in key} for r in rows]
        curves = file_ref(one(gait.GaitCycle & key, "curves"))
        norm = norm_ref(key)
        return name, cycles, curves, norm, method_row(GdiModel, key)

    @computes
    def make_compute(
        self, key: dict, name: str, rows: Sequence[Mapping[str, Any]], ref: dict, norm: tuple, method: Mapping[str, Any]
    ) -> tuple[Gdi, str, str]:
        from pbl_pipeline.gait import score_gdi

        index = methods.stored(**method)
        cycles = gait.cycles_of_rows(rows, ref, name)
        result = score_gdi(cycles, norm_of_row(*norm), index.params, index)
        return result, index.hash, norm[1]

    def make_insert(self, key: dict, result: Gdi, sha: str, norm_sha: str, origin: Origin) -> None:
        row = {**to_row(result, "gdi"), **to_row(result.profile or MovementProfile, "gdi")}
        of_model = origin.row("gdi", method_hash=sha, model_sha256=norm_sha)
        self.insert1({**fit.of_session(key), **row, **of_model})
        self.Cycle.insert_records(key, result.cycles)
        self.Profile.insert_records(key, result.profile.scores if result.profile else ())
        self.Check.insert_records(key, result.qc)


#: Measures whose mean stands in the row of the visit.
_MEANS = tuple(gait.MEASURE_COLUMNS)[:6]


@schema
class SessionGdi(dj.Computed):
    definition = f"""
    # all used cycles of the trials of a set that are walked at the pace of the index: measures and index of the visit
    -> fit.SessionFit
    -> gait.GaitEventMethod
    -> GdiModel
    -> NormativeSet
    ---
    -> session.Session
    {definition(SessionMetrics, only=("status", "reason"))}
    {definition(Gdi, "session_gdi", without=("status",))}
    {definition(MovementProfile, "session")}
    session_cycles              : int16        # used cycles
    session_corrected           : int16        # trials of the set whose events a person corrected
    {definition(SessionMetrics, only=("params_hash",))}
    {gait.mean_columns(_MEANS, "session_")}
    {origin_columns("session_gdi")}
    index (session_status)
    """

    class Trial(dj.Part):
        definition = """
        # the trials of the set; those that are walked at the pace of the index are pooled
        -> master
        -> GDI
        -> gait.Spatiotemporal
        """

    Measure = measures_of(
        Measure,
        "session_measure",
        "every measure with both sides and its spread",
        "session_measure : varchar(32)",
        of_visit=True,
    )

    Profile = part_of(
        "Profile", VariableScore, "session", "Movement Analysis Profile: how far each angle of the norm is from it"
    )

    Check = part_of("Check", Quality, "gdi", "quality checks of measures and index")

    @property
    def key_source(self) -> Any:
        """Sets all of whose trials have their cycles, measures and index: the rows that the visit pools."""
        planned = fit.FitSet.proj("session_id") * gait.GaitPlan * GdiPlan
        methods_ = gait.GaitEventMethod.proj() * GdiModel.proj() * NormativeSet.proj()
        trials = fit.SessionFit.Trial.proj() * methods_ & planned
        ready = GDI.proj() * gait.Spatiotemporal.proj()
        return (fit.SessionFit.proj() * methods_ & planned) - (trials - ready).proj()

    def make_fetch(self, key: dict) -> tuple:
        fit.session_of_set(key)  # waits for a decision that is being written
        of_trials = (
            fit.SessionFit.Trial.proj("trial_name")
            * gait.GaitEvents.proj("events_reason")
            * gait.GaitCycle.proj("curves", "correction_no", "cycles_computed")
            * gait.Spatiotemporal.proj("measures_reason")
            * GDI.proj()
        )
        trials = (of_trials & key).to_dicts(order_by="video_id")
        if len(trials) != len(fit.SessionFit.Trial & key):
            raise InputChanged("cycles or index of a trial are gone", key)
        done = video.conditions([{"video_id": r["video_id"]} for r in trials])
        return (
            [{**r, "curves": file_ref(r["curves"])} for r in trials],
            (gait.GaitCycle.Cycle & key).to_dicts(order_by="video_id, cycle_no"),
            [(c.activity, c.pace) for c in done.values()],
            norm_ref(key),
            method_row(gait.GaitEventMethod, key),
            method_row(GdiModel, key),
        )

    @computes
    def make_compute(
        self,
        key: dict,
        trials: Sequence[Mapping[str, Any]],
        cycles: Sequence[Mapping[str, Any]],
        conditions: Sequence[tuple[str, str]],
        norm: tuple,
        events: Mapping[str, Any],
        index: Mapping[str, Any],
    ) -> tuple[SessionMetrics, Sequence[Mapping[str, Any]], str, str]:
        from pbl_pipeline import gait as lib

        model = methods.stored(**index)
        params = lib.GaitParams(methods.stored(**events).paramset, model.params)
        pooled = []
        for trial in trials:
            name, rows = trial["trial_name"], [r for r in cycles if r["video_id"] == trial["video_id"]]
            detected = trial["events_reason"] if trial["correction_no"] is None else ""
            own = tuple(gait.cycles_of_rows(rows, trial["curves"], name))
            pooled.append(lib.TrialCycles(name, detected or trial["measures_reason"], own))
        done = [lib.Condition(*c) for c in conditions]
        return lib.pool_trials(pooled, norm_of_row(*norm), params, model, conditions=done), trials, model.hash, norm[1]

    def make_insert(
        self,
        key: dict,
        result: SessionMetrics,
        trials: Sequence[Mapping[str, Any]],
        sha: str,
        norm_sha: str,
        origin: Origin,
    ) -> None:
        measures, index = result.spatiotemporal, result.gdi
        self.insert1(
            {
                **fit.of_session(key),
                **to_row(result, without=("spatiotemporal", "gdi")),
                **to_row(index, "session_gdi", without=("status",)),
                **to_row(index.profile or MovementProfile, "session"),
                "session_cycles": measures.n_cycles_used,
                "session_corrected": sum(r["correction_no"] is not None for r in trials),
                **gait.mean_row(measures.measures, _MEANS, "session_"),
                **origin.row("session_gdi", method_hash=sha, model_sha256=norm_sha),
            }
        )
        self.Trial.insert({**key, "video_id": r["video_id"]} for r in trials)
        self.Measure.insert_measures(key, measures.measures, measures.reasons)
        self.Profile.insert_records(key, index.profile.scores if index.profile else ())
        self.Check.insert_records(key, result.qc)


def pace_of(gdi_method: str, rows: Rows = stored_rows) -> str:
    """The pace that an index pools, by the key of its method."""
    from pbl_pipeline.gait import SELF_SELECTED

    return row_of(GdiModel, {"gdi_method": gdi_method}, rows)["gdi_params"].get("pace", SELF_SELECTED)


def norm_row(norm: lib.NormativeSet) -> dict[str, Any]:
    """A normative set of the library as a row, without file and query."""
    own = {"norm": f"{norm.name}-v{norm.version}", "norm_components": len(norm.components), "norm_created": utc_now()}
    return {**own, **to_row(norm)}


def norm_keys(name: str) -> list[str]:
    """Return the keys of the normative sets that a key (`name-v2`) or a name means, the newest version first. Raises
    `PblError` NORM_UNKNOWN."""
    rows = NormativeSet.proj("norm_name", "norm_version").to_dicts(order_by="norm_version DESC")
    found = [row["norm"] for row in rows if name in (row["norm"], row["norm_name"])]
    if found:
        return found
    raise PblError(
        "NORM_UNKNOWN", found=f"normative set {name!r}", **one_of({row["norm_name"] for row in rows}, "pbl norm list")
    )


def norm_ref(key: Mapping[str, Any]) -> tuple[str, str, dict | None]:
    """Return the arguments of `norm_of_row`: name, checksum and, for a set that was built here, its file."""
    name, sha256, stored = one(NormativeSet & key, "norm_name", "norm_sha256", "norm_file")
    return name, sha256, None if stored is None else file_ref(stored)


def norm_of_row(name: str, sha256: str, ref: Mapping[str, Any] | None = None) -> lib.NormativeSet:
    """The library's normative set, checked to be the one of the row. Raises NORM_UNKNOWN, NORM_INVALID."""
    from pbl_pipeline.gait import load_norm

    norm = load_norm(name) if ref is None else read_stored(ref, lambda path: load_norm(str(path)))
    if norm.sha256 != sha256:
        raise PblError(
            "NORM_INVALID",
            found=said("normative set {name} with SHA-256 {sum}", name=name, sum=norm.sha256),
            expected=f"SHA-256 {sha256}, as the row says",
            next_step="use the version of pbl-pipeline that wrote the row, or plan the session with the newer set",
        )
    return norm


def resolve(model: str | None, norm: str | None) -> dict[str, str]:
    """Keys of the index and the normative set by name; a set left out is the index's own. Raises `PblError`
    SOLVER_UNKNOWN, NORM_UNKNOWN; NORM_INVALID for a set of other angles than the index has."""
    from pbl_pipeline import gait as lib

    method = resolve_method(GdiModel, model or lib.GDI_METHODS.default)
    name, params = (GdiModel & {"gdi_method": method}).fetch1("gdi_method_name", "gdi_params")
    found = norm_keys(norm or params["norm"])[0]
    variables = tuple((NormativeSet & {"norm": found}).fetch1("norm_variables"))
    if variables != lib.MODEL_ANGLES.get(name, variables):
        raise PblError(
            "NORM_INVALID",
            found=f"normative set {found} of {len(variables)} angles for {method}",
            expected=f"a set of {len(lib.MODEL_ANGLES[name])} angles",
            next_step="leave the set out, or name another (`pbl norm list`)",
        )
    return {"gdi_method": method, "norm": found}
