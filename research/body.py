"""Write the body's MJCF and the BML-MoVi marker table from figures: `python -m research.body FIGURES.json`.

Needed only when the figures or the shapes change. The body's SHA-256 changes with them, and every fit names the SHA-256
it was made with. Bodies, positions, joints, ranges, masses, centres of mass and scale groups are the figures'. The
project's own are

- the shapes (`_shapes.py`), for looks only: they touch nothing;
- the inertias. The body is used for kinematics only, but MuJoCo wants a valid one, so each is that of a solid
  cylinder of the body's mass, along y, with the length and radius below. Do not use them for dynamics.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import click

from research.body_shapes import RGBA, SHAPES, mirrored
from research.paths import PACKAGE

MODEL_NAME = "pbl_body_40"
MODEL_VERSION = "1"
SOURCE = (
    "OpenSim full-body running model of Hamner, Seth & Delp 2010 (J Biomech 43:2709) in its published MuJoCo port "
    "with a 3-DoF neck and BML-MoVi marker sites"
)

#: length and radius in m of the cylinder that stands for a body's inertia (right side; the left is equal).
_CYLINDER: dict[str, tuple[float, float]] = {
    "pelvis": (0.18, 0.13),
    "femur": (0.37, 0.08),
    "tibia": (0.46, 0.05),
    "talus": (0.06, 0.03),
    "calcn": (0.10, 0.06),
    "toes": (0.03, 0.03),
    "torso": (0.50, 0.15),
    "head": (0.22, 0.09),
    "humerus": (0.33, 0.045),
    "ulna": (0.27, 0.03),
    "radius": (0.27, 0.03),
    "hand": (0.18, 0.03),
}


def body_xml(figures: dict[str, Any]) -> str:
    """The MJCF text. `figures` is the parsed body_model_figures.json: metres, kilograms, degrees."""
    root = ET.Element("mujoco", model=MODEL_NAME)
    # The command had this name when the file was made; the words are part of its SHA-256.
    root.append(ET.Comment(f" Written by pbl_pipeline.body.build. Figures: {SOURCE}. Shapes are for looks only. "))
    ET.SubElement(root, "compiler", angle="degree", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", gravity="0 0 -9.80665")
    default = ET.SubElement(root, "default")
    ET.SubElement(default, "geom", contype="0", conaffinity="0", mass="0", rgba=RGBA)
    custom = ET.SubElement(root, "custom")
    ET.SubElement(custom, "text", name="version", data=MODEL_VERSION)
    for group, members in figures["scale_groups"].items():
        # "overall" is the scale of every body that is in no other group.
        data = "*" if isinstance(members, str) else " ".join(members)
        ET.SubElement(custom, "text", name=f"scale_group/{group}", data=data)
    elements: dict[str, ET.Element] = {"world": ET.SubElement(root, "worldbody")}
    for body in figures["bodies"]:
        parent = elements[body["parent"]]
        elements[body["name"]] = _body(parent, body, upright=body["parent"] == "world")
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _body(parent: ET.Element, body: dict[str, Any], *, upright: bool) -> ET.Element:
    element = ET.SubElement(parent, "body", name=body["name"], pos=_text(body["pos"]))
    if upright:
        # The body frames have y up, the world z: a quarter turn about x. The slides turn with it, so pelvis_ty is up.
        element.set("euler", "90 0 0")
    length, radius = _CYLINDER[body["name"].removesuffix("_r").removesuffix("_l")]
    across, along = body["mass"] * (3 * radius**2 + length**2) / 12, body["mass"] * radius**2 / 2
    inertia = [f"{x:.6g}" for x in (across, along, across)]
    ET.SubElement(element, "inertial", pos=_text(body["com"]), mass=f"{body['mass']:g}", diaginertia=" ".join(inertia))
    for joint in body["joints"]:
        attributes = {"name": joint["name"], "type": joint["type"], "axis": _text(joint["axis"])}
        if joint["range"] is not None:
            attributes["range"] = _text(joint["range"])
        ET.SubElement(element, "joint", attributes)
    side = body["name"][-2:] if body["name"][-2:] in ("_r", "_l") else ""
    for shape in SHAPES[body["name"].removesuffix(side)]:
        placed = mirrored(shape) if side == "_l" else shape
        where = {"fromto": _text([*placed.start, *placed.end])} if placed.end else {"pos": _text(placed.start)}
        kind = "capsule" if placed.end else "ellipsoid"
        ET.SubElement(element, "geom", {"name": placed.name + side, "type": kind, "size": _text(placed.size), **where})
    return element


def marker_csv(figures: dict[str, Any]) -> str:
    """The marker table `bml_movi_87` in the order of `bml_movi_87_order`, without a reason per line: the figures'."""
    lines = [
        "# bml_movi_87: the 87 points of the BML-MoVi marker set as MeTRAbs gives them",
        f"# source: {SOURCE}; metres, in the body's frame (x forward, y up, z right)",
        "name,body,x,y,z,comment",
    ]
    for name in figures["bml_movi_87_order"]:
        site = figures["sites"][name]
        lines.append(",".join([name, site["body"], *(f"{x:g}" for x in site["pos"]), ""]))
    return "\n".join(lines) + "\n"


def _text(values: list[float] | tuple[float, ...]) -> str:
    return " ".join(f"{x:g}" for x in values)


@click.command()
@click.argument("figures", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=PACKAGE / "body" / "data",
    show_default="the package's data folder",
    help="Folder the two files are written to.",
)
def build(figures: Path, out: Path) -> None:
    """Write pbl_body_40.xml and markers_bml_movi_87.csv from FIGURES (body_model_figures.json).

    Example: python -m research.body body_model_figures.json
    """
    data = json.loads(figures.read_text(encoding="utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    for name, text in (("pbl_body_40.xml", body_xml(data)), ("markers_bml_movi_87.csv", marker_csv(data))):
        (out / name).write_text(text, encoding="utf-8")
        click.echo(out / name)


if __name__ == "__main__":
    build()
