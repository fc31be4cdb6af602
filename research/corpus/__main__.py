"""`python -m research.corpus`: the error of the index and of the gait measures over a corpus of known walks."""

from __future__ import annotations

import time
from pathlib import Path

import click


@click.command(epilog="Example: python -m research.corpus --quick --motions motions --out gdi-error")
@click.option(
    "--motions",
    type=click.Path(path_type=Path, readable=False),
    metavar="DIR",
    help="Recorded motions with their index.csv: their straight walks take part.",
)
@click.option("--method", metavar="FIT", help="Method of the fit, or a JSON file of one (default: that of the points).")
@click.option(
    "--detector",
    default="blazepose-heavy",
    show_default=True,
    metavar="NAME",
    help="Error model: blazepose-heavy, blazepose-33 or metrabs-87.",
)
@click.option("--index", metavar="NAME", help="Method of the index, or a JSON file of one (default: three angles).")
@click.option("--together", metavar="VIEW,...", help="Views that make one session, such as sagittal,sagittal_right.")
@click.option("--quick", is_flag=True, help="Two synthetic people and one view per impairment: about 60 cases.")
@click.option("--heights", is_flag=True, help="Tell the fit how tall each person is.")
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Write CSV and JSON there.")
def main(
    motions: Path | None,
    method: str | None,
    detector: str,
    index: str | None,
    together: str | None,
    quick: bool,
    heights: bool,
    out: Path,
) -> None:
    """Fit walks whose truth is known, and print how far index, measures and angles are off (research/README.md).

    Synthetic people, healthy and with each impairment, and recorded walks on the body, seen by the detector's error
    model from the front, the back, both sides and obliquely, by a standing and a held phone. Half of the persons are
    held out; parameters are to be chosen on the others only.
    """
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.fit import METHODS, default_fit
    from pbl_pipeline.gait import GDI_METHODS
    from pbl_pipeline.method_file import named_or_file
    from research.corpus.errors import corpus_errors, corpus_tables, print_corpus, write_corpus
    from research.corpus.walks import corpus, detector_model

    check_out_folder(out)
    start = time.perf_counter()
    model = detector_model(detector)
    chosen = named_or_file(METHODS, method or default_fit((model.marker_set, model.root_relative)))
    scored = named_or_file(GDI_METHODS, index)
    cases = corpus(detector, motions, quick=quick, together=together.split(",") if together else ())
    people = len({c.walk.person for c in cases})
    click.echo(f"{len(cases)} cases of {people} people, fit {chosen.key}, index {scored.key}")
    made = time.perf_counter()
    errors = corpus_errors(cases, chosen.paramset, heights=heights, index=scored)
    tables = corpus_tables(errors)
    click.echo(print_corpus(tables))
    about = {
        "detector": detector,
        "method": chosen.name,
        "version": chosen.version,
        "params_hash": chosen.hash,
        "index": scored.name,
        "index_version": scored.version,
        "index_params_hash": scored.hash,
        "together": together,
        "quick": quick,
        "heights": heights,
        "motions": motions is not None,
        "seconds": round(time.perf_counter() - start, 1),
    }
    paths = write_corpus(out, errors, tables, about)
    failed = sum(code != "" for code in errors["error"])
    click.echo(
        f"\n{len(cases)} cases ({failed} not fitted): walks {made - start:.0f} s, fits and measures "
        f"{time.perf_counter() - made:.0f} s; {', '.join(map(str, paths))}"
    )


if __name__ == "__main__":
    main()
