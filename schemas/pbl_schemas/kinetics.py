"""Ground reactions, joint moments and powers of each visit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import definition, number, to_row
from pbl_pipeline.results.forces import CycleKinetics, KineticMeasure, TrialKinetics
from pbl_pipeline.results.forces import Kinetics as Result
from pbl_pipeline.temporary import new_folder

from . import capture, fit, gait, gdi, session, study, video
from .datajoint_setup import dj
from .method_rows import method_row, method_table
from .origin import Origin, computes, origin_columns
from .record_parts import measures_of, part_of
from .rows import InputChanged
from .stored_files import file_ref

if TYPE_CHECKING:
    from pbl_pipeline.gait import GaitCycle, GaitEvents

schema = dj.Schema()


KineticsMethod = schema(method_table("KineticsMethod", "kinetics", "kinetics", "forces and joint moments"))


@schema
class KineticsPlan(dj.Manual):
    definition = """
    # which sessions get forces and joint moments by which method
    -> session.Session
    -> KineticsMethod
    """


@schema
class Kinetics(dj.Computed):
    definition = f"""
    # forces and joint moments over the used cycles of the trials that the index of the visit pools; per body weight and kilogram
    -> gdi.SessionGdi
    -> KineticsMethod
    ---
    -> session.Session
    {definition(Result, without=("residual_bw",))}
    forces_aid           : varchar(64)         # walking aid as it was stated, empty: nothing stated
    {definition(Result, only=("residual_bw",))}
    {origin_columns("forces")}
    index (forces_status)
    """  # noqa: E501

    Measure = measures_of(
        KineticMeasure,
        "force",
        "every measure of the visit with both sides and the standard deviation of its error",
        "force_measure : varchar(64)",
    )

    class Trial(dj.Part):
        definition = f"""
        # the trials of the set, each with its curves
        -> master
        -> gait.GaitCycle
        ---
        {definition(TrialKinetics)}
        trial_forces=null   : <object@arrays>  # npz: forces, moments and powers over time, curves of the cycles; null where there are none; docs/files.md
        """  # noqa: E501

    class Cycle(dj.Part):
        definition = f"""
        # measures of each cycle; null where contact or motion is not known over the whole stance
        -> master
        -> gait.GaitCycle.Cycle
        ---
        vertical_peak_loading_bw=null             : float64  # (body weight)
        vertical_peak_push_off_bw=null            : float64  # (body weight)
        vertical_impulse_bw_s=null                : float64  # (body weight s)
        braking_impulse_bw_s=null                 : float64  # (body weight s)
        propulsion_impulse_bw_s=null              : float64  # (body weight s)
        knee_extension_moment_peak_nm_per_kg=null : float64  # (Nm/kg) internal
        knee_adduction_moment_peak_nm_per_kg=null : float64  # (Nm/kg) external
        ankle_push_off_power_w_per_kg=null        : float64  # (W/kg)
        hip_work_j_per_kg=null                    : float64  # (J/kg)
        knee_work_j_per_kg=null                   : float64  # (J/kg)
        ankle_work_j_per_kg=null                  : float64  # (J/kg)
        centre_of_mass_excursion_m=null           : float64  # (m)
        {definition(CycleKinetics, without=("number",))}
        """

    Check = part_of("Check", Quality, "forces", "quality checks of the forces")

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * KineticsPlan
        return (gdi.SessionGdi.proj() * KineticsMethod.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        mass_kg, aid = stated_of(fit.session_of_set(key))
        of_trials = fit.SessionFit.Trial.proj("trial_name", "trial_file") * gait.GaitCycle.proj("cycles_computed")
        rows = (of_trials & key).to_dicts(order_by="video_id")
        if len(rows) != len(fit.SessionFit.Trial & key):
            raise InputChanged("cycles of a trial are gone", key)
        pace = gdi.pace_of(key["gdi_method"])
        done = video.conditions([{"video_id": r["video_id"]} for r in rows])
        trials = [
            {
                **{k: r[k] for k in ("video_id", "trial_name", "cycles_computed")},
                "file": file_ref(r["trial_file"]),
                "events": gait.load_events(r),
                "pooled": done[r["video_id"]].pooled(pace),
            }
            for r in rows
        ]
        cycles = (gait.GaitCycle.Cycle & key).to_dicts(order_by="video_id, cycle_no")
        return trials, cycles, mass_kg, aid or _aid_of_phones(rows), method_row(KineticsMethod, key)

    @computes
    def make_compute(
        self,
        key: dict,
        trials: Sequence[Mapping[str, Any]],
        cycles: Sequence[Mapping[str, Any]],
        mass_kg: float | None,
        aid: str,
        method: Mapping[str, Any],
    ) -> tuple[Result, list[int], str]:
        from pbl_pipeline.kinetics import visit_kinetics

        fits, walks = [], []
        for trial in trials:
            fits.append(dataclasses.replace(fit.load_trial(trial["file"]), name=trial["trial_name"]))
            own = [gait.cycle_of_row(r, trial["trial_name"]) for r in cycles if r["video_id"] == trial["video_id"]]
            walks.append(_Walk(trial["events"], tuple(own), trial["pooled"]))
        found = visit_kinetics(fits, walks, methods.stored(**method), mass_kg=mass_kg, aid=aid)
        return found, [int(t["video_id"]) for t in trials], aid

    def make_insert(self, key: dict, found: Result, ids: list[int], aid: str, origin: Origin) -> None:
        from pbl_pipeline.kinetics.kinetics_file import save_arrays

        row = {**to_row(found), "forces_aid": aid, **origin.row("forces", method_hash=found.params_hash)}
        self.insert1({**fit.of_session(key), **row})
        self.Measure.insert_measures(key, {**dict.fromkeys(found.reasons), **found.measures}, found.reasons)
        with new_folder() as folder:
            for number_of, trial in zip(ids, found.trials, strict=True):
                path = folder / f"{number_of}.kinetics.npz"
                if trial.series is not None:
                    save_arrays(trial, path)
                of_trial, file = {**key, "video_id": number_of}, None if trial.series is None else path
                self.Trial.insert1({**of_trial, **to_row(trial), "trial_forces": file})
                self.Cycle.insert({**of_trial, **to_row(c), **c.measures} for c in trial.cycles)
        self.Check.insert_records(key, found.qc)


@dataclasses.dataclass(frozen=True)
class _Walk:
    """The `pbl_pipeline.kinetics.Walk` of a trial."""

    events: GaitEvents
    cycles: tuple[GaitCycle, ...]
    pooled: bool


def stated_of(session_id: int) -> tuple[float | None, str]:
    """Return body mass (kg) and walking aid as stated of a visit, None and "" if nothing is.

    A locking read, which sees what is committed whenever this transaction began (as `gait.correction_of`).
    """
    row = session.Session.connection.query(
        f"SELECT body_mass, assistive_device FROM {session.Session.full_table_name}"  # noqa: S608
        f" LEFT JOIN {session.BodyMass.full_table_name} USING (session_id)"
        f" LEFT JOIN {study.Visit.full_table_name} USING (session_id) WHERE session_id = %s LOCK IN SHARE MODE",
        args=(session_id,),
    ).fetchone()
    return (None, "") if row is None else (number(row[0]), row[1] or "")


def _aid_of_phones(videos: Sequence[Mapping[str, Any]]) -> str:
    """Return the first walking aid that the phones stated which filmed these videos."""
    sent = capture.PhoneRecording & [{"video_id": r["video_id"]} for r in videos]
    rows = sent.proj("phone_about").to_dicts(order_by="phone_recording")
    return next(filter(None, (str(r["phone_about"].get("aid", "")) for r in rows)), "")
