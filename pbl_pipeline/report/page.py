"""Page of a report: plain values for the template, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
from markupsafe import Markup

from pbl_pipeline.code_version import code_version
from pbl_pipeline.files import complete_file
from pbl_pipeline.gait import (
    GILLETTE_MODEL,
    Z90,
    GaitCycle,
    Gdi,
    Measure,
    NormalBands,
    NormativeSet,
    Spatiotemporal,
    far_leg_of,
    leg_length_m,
    load_norm,
    norm_names,
    normal_bands,
    worth_of_one_more,
)
from pbl_pipeline.keypoints import confidence_text, visibility
from pbl_pipeline.qc import EMPTY, FAIL, NEEDS_CHOICE, OUTCOMES, PASS, WARN, Check
from pbl_pipeline.report import _figures
from pbl_pipeline.report._figures import Picture
from pbl_pipeline.report.forces import forces_section
from pbl_pipeline.report.words import HEADLINES, OUTCOME_WORDS, VERDICT_WORDS, plural, sentence, size
from pbl_pipeline.shipped import shipped_page, shipped_text
from pbl_pipeline.texts import LANGUAGES, page_in
from pbl_pipeline.visit import Recording, Visit
from pbl_pipeline.words import ANGLES, FOOT_ANGLES, MEASURES, PELVIS_ANGLES, TASKS, check_words, number, significant

#: Outcome of the check of a choice by its status, where no one was chosen.
_UNCHOSEN = {"NEEDS_CHOICE": NEEDS_CHOICE, "NO_PERSON": FAIL}
_CONVERGED = {True: "converged", False: "not converged", None: "convergence not recorded"}


def page_of(visit: Visit, pictures: Mapping[str, Sequence[Picture]], title: str) -> dict:
    """Return everything that the template shows."""
    norm = _norm(visit)
    recordings = visit.fitted or visit.recordings
    checks = _checks(visit, recordings)
    metrics = visit.measures
    empty = metrics is None or metrics.status != PASS
    page: dict = {
        "title": title,
        "meta": [
            ("Subject", visit.subject),
            ("Visit", visit.date or visit.label),
            ("Recordings", ", ".join(r.name for r in recordings)),
        ],
        "verdict": _verdict(visit, recordings, checks),
        "tiles": [],
        "measures": [],
        "cycle_charts": [],
        "index": None,
        "forces": None,
        "checks": [_check_row(c) for c in checks],
        "trials": [_trial(r, pictures.get(r.name, ())) for r in recordings],
        "open_time_charts": empty,
        "key_cycles": _figures.legend("left", "right", "cycles", "norm", "foot off"),
        "key_contacts": _figures.legend("stance", "initial contact", "toe-off", "in view"),
        "key_time": _figures.legend("left", "right", "stance"),
        "event_methods": [] if metrics is None else list(dict.fromkeys(t.events.method for t in metrics.trials)),
        "scale_assumed": any(
            r.fit is not None and not r.fit.sized and r.fit.orientation_source != "measured: calibration"
            for r in visit.fitted
        ),
        "norm": norm,
        "origin": _origin(visit, recordings, norm),
        "version": code_version(),
    }
    if metrics is not None and not empty:
        values = metrics.spatiotemporal
        cycles = metrics.cycles
        page["tiles"] = [*(_tile(k, values[k], values.reasons.get(k, "")) for k in HEADLINES), _gdi_tile(metrics.gdi)]
        page["measures"] = [
            *(_measure_row(MEASURES[k], values[k], values.reasons.get(k, "")) for k in MEASURES),
            _gdi_row(metrics.gdi),
        ]
        page["cycles_used"], page["cycles_found"] = plural(values.n_cycles_used, "gait cycle"), values.n_cycles_found
        bands = _bands(visit)
        page["cycle_charts"] = _figures.cycle_charts(cycles, bands)
        page["bands"] = {"words": bands.words(), "source": bands.source}
        page["far_leg"] = far_leg_of(cycles)
        people = "the norm" if norm is None else f"the norm's {norm.n} typically developing children"
        page["index"] = _index(metrics.gdi, cycles, people)
        page["forces"] = forces_section(visit)
    return page


def _norm(visit: Visit) -> NormativeSet | None:
    """Return the set that the index names, where it is one that ships."""
    name = "" if visit.measures is None else visit.measures.gdi.norm
    return load_norm(name) if name in norm_names() else None


def _bands(visit: Visit) -> NormalBands:
    fit = next((r.fit for r in visit.fitted), None)
    leg = None if fit is None else leg_length_m(fit.scale)
    return normal_bands(None if visit.measures is None else visit.measures.spatiotemporal.measures, leg)


def _checks(visit: Visit, recordings: Sequence[Recording]) -> list[Check]:
    """Return all checks, earlier stages first, each once: what a trial and its visit both say is said by the visit."""
    checks = [c for c in visit.checks if c not in visit.fit_checks]
    for r in recordings:
        if r.choice is not None and r.choice.status in _UNCHOSEN:
            outcome = _UNCHOSEN[r.choice.status]
            checks.append(Check("subject_choice", outcome, None, None, f"{r.name}: {r.choice.reason}"))
    checks += visit.fit_checks
    if visit.measures is not None:
        for t in visit.measures.trials:
            checks += t.events.qc
        checks += visit.measures.qc
    return list(dict.fromkeys(checks))


def _verdict(visit: Visit, recordings: Sequence[Recording], checks: list[Check]) -> dict:
    metrics = visit.measures
    measured = metrics is not None and metrics.status == PASS
    outcomes = [c.outcome if metrics is None else metrics.in_session(c) for c in checks]
    outcome = max(outcomes, key=OUTCOMES.index, default=PASS)
    if metrics is None and outcome in (PASS, WARN, EMPTY):
        outcome = FAIL
    elif metrics is not None and not measured and outcome in (PASS, WARN):
        outcome = EMPTY
    notable = [c for c, o in zip(checks, outcomes, strict=True) if o == outcome and outcome not in (PASS, EMPTY)]
    problems = [f"{r.name}: {r.problem}" for r in recordings if r.problem]
    asking = f"{len(notable)} of {plural(len(checks), 'check')} {'asks' if len(notable) == 1 else 'ask'}"
    texts = {
        PASS: "All checks passed.",
        WARN: f"{asking} for attention:",
        EMPTY: _why_empty(visit),
        NEEDS_CHOICE: "Several people are in view and none is clearly the subject:",
        FAIL: "The chain ended before there was anything to measure:"
        if metrics is None
        else "A check failed. The results below do not show how the person moves:",
    }
    points = [f"{check_words(c.check)}: {c.advice}" if c.advice else check_words(c.check) for c in notable]
    return {
        "outcome": outcome,
        "word": VERDICT_WORDS[outcome],
        "sentence": texts[outcome],
        "points": [sentence(p) for p in [*points, *problems]],
    }


def _why_empty(visit: Visit) -> str:
    metrics = visit.measures
    if metrics is None or not metrics.reason:
        return "No one walks in these recordings."
    if len(metrics.trials) == 1:
        return sentence(metrics.trials[0].reason or metrics.reason)
    return metrics.reason + "."  # begins with the name of a trial, which is not capitalised


def _tile(key: str, m: Measure | None, reason: str) -> dict:
    name, unit, decimals = MEASURES[key]
    if m is None:
        return {"name": name, "value": None, "reason": reason}
    return {
        "name": name,
        "value": number(m.mean, decimals),
        "unit": unit,
        "left": None if m.left is None else number(m.left, decimals),
        "right": None if m.right is None else number(m.right, decimals),
        "note": f"sd {number(m.sd, _sd_decimals(decimals))}, n {m.n}",
    }


def _gdi_tile(gdi: Gdi) -> dict:
    if gdi.mean is None:
        return {"name": gdi.title, "value": None, "reason": gdi.reason}
    return {
        "name": gdi.title,
        "value": number(gdi.mean, 1),
        "unit": "",
        "left": number(gdi.left, 1),
        "right": number(gdi.right, 1),
        "note": gdi.error_words() or f"sd {number(_gdi_sd(gdi), 1)}, n {gdi.n}",
    }


def _measure_row(words: tuple[str, str, int], m: Measure | None, reason: str) -> dict:
    name, unit, decimals = words
    if m is None:
        return {"name": name, "known": False, "reason": reason or "no reason was recorded"}
    return {
        "name": name,
        "known": True,
        "left": number(m.left, decimals),
        "right": number(m.right, decimals),
        "mean": number(m.mean, decimals),
        "sd": number(m.sd, _sd_decimals(decimals)),
        "n": m.n,
        "error": _error(m.error_sd, _sd_decimals(decimals)),
        "cv": number(m.cv_percent, 1),
        "asymmetry": number(m.asymmetry_percent, 1),
        "unit": unit,
    }


def _error(sd: float | None, decimals: int) -> str:
    """Half the 90 % interval of a value; "" if its error is not known."""
    return "" if sd is None else f"\N{PLUS-MINUS SIGN}{number(Z90 * sd, decimals)}"


def _task_rows(found: Spatiotemporal) -> list[dict]:
    return [_measure_row(TASKS[name], m, found.reasons.get(name, "")) for name, m in found.of_task.items()]


def _gdi_row(gdi: Gdi) -> dict:
    found = None
    if gdi.mean is not None:
        found = Measure(gdi.left, gdi.right, gdi.mean, _gdi_sd(gdi), gdi.n, error_sd=gdi.sd)
    return _measure_row((gdi.title, "100 = norm, 10 = 1 sd", 1), found, gdi.reason)


def _gdi_sd(gdi: Gdi) -> float | None:
    values = [c.gdi for c in gdi.cycles]
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _index(gdi: Gdi, cycles: Sequence[GaitCycle], people: str) -> dict:
    values = {side: [c.gdi for c in gdi.cycles if c.side == side] for side in ("left", "right")}
    fitted = ""
    if gdi.mean is None:
        text = f"Not known: {gdi.reason}"
    else:
        text = (
            f"Mean {number(gdi.mean, 1)} over {plural(gdi.n, 'cycle')}: left {number(gdi.left, 1)} "
            f"(n {gdi.n_left}), right {number(gdi.right, 1)} (n {gdi.n_right})"
        )
        if interval := gdi.error_words():
            text += f"; {interval}: less between two visits filmed alike may be chance"
        if more := worth_of_one_more(cycles, gdi):
            text += f"; {more}"
            fitted = " as it was fitted, without the correction for the view that the values above have"
    which = (
        "This is the original Gait Deviation Index of nine angles."
        if gdi.model == GILLETTE_MODEL
        else "This index uses hip flexion, hip adduction and knee flexion. It is not the original Gait Deviation Index "
        "of nine angles, and the two must not be compared."
    )
    return {
        "title": gdi.title,
        "svg": _figures.index_chart(values, gdi.title),
        "sentence": sentence(text),
        "note": f"Each dot is one gait cycle{fitted}, the bar the mean of its side; the grey area is within one "
        f"standard deviation of {people}. {which}",
        "profile": _profile(gdi),
    }


def _profile(gdi: Gdi) -> list[dict]:
    """Rows of the Movement Analysis Profile: difference of each angle from the norm's mean curve."""
    p = gdi.profile
    if p is None:
        return []
    titles = {k: v[0] for k, v in {**ANGLES, **PELVIS_ANGLES, **FOOT_ANGLES}.items()}
    rows = [
        {"name": titles.get(a, a), "left": number(p.left.get(a), 1), "right": number(p.right.get(a), 1)}
        for a in dict.fromkeys([*p.left, *p.right])
    ]
    if p.gps is not None:
        name = f"Gait Profile Score (of the person {number(p.gps, 1)})"
        rows.append({"name": name, "left": number(p.gps_left, 1), "right": number(p.gps_right, 1)})
    return rows


def _trial(t: Recording, pictures: Sequence[Picture]) -> dict:
    v, m = t.video, t.measured
    texts = []
    if v is not None:
        texts.append(
            f"{number(v.duration_s, 1)} s, {v.n_frames} frames of {v.width_px} x {v.height_px} px, "
            f"{number(v.fps, 1)} frames/s{' (variable)' if v.variable_frame_rate else ''}"
        )
    if t.choice is not None and t.choice.reason:
        texts.append(t.choice.reason)
    if t.fit is not None:
        spans = _figures.known_spans(t.fit)
        where = ", ".join(f"{number(a, 1)} to {number(b, 1)} s" for a, b in spans[:4])
        texts.append(f"The body is fitted from {where}" if spans else "The body is fitted in no frame")
        if np.isfinite(t.fit.residual_2d_px).any():
            # Share of the height and distance in space are in the checks, over the points that the fit counts.
            px = number(float(np.nanmedian(t.fit.residual_2d_px)), 1)
            texts.append(f"It lies {px} px (median) from the points detected in the picture")
    if m is not None and m.reason:
        texts.append(f"No gait measures: {m.reason}")
    if t.problem:
        texts.append(t.problem)
    events = m.events if m is not None else None
    return {
        "name": t.name,
        "sentence": " ".join(sentence(x) for x in texts),
        "task": [] if m is None else _task_rows(m.spatiotemporal),
        "contacts": _figures.contact_chart(t.fit, events) if t.fit is not None and events is not None else None,
        "time_charts": _figures.time_charts(t.fit, events) if t.fit is not None else [],
        "pictures": [_figures.picture(t.name, p) for p in pictures],
    }


def _check_row(c: Check) -> dict:
    return {
        "name": check_words(c.check),
        "outcome": c.outcome,
        "word": OUTCOME_WORDS[c.outcome],
        "value": significant(c.value),
        "threshold": significant(c.threshold),
        "advice": "" if c.outcome == PASS else sentence(c.advice),
    }


def _origin(visit: Visit, recordings: Sequence[Recording], norm: NormativeSet | None) -> list[dict]:
    """Return groups of (name, value, is code)."""
    groups = [{"name": f"Recording {r.name}", "rows": _recording_origin(r)} for r in recordings]
    s = visit.solution
    if s is not None:
        rows = [
            ("Solver", f"{s.solver}, parameters {s.params_hash}", True),
            ("Steps", f"{'not recorded' if s.iterations is None else s.iterations}, {_CONVERGED[s.converged]}", False),
            ("Time", f"{s.seconds:.1f} s, of these {s.compile_seconds:.1f} s compiling, on {s.device}", False),
        ]
        if fits := [r.fit for r in visit.fitted if r.fit is not None]:
            rows.append(("Body model (SHA-256)", fits[0].body_sha256, True))
            rows.append(("Camera motion", ", ".join(sorted({f.camera_motion for f in fits})), False))
            rows.append(("Vertical", ", ".join(sorted({f.orientation_source for f in fits})), False))
        groups.append({"name": "Fit", "rows": rows})
    if visit.measures is not None:
        gdi = visit.measures.gdi
        rows = [
            ("Parameters", visit.measures.params_hash, True),
            (gdi.title, f"{gdi.model}, parameters {gdi.params_hash}", True),
            ("Normative set", gdi.norm, True),
        ]
        if norm is not None:
            rows += [("Source of the norm", norm.source, False), ("Licence of the norm", norm.licence, False)]
            rows.append(("Norm (SHA-256)", norm.sha256, True))
        groups.append({"name": "Gait measures", "rows": rows})
    if visit.methods:
        groups.append({"name": "Methods", "rows": [(k, v, False) for k, v in visit.methods.items()]})
    software = {"pbl-pipeline": code_version()}
    software |= {f"keypoints of {r.name}": r.keypoints.origin for r in recordings if r.keypoints and r.keypoints.origin}
    groups.append({"name": "Software", "rows": [(k, v, False) for k, v in software.items()]})
    return groups


def _recording_origin(r: Recording) -> list[tuple[str, str, bool]]:
    v, m, rows = r.video, r.measured, []
    if v is not None:
        device = " ".join(x for x in (v.make, v.model) if x)
        rows += [
            ("File", PurePath(v.path).name, False),
            ("SHA-256", v.sha256, True),
            ("Size, coding", f"{size(v.size_bytes)}, {v.codec} in {v.container}", False),
            ("Recorded", f"{v.recorded_utc or 'time unknown'}{', ' + device if device else ''}", False),
        ]
    if r.keypoints is not None:
        rows.append(("Keypoints", f"{r.keypoints.marker_set}, {plural(len(r.keypoints.names), 'point')}", False))
        rows.append(("In view", visibility(r.keypoints).text(), False))
        rows.append(("Confidence", confidence_text(r.keypoints), False))
    camera = r.fit.camera if r.fit is not None else r.keypoints.camera if r.keypoints is not None else None
    if camera is not None and np.isfinite(camera.matrix).all():
        rows.append(("Camera", f"{camera.source}; focal length {camera.matrix[0, 0]:.0f} px", False))
    if r.fit is not None and r.fit.depth is not None:
        rows.append(("Depth recording", r.fit.depth.name, False))
        rows.append(("Depth recording (SHA-256)", r.fit.depth.sha256, True))
    if v is not None:
        rows += [("Remark", note, False) for note in v.notes]
    if m is not None:
        by_hand = ", corrected by hand" if m.events.corrected else ""
        rows.append(("Gait events", f"{m.events.method}, parameters {m.events.params_hash}{by_hand}", True))
    return rows


def _sd_decimals(decimals: int) -> int:
    return decimals + 1 if decimals >= 2 else decimals


def write_report(
    path: str | Path,
    visit: Visit,
    pictures: Mapping[str, Sequence[Picture]] | None = None,
    title: str = "Gait report",
    language: str = LANGUAGES[0],
) -> Path:
    """Write the report of a visit as one HTML file and return its path.

    The file contains its pictures, charts and styles and loads nothing, so that it can be mailed, printed and opened
    from a folder. Every text is escaped. The page of a visit without gait states that and shows the angles over time.
    The file appears when it is complete.

    `pictures`: by the name of the recording. `language`: one of `texts.LANGUAGES`. Raises as `Recording.fit` and
    `Recording.keypoints`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    template = shipped_page("report/templates/report.html")
    css = Markup(shipped_text("report/templates/report.css"))  # noqa: S704  our own file
    page = page_of(visit, pictures or {}, title)
    html = template.render(page=page, css=css, language=language)
    with complete_file(path) as part:
        part.write_text(page_in(language, html), encoding="utf-8")
    return path
