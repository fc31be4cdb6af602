"""Gait Deviation Index of each trial and of the session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from pbl_pipeline.errors import PblError

from . import fit, gait, session  # noqa: F401  a definition refers to session
from ._base import (
    Origin,
    check_columns,
    check_row,
    computes,
    dj,
    file_ref,
    library,
    method_arguments,
    method_columns,
    number,
    origin_columns,
    rebuild_params,
    resolve_method,
    stored_file,
)

schema = dj.Schema()


@schema
class NormativeSet(dj.Lookup):
    definition = """
    # healthy gait that an index compares with
    norm                : varchar(48)          # name and version
    ---
    norm_name           : varchar(40)
    norm_version        : int16
    norm_sha256         : char(64)             # of its numbers
    norm_n              : int32                # normative vectors
    norm_variables      : json                 # angles of the index, in order
    norm_source         : varchar(1000)        # who measured whom, and where it is published
    norm_convention     : varchar(1000)        # how its angles are defined
    norm_licence        : varchar(500)
    unique index (norm_sha256)
    """


@schema
class GdiModel(dj.Lookup):
    definition = f"""
    # frozen parameters of the index
    {method_columns("gdi")}
    """


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
    gdi_status      : enum('PASS', 'EMPTY')
    gdi_reason      : varchar(1000)            # why EMPTY
    gdi=null        : float32                  # (-) mean over all used cycles
    gdi_left=null   : float32                  # (-)
    gdi_right=null  : float32                  # (-)
    gdi_n           : int16                    # cycles with an index
    {origin_columns("gdi")}
    """

    class Cycle(dj.Part):
        definition = """
        -> master
        -> gait.GaitCycle.Cycle
        ---
        cycle_gdi       : float32              # (-)
        cycle_z         : float32              # (-) standardised log distance to the normative mean
        cycle_explained : float32              # (0..1) share of the deviation that the index sees
        """

    class Check(dj.Part):
        definition = f"""
        # quality checks of the index
        {check_columns("index")}
        """

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * GdiPlan
        return (gait.GaitCycle.proj() * GdiModel.proj() * NormativeSet.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        name = (fit.SessionFit.Trial & key).fetch1("trial_name")
        rows = (gait.GaitCycle.Cycle & key).to_dicts(order_by="cycle_no")
        cycles = [{k: v for k, v in r.items() if k not in key} for r in rows]
        curves = file_ref((gait.GaitCycle & key).fetch1("curves"))
        norm = (NormativeSet & key).fetch1("norm_name", "norm_sha256")
        return name, cycles, curves, norm, method_arguments(GdiModel, "gdi", "gdi", key["gdi_method"])

    @computes
    def make_compute(
        self, key: dict, name: str, rows: Sequence[Mapping[str, Any]], ref: dict, norm: tuple, method: Mapping[str, Any]
    ) -> tuple:
        params = rebuild_params(library("gait").GdiParams, **method)
        with stored_file(self, ref) as path:
            curves = gait.load_curves(path)
        cycles = [gait.cycle_of_row(r, name, curves.get(int(r["cycle_no"]))) for r in rows]
        return library("gait").score_gdi(cycles, norm_of_row(*norm), params), method["sha"], norm[1]

    def make_insert(self, key: dict, result: Any, sha: str, norm_sha: str, origin: Origin) -> None:
        self.insert1(
            {
                **key,
                "gdi_status": result.status,
                "gdi_reason": result.reason[:1000],
                "gdi": number(result.mean),
                "gdi_left": number(result.left),
                "gdi_right": number(result.right),
                "gdi_n": result.n,
                **origin.row("gdi", method_hash=sha, model_sha256=norm_sha),
            }
        )
        self.Cycle.insert(
            {**key, "cycle_no": c.number, "cycle_gdi": c.gdi, "cycle_z": c.z, "cycle_explained": c.explained}
            for c in result.cycles
        )
        self.Check.insert({**key, **check_row("index", check)} for check in result.qc)


@schema
class SessionGdi(dj.Computed):
    definition = f"""
    # all used cycles of all trials of a set together: measures and index of the visit, as in metrics.json
    -> fit.SessionFit
    -> gait.GaitEventMethod
    -> GdiModel
    -> NormativeSet
    ---
    session_status              : enum('PASS', 'EMPTY')
    session_reason              : varchar(2000)  # why EMPTY
    session_gdi_reason          : varchar(1000)  # why there is no index
    session_gdi=null            : float32      # (-) mean over all used cycles
    session_gdi_left=null       : float32      # (-)
    session_gdi_right=null      : float32      # (-)
    session_gdi_n               : int16        # cycles with an index
    session_cycles              : int16        # used cycles
    session_params_hash         : char(16)     # hash over the parameters of events and index together
    session_cadence=null        : float32      # (steps/min)
    session_stride_time=null    : float32      # (s)
    session_step_time=null      : float32      # (s)
    session_stance=null         : float32      # (percent) of the cycle
    session_swing=null          : float32      # (percent) of the cycle
    session_double_support=null : float32      # (percent) of the cycle
    {origin_columns("session_gdi")}
    """

    class Measure(dj.Part):
        definition = f"""
        # every measure with both sides and its spread
        {gait.measure_columns("session_measure")}
        """

    class Check(dj.Part):
        definition = f"""
        # quality checks of measures and index
        {check_columns("gdi")}
        """

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * gait.GaitPlan * GdiPlan
        keys = fit.SessionFit.proj() * gait.GaitEventMethod.proj() * GdiModel.proj() * NormativeSet.proj()
        return keys & planned

    def make_fetch(self, key: dict) -> tuple:
        rows = (fit.SessionFit.Trial & key).to_dicts(order_by="video_id")
        return (
            [file_ref(r["trial_file"]) for r in rows],
            (NormativeSet & key).fetch1("norm_name", "norm_sha256"),
            method_arguments(gait.GaitEventMethod, "gait", "gait", key["gait_method"]),
            method_arguments(GdiModel, "gdi", "gdi", key["gdi_method"]),
            fit.fit_checks(key),
        )

    @computes
    def make_compute(
        self,
        key: dict,
        refs: Sequence[dict],
        norm: tuple,
        events: Mapping[str, Any],
        index: Mapping[str, Any],
        checks: Sequence[tuple],
    ) -> tuple:
        lib = library("gait")
        params = lib.GaitParams(rebuild_params(lib.EventParams, **events), rebuild_params(lib.GdiParams, **index))
        with ExitStack() as stack:
            paths = [stack.enter_context(stored_file(self, ref)) for ref in refs]
            trials = [library("fit").TrialFit.load(path) for path in paths]
        about_fit = [library("qc").Check(*check) for check in checks]
        return lib.gait_metrics(trials, norm_of_row(*norm), params, about_fit), index["sha"], norm[1]

    def make_insert(self, key: dict, result: Any, sha: str, norm_sha: str, origin: Origin) -> None:
        measures, index = result.spatiotemporal, result.gdi
        columns = ("cadence", "stride_time", "step_time", "stance", "swing", "double_support")
        by_column = {column: name for name, column in gait.MEASURE_COLUMNS.items()}
        self.insert1(
            {
                **key,
                "session_status": result.status,
                "session_reason": result.reason[:2000],
                "session_gdi_reason": index.reason[:1000],
                "session_gdi": number(index.mean),
                "session_gdi_left": number(index.left),
                "session_gdi_right": number(index.right),
                "session_gdi_n": index.n,
                "session_cycles": measures.n_cycles_used,
                "session_params_hash": result.params_hash,
                **{f"session_{c}": gait.mean_of(measures.measures[by_column[c]]) for c in columns},
                **origin.row("session_gdi", method_hash=sha, model_sha256=norm_sha),
            }
        )
        rows = gait.measure_rows(measures.measures, measures.reasons, prefix="session_measure")
        self.Measure.insert({**key, **row} for row in rows)
        self.Check.insert({**key, **check_row("gdi", check)} for check in result.qc)


def norm_of_row(name: str, sha256: str) -> Any:
    """The library's normative set, checked to be the one of the row. Raises NORM_UNKNOWN, NORM_INVALID."""
    norm = library("gait").load_norm(name)
    if norm.sha256 != sha256:
        raise PblError(
            "NORM_INVALID",
            found=f"normative set {name} with SHA-256 {norm.sha256}",
            expected=f"SHA-256 {sha256}, as the row says",
            next_step="use the version of pbl-pipeline that wrote the row, or plan the session with the newer set",
        )
    return norm


def resolve(model: str | None, norm: str | None) -> dict[str, str]:
    """Keys of the index and the normative set by name. Raises SOLVER_UNKNOWN, NORM_UNKNOWN."""
    wanted = norm or library("gait").DEFAULT_NORM
    rows = NormativeSet.proj("norm_name", "norm_version").to_dicts(order_by="norm_version DESC")
    found = next((r["norm"] for r in rows if wanted in (r["norm"], r["norm_name"])), None)
    if found is None:
        raise PblError(
            "NORM_UNKNOWN",
            found=f"normative set {wanted!r}",
            expected="one of " + ", ".join(r["norm_name"] for r in rows),
            next_step="choose one of the names above",
        )
    return {"gdi_method": resolve_method(GdiModel, "gdi", model or library("gait").GDI_MODEL), "norm": found}
