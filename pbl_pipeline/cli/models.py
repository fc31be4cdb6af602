"""`pbl models`: the keypoint models of this machine."""

from __future__ import annotations

import click

_DEVICE = click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), help="Where to run it (else PBL_ONNX_DEVICE, else auto)."
)


@click.group(epilog="Example: pbl models add metrabs-l/")
def models() -> None:
    """Keypoint models as ONNX (docs/models.md): list, add, verify, remove.

    Use a registered model with `pbl detect --keypoints NAME`, `pbl run --keypoints NAME` and
    `pbl ingest --keypoint-method NAME`. This software includes none; each has its own licence, which is shown.
    """


@models.command("list", epilog="Example: pbl models list")
def list_() -> None:
    """List the registered models with their licences, and check that their files are unchanged."""
    from pbl_pipeline import models as library
    from pbl_pipeline import settings

    found = library.registered()
    for model in found:
        if model.spec is None:
            assert model.error is not None
            click.echo(f"{model.name}: {model.error.code}, {model.error.found}\n  next:    {model.error.next_step}")
            continue
        _show(model.spec)
    if not found:
        click.echo(f"no registered model in {settings.models_dir()}; `pbl models add FOLDER_OR_URL` (docs/models.md)")
    if any(model.error for model in found):
        raise click.exceptions.Exit(1)


@models.command(epilog="Example: pbl models add https://lab.example/rtmpose-m.zip --sha256 3f2a...")
@click.argument("source", metavar="FOLDER_OR_URL")
@click.option("--sha256", metavar="HEX", help="SHA-256 of the archive; an address needs it.")
@click.option("--replace", is_flag=True, help="Replace another model that is registered under the name.")
def add(source: str, sha256: str | None, replace: bool) -> None:
    """Register a model from its folder, or from a .zip or .tar archive in a file or at an address.

    Checksum, graph and output shapes are checked, and the model is run once, before anything is stored.
    """
    from pbl_pipeline import models as library

    spec, model = library.add(source, sha256, replace=replace)
    _show(spec)
    click.echo(f"registered; loads on {model.device}, its batch is {model.fixed_batch or 'any'}")
    if spec.joint_names:
        click.echo(f"use it:  pbl detect VIDEO --keypoints {spec.name} --out FILE.npz")


@models.command(epilog="Example: pbl models verify metrabs-l --device cuda")
@click.argument("names", metavar="[NAME]...", nargs=-1)
@_DEVICE
def verify(names: tuple[str, ...], device: str | None) -> None:
    """Load registered models (without a name: all) and run each once on a black picture."""
    from pbl_pipeline import models as library
    from pbl_pipeline.errors import PblError

    failed: list[PblError] = []
    for name in names or [m.name for m in library.registered()]:
        try:
            model = library.OnnxModel(library.find(name), device)
        except PblError as error:
            click.echo(f"{name}: {error.code}, {error.found}")
            failed.append(error)
        else:
            click.echo(f"{name}: ok on {model.device}" + (f" ({model.note})" if model.note else ""))
    if failed:
        raise failed[0]


@models.command(epilog="Example: pbl models remove rtmpose-m")
@click.argument("name")
def remove(name: str) -> None:
    """Delete a registered model. Results made with it stay; methods that use it fail until it is added again."""
    from pbl_pipeline import models as library

    click.echo(f"removed {library.remove(name)}")


def _show(spec) -> None:
    from pbl_pipeline.body import MARKER_SETS

    what = spec.kind
    if spec.joint_names:
        own = "" if spec.marker_set in MARKER_SETS else "; not a set of the body: `pbl fit --marker-set TABLE.csv`"
        what += f", {len(spec.joint_names)} points ({spec.marker_set}{own})"
    sides = sum(i != m for i, m in enumerate(spec.mirror)) // 2
    click.echo(f"{spec.name}: {what}")
    click.echo(f"  licence: {spec.licence}")
    click.echo(f"  source:  {spec.source}")
    click.echo(
        f"  input:   {spec.input.width} x {spec.input.height} px"
        + (f"; {sides} pairs of left and right" if sides else "")
    )
    click.echo(f"  sha256:  {spec.sha256}")
