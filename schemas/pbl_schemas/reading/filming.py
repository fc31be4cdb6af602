"""Circumstances of filming of results, from the rows of their recordings: a few queries for many visits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pbl_pipeline.filming import Filming, height_word, known, picture_class, stated, views_of
from pbl_pipeline.records import number

from .. import fit, gait, gdi, keypoints, study, video
from ..rows import grouped, inside, parts


def filming_of(results: Sequence[Mapping[str, Any]]) -> list[Filming]:
    """Return how each result was filmed, in their order.

    results: rows with session_id, fit_set, fit_set_kind, fit_method, gait_method and gdi_method.
    """
    return [filming for some in parts(results) for filming in _filming_of(some)]


def _filming_of(results: Sequence[Mapping[str, Any]]) -> list[Filming]:
    from pbl_pipeline.gait import mostly

    of_visit = inside("session_id", {int(r["session_id"]) for r in results})
    sets = inside("fit_set", {str(r["fit_set"]) for r in results})
    used = (gait.GaitCycle.Cycle & sets & {"cycle_used": True}).proj("cycle_far_leg").to_dicts()
    chain = ("fit_set", "fit_method", "gait_method")
    cycles = grouped((tuple(r[k] for k in chain), (int(r["video_id"]), r["cycle_far_leg"] or "")) for r in used)
    deep = {(r["fit_set"], r["fit_method"]) for r in (fit.SessionFit.Depth & sets).proj().to_dicts()}
    heights = {
        (key := (r["fit_set"], r["fit_method"])): height_word(number(r["fit_height"]), key in deep)
        for r in (fit.SessionFit & sets).proj("fit_height").to_dicts()
    }
    filmed = fit.FitSet.Video * keypoints.Keypoints.proj("camera_kind") * video.VideoInfo.proj("width", "height")
    recordings = grouped((row["fit_set"], row) for row in (filmed & sets).to_dicts())
    done = video.conditions((fit.FitSet.Video & sets).proj())
    visits = {int(r["session_id"]): r for r in (study.Visit & of_visit).to_dicts()}
    paces = {name: gdi.pace_of(name) for name in {r["gdi_method"] for r in results}}
    out = []
    for r in results:
        pace, one_camera = paces[r["gdi_method"]], r["fit_set_kind"] == fit.SINGLE
        own = [c for c in cycles.get(tuple(r[k] for k in chain), ()) if done[c[0]].pooled(pace)]
        counted = {v for v, _ in own}  # a recording without a cycle that counts changes nothing
        about = [v for v in recordings.get(r["fit_set"], ()) if int(v["video_id"]) in counted] if one_camera else []
        visit = visits.get(int(r["session_id"]), {"assistive_device": "", "orthosis": ""})
        out.append(
            Filming(
                views=views_of(own) if one_camera else (),
                aid=stated("aid", visit["assistive_device"]),
                orthosis=stated("orthosis", visit["orthosis"]),
                paces=known(done[v].pool for v in counted),
                height=known(heights[r["fit_set"], r["fit_method"]] for _ in counted),
                cameras=known(v["camera_kind"] for v in about),
                pictures=known(picture_class(v["width"], v["height"]) for v in about),
                far_leg=mostly(np.array([far for _, far in own])),
            )
        )
    return out
