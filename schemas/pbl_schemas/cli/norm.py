"""`pbl norm`: the normative sets that a Gait Deviation Index compares with."""

from __future__ import annotations

from pathlib import Path

import click

from ._kind import kind_option


@click.group(epilog="Example: pbl norm build our-lab --population healthy")
def norm() -> None:
    """List, show and build the normative sets of the Gait Deviation Index."""


@norm.command("list", epilog="Example: pbl norm list")
def list_sets() -> None:
    """The sets in the database, including those that ship with the code; without a database the latter alone."""
    from pbl_pipeline.errors import PblError
    from pbl_pipeline.gait import load_norm, norm_names
    from pbl_schemas import activate, gdi

    try:
        activate()
        rows = gdi.NormativeSet.proj(
            "norm_n", "norm_variables", "norm_components", "norm_angle_model", "norm_query"
        ).to_dicts(order_by="norm_name, norm_version")
    except PblError as error:
        if not error.code.startswith("DB_"):
            raise
        click.echo(f"no database ({error.code}): the sets that ship", err=True)
        rows = [{**gdi.norm_row(load_norm(name)), "norm_query": None} for name in norm_names()]
    click.echo(f"{'set':<34}{'vectors':>8}{'angles':>8}{'components':>12}  {'definition':<14}from")
    for r in rows:
        origin = "ships with the code" if r["norm_query"] is None else f"{len(r['norm_query']['subjects'])} people here"
        click.echo(
            f"{r['norm']:<34}{r['norm_n']:>8}{len(r['norm_variables']):>8}{r['norm_components']:>12}  "
            f"{r['norm_angle_model']:<14}{origin}"
        )


@norm.command("show", epilog="Example: pbl norm show our-lab-v2 --out our-lab.json")
@click.argument("name")
@click.option("--out", type=click.Path(path_type=Path), help="Also write the set as JSON, for `pbl gait --norm FILE`.")
def show(name: str, out: Path | None) -> None:
    """Print source and content of the set NAME; a name without a version is its newest.

    Sets that ship are shown without a database.
    """
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.gait import load_norm, norm_names

    if out is not None:
        check_out_file(out)
    shipped = {f"{s.name}-v{s.version}": s for s in map(load_norm, norm_names())}
    found = shipped.get(name) or shipped.get(f"{name}-v1")
    if found is None:
        import pbl_schemas
        from pbl_schemas import norms

        pbl_schemas.activate()
        found = norms.load_norm(name)
    lines = {
        "set": f"{found.name}-v{found.version}",
        "vectors": str(found.n),
        "angles": ", ".join(found.variables),
        "definition": f"{found.angle_model}: {found.convention}",
        "components": f"{len(found.components)}, {100 * found.explained_share:.1f} % of the variance",
        "ln distance": f"{found.ln_mean:.6f} +- {found.ln_sd:.6f}",
        "source": found.source,
        "licence": found.licence or "-",
        "SHA-256": found.sha256,
    }
    for key, value in lines.items():
        click.echo(f"{key:<13}{value}")
    if out is not None:
        found.save(out, digits=None)
        click.echo(f"written: {out}")


@norm.command(
    "build",
    epilog="\b\nExample: pbl norm build our-lab --population healthy\n"
    "Example: pbl norm build our-lab --subject C01 --subject C02 --fit blazepose-v1 --pool patient",
)
@click.argument("name")
@click.option("--population", "populations", multiple=True, help="Everybody of this group (default: healthy).")
@click.option("--subject", "subjects", multiple=True, help="This person; repeat for several.")
@click.option("--pool", "pooled", multiple=True, help="Group whose cycles the components are fitted to as well.")
@click.option("--fit", "fit_method", help="Fit method, where the tables hold several.")
@click.option("--gait", "gait_method", help="Event method, where the tables hold several.")
@click.option("--keypoints", "keypoint_method", help="Keypoint method, where the tables hold several.")
@kind_option
@click.option("--nine-angles", is_flag=True, help="All nine angles, for gillette-2008.")
@click.option("--variance", type=click.FloatRange(0.5, 0.999), default=0.95, show_default=True)
@click.option("--pace", default="self_selected", show_default=True, help="Videos walked at this pace; any for all.")
@click.option("--source", default="", help="Who measured whom, to be kept with the set.")
def build(
    name: str,
    populations: tuple[str, ...],
    subjects: tuple[str, ...],
    pooled: tuple[str, ...],
    nine_angles: bool,
    variance: float,
    pace: str,
    source: str,
    **methods: str | None,
) -> None:
    """Build the set NAME from the gait cycles of people in the database and register it as a new version.

    Registered sets never change. Plan sessions with the new one by `pbl ingest VIDEO --norm NAME`.
    """
    import pbl_schemas
    from pbl_schemas.norms import build_norm

    pbl_schemas.activate()
    built = build_norm(
        name,
        populations or (() if subjects else ("healthy",)),
        subjects,
        pooled,
        {k: v for k, v in methods.items() if v} or True,
        nine_angles=nine_angles,
        variance=variance,
        source=source,
        pace=pace,
    )
    kind = "registered" if built.new else "known already, nothing was changed"
    click.echo(f"{built.norm}: {kind}; {built.n_cycles} cycles of {built.n_people} people")
    click.echo(f"{len(built.set.components)} components, {100 * built.set.explained_share:.1f} % of the variance")
    for check in built.checks:
        if check.advice:
            click.echo(f"{check.outcome} {check.check}: {check.advice}")
