"""`pbl calibrate`: a camera file from a video of a board."""

from __future__ import annotations

from pathlib import Path

import click

from pbl_pipeline.names import whole_number


class Squares(click.ParamType):
    """`9x6`: squares along and across."""

    name = "NxM"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int] | None:
        if isinstance(value, tuple):
            return value
        along, _, across = str(value).lower().partition("x")
        if (a := whole_number(along)) is not None and (b := whole_number(across)) is not None:
            return a, b
        return self.fail(f"{value!r} is not of the form 9x6", param, ctx)


@click.command(epilog="Example: pbl calibrate board.mov --board charuco --squares 9x6 --square-mm 25 --out camera.json")
@click.argument("video", type=click.Path(path_type=Path, readable=False))
@click.option("--board", type=click.Choice(["checkerboard", "charuco"]), required=True, help="Kind of board.")
@click.option("--squares", type=Squares(), required=True, help="Squares (not corners) along and across, such as 9x6.")
@click.option("--square-mm", type=float, required=True, help="Side of a square, measured on the print.")
@click.option("--marker-mm", type=float, help="Side of a marker of a ChArUco board (else: 3/4 of a square).")
@click.option("--dictionary", default="DICT_5X5_100", show_default=True, help="Markers of a ChArUco board.")
@click.option("--legacy", is_flag=True, help="ChArUco board printed by OpenCV before 4.6.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Camera file to write (.json).")
def calibrate(
    video: Path,
    board: str,
    squares: tuple[int, int],
    square_mm: float,
    marker_mm: float | None,
    dictionary: str,
    legacy: bool,
    out: Path,
) -> None:
    """Measure the lens of a camera from VIDEO, in which it films a flat board from many sides.

    Pass OUT to --camera of `pbl run`, `pbl detect` and `pbl ingest`; a picture next to it shows which parts of the view
    the board covered and the residuals of the fitted lens. Film with the settings of your recordings: the same phone,
    lens, resolution, stabilisation, and the focus locked. docs/camera.md explains filming and the figures.
    """
    import cv2

    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.video import Board, about_phone, calibrate_video, draw_calibration, phone_lens, probe

    if out.suffix.lower() != ".json":
        raise click.BadParameter(f"{out} does not end in .json", param_hint="--out")
    plate = Board(board, squares, square_mm, marker_mm, dictionary, legacy)
    picture = out.with_suffix(".png")
    check_out_file(out)
    check_out_file(picture)
    info = probe(video)
    found = calibrate_video(video, plate, info)
    source = f"pbl calibrate: {board} of {squares[0]}x{squares[1]} squares of {square_mm:g} mm"
    found.save(out, {"source": source, **about_phone(info)})
    picture.write_bytes(cv2.imencode(".png", draw_calibration(found))[1].tobytes())
    matrix, sd = found.camera.matrix, found.sd
    k = found.camera.distortion
    click.echo(f"{len(found.views)} views used, the board found in {found.n_found} of {found.n_tried} sharp pictures")
    click.echo(f"focal length     {matrix[0, 0]:.1f} +- {sd[0]:.1f} and {matrix[1, 1]:.1f} +- {sd[1]:.1f} px")
    click.echo(f"principal point  {matrix[0, 2]:.1f} +- {sd[2]:.1f}, {matrix[1, 2]:.1f} +- {sd[3]:.1f} px")
    click.echo(f"distortion       k1 {k[0]:.4f} k2 {k[1]:.4f} p1 {k[2]:.5f} p2 {k[3]:.5f} k3 {k[4]:.4f}")
    click.echo(f"residual         {found.rms_px:.2f} px (rms)")
    click.echo(f"coverage         {found.coverage:.0%} of the picture, tilts of up to {found.tilt_deg:.0f} deg")
    for note in info.notes:
        click.echo(f"  {note}")
    click.echo(f"{out}\n{picture}")
    if (lens := phone_lens(info)) is not None:
        click.echo(f"for every video of this lens ({lens.text()}): pbl camera add {out}")
