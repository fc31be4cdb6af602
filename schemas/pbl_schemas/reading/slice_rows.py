"""Frozen slices by name, for `visits` and for `studies.slices`, which itself reads visits."""

from __future__ import annotations

from typing import Any

from pbl_pipeline.errors import PblError

from .. import study


def slice_row(name: str) -> dict[str, Any]:
    """Return the row of a slice, its kind also as `fit_set_kind`. Raises `PblError` DB_NOT_FOUND for an unknown one."""
    found = (study.StudySlice & {"study_slice": name}).to_dicts()
    if not found:
        known = ", ".join(sorted(study.StudySlice().to_arrays("study_slice"))) or "none yet"
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no slice {name!r}",
            expected=f"a slice that was frozen ({known})",
            next_step="`pbl study slice NAME --cohort ...` freezes one; --dry-run shows its visits before",
        )
    return {**found[0], "fit_set_kind": found[0]["slice_kind"]}


def chain_of(name: str) -> tuple[dict[str, str], Any]:
    """Kind and methods of a slice's results, from the fit on, and a query of the sets of the visits that count. Raises
    `PblError` DB_NOT_FOUND for an unknown slice."""
    about = slice_row(name)
    own = study.StudySliceVisit & {"study_slice": name, "slice_included": True} & "slice_fit_set != ''"
    later = ("fit_set_kind", "fit_method", "gait_method", "gdi_method", "norm")
    return {k: about[k] for k in later}, own.proj(fit_set="slice_fit_set")
