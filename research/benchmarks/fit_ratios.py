"""Ratios of the rows of `pbl bench fit --json`: what the project's bars compare.

python -m research.benchmarks.ratios fit.json
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from pbl_pipeline.bench import Row, accuracy, number, rate, solver_name, table

COLUMNS = {
    "seconds": "warm s",
    "sessions_per_s": "sessions/s",
    "memory": "memory",
    "all_error": "all deg",
    "main_error": "main deg",
    "loss": "loss",
}


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Pairs of rows that a bar compares: the solvers, held against still, a batch against one, twice the frames.

    Each is {"what", "seconds", "all_error", "main_error", "loss", "memory"}: the first named over the second, None
    where one of them is missing.
    """
    found = []
    good = [r for r in rows if r.get("warm_seconds")]
    for a in good:
        for b in good:
            what = _compared(a, b)
            if what:
                pair = {"what": what, "seconds": _over(a.get("warm_seconds"), b.get("warm_seconds"))}
                if a["batch"] > 1:
                    pair = {"what": what, "sessions_per_s": _over(rate(a), rate(b))}
                elif a["section"] == "long" and a["solver"] == b["solver"]:
                    pair["memory"] = _over(a["host_bytes"], b["host_bytes"])
                else:
                    pair["all_error"] = _over(accuracy(a, "all_deg"), accuracy(b, "all_deg"))
                    pair["main_error"] = _over(accuracy(a, "main_deg"), accuracy(b, "main_deg"))
                    pair["loss"] = _over(a.get("paper_loss"), b.get("paper_loss"))
                found.append(pair)
    return found


def _compared(a: Row, b: Row) -> str:
    """In words what the ratio a / b of two rows is; empty where nobody compares them."""
    if a["section"] != b["section"]:
        return ""
    x, y = a["data"], b["data"]
    size = f"{x['n_trials']} trial{'s' * (x['n_trials'] > 1)}"
    differ = {k for k in ("n_trials", "motion", "n_frames", "trouble") if x[k] != y[k]}
    differ |= {"solver"} if solver_name(a) != solver_name(b) else set()
    differ |= {"batch"} if a["batch"] != b["batch"] else set()
    if differ == {"solver"} and a["solver"] == "implicit-adam" and a["batch"] == 1:
        where = f"{x['n_frames']:,} frames" if a["section"] == "long" else size
        trouble = f", {x['trouble']}" if a["section"] == "robust" else ""
        return f"{solver_name(a)} / {solver_name(b)}, {where}, {x['motion']}{trouble}"
    if differ == {"motion"} and x["motion"] == "handheld" and a["batch"] == 1 and a["section"] == "speed":
        return f"handheld / static, {solver_name(a)}, {size}"
    if differ == {"batch"} and b["batch"] == 1:
        return f"batch {a['batch']} / one by one, {solver_name(a)}, {size}, {x['motion']}"
    if differ == {"n_frames"} and x["n_frames"] > y["n_frames"]:
        return f"{x['n_frames']:,} / {y['n_frames']:,} frames, {solver_name(a)}, {x['motion']}"
    if differ == {"trouble"} and y["trouble"] == "none":
        return f"{x['trouble']} / none, {solver_name(a)}, {x['motion']}"
    return ""


def _over(a: float | None, b: float | None) -> float | None:
    return a / b if a is not None and b else None


@click.command(epilog="Example: python -m research.benchmarks.ratios fit.json")
@click.argument("json_path", type=click.Path(path_type=Path, exists=True, dir_okay=False))
def main(json_path: Path) -> None:
    """Print the ratios of the rows in JSON_PATH."""
    click.echo(ratio_text(json.loads(json_path.read_text())["rows"]))


def ratio_text(rows: Sequence[Row]) -> str:
    """The ratios as a table."""
    pairs = ratios(rows)
    known = {k: title for k, title in COLUMNS.items() if any(p.get(k) is not None for p in pairs)}
    columns = [("ratio of", lambda r: r["what"])]
    columns += [(title, lambda r, key=key: number(r.get(key), 3)) for key, title in known.items()]
    return table(pairs, columns) if pairs else "no two rows to compare"


if __name__ == "__main__":
    main()
