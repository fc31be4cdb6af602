"""`.osim` and `.trc`: the fitted body as an OpenSim model, from the MJCF, the fit's scale and its markers; the markers.

A chain of MuJoCo's joints becomes one `CustomJoint`: the joints of a body act one after the other, each in the frame of
those before it, as do the three rotations of OpenSim's `SpatialTransform`; its translations are along the axes of the
parent's frame, like slides that act before all hinges. So every body with up to three hinges, and up to three slides
before them, is one CustomJoint with the MJCF's axes and order. A body with fewer hinges gets further axes at right
angles that do not turn. All joints of our body are of this kind, and none are coupled.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.sax.saxutils import escape, quoteattr

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import SLIDES, Y_UP_TO_Z_UP, Body, load_body
from pbl_pipeline.kinetics import Inertia, segment_inertia
from pbl_pipeline.sampling import interval_of

from .columns import lines, number_cells
from .trial import ExportTrial, site_positions, wanted_markers


def write_trc(trial: ExportTrial, path: Path, title: str) -> None:
    """Write the fitted markers in mm, in OpenSim's ground: x as ours, y up, z = -y of our world.

    Frames without a known marker are omitted, because OpenSim's inverse kinematics stops at them; a single unknown
    marker is an empty cell. `Time` has the video's stamps, `DataRate` their rate.
    """
    fit = trial.fit
    seen = np.isfinite(fit.markers_world_m).any(axis=(1, 2))
    time = np.asarray(fit.time_s, float)[seen]
    xyz = 1e3 * np.asarray(fit.markers_world_m, float)[seen] @ Y_UP_TO_Z_UP
    n, j = xyz.shape[:2]
    rate = f"{1.0 / interval_of(time) if n > 1 else 0.0:.6g}"
    numbers = range(1, j + 1)
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{title}.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{j}\tmm\t{rate}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(fit.marker_names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in numbers),
        "",
    ]
    # OpenSim ignores an empty cell at the end of a line, without a further tab.
    kept = np.where(np.isnan(xyz[:, -1, 0]), ord("\t"), 0).astype(np.uint8)[:, None]
    cells = number_cells(xyz.reshape(n, -1), 4)
    last = np.concatenate([cells[:, -1], kept], axis=1)
    blocks = [number_cells(np.arange(1, n + 1), 0), number_cells(time, 6), cells[:, :-1], last]
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + lines(blocks, "\t"))


#: OpenSim's names for the joints of the published model: child body -> joint.
_JOINTS = {
    "pelvis": "ground_pelvis",
    "femur": "hip",
    "tibia": "knee",
    "talus": "ankle",
    "calcn": "subtalar",
    "toes": "mtp",
    "torso": "back",
    "head": "neck",
    "humerus": "acromial",
    "ulna": "elbow",
    "radius": "radioulnar",
    "hand": "radius_hand",
}
#: Range of a coordinate that the MJCF does not limit: rad, m.
_FREE_RAD, _FREE_M = 2 * np.pi, 100.0


def write_osim(trial: ExportTrial, path: Path, origin: Mapping[str, str], title: str) -> None:
    """Write the scaled body with the fitted markers as an OpenSim 4 model.

    Lengths are scaled as in the fit. If the person's mass is known, masses, centres and inertias are those of the
    forces (`kinetics.Inertia`). Otherwise masses are the unscaled body's, centres scale with lengths, inertias with
    their square.

    Raises
    ------
    PblError
        MARKER_SET_UNKNOWN: the body lacks the fit's markers.
    ValueError
        The body has a chain of joints that cannot be one CustomJoint.
    """
    body, fit = load_body(), trial.fit
    markers = wanted_markers(trial)
    own = np.asarray(fit.scale, float)[body.scale_index]
    known = None if trial.mass_kg is None else (trial.mass_kg, segment_inertia(body, np.asarray(fit.scale, float)))
    bodies = (_body(body, i, own[i], known) for i in range(len(body.body_names)))
    root = ET.Element("OpenSimDocument", Version="40000")
    model = ET.SubElement(root, "Model", name=title)
    published = "Hamner, Seth & Delp 2010, J Biomech 43:2709 (figures of the unscaled body)"
    _texts(model, credits="; ".join(f"{k}: {v}" for k, v in origin.items()), publications=published)
    _texts(model, length_units="meters", force_units="N", gravity="0 -9.80665 0")
    _objects(model, "BodySet", "bodyset", bodies)
    _objects(model, "JointSet", "jointset", (_joint(body, i, own) for i in range(len(body.body_names))))
    places = site_positions(markers, fit, body.scale_index)
    _objects(model, "MarkerSet", "markerset", map(_marker, markers.names, markers.body_names, places))
    path.write_text("\n".join(['<?xml version="1.0" encoding="UTF-8" ?>', *_lines(root), ""]), encoding="utf-8")


@functools.cache
def pelvis_rest_m(body: Body) -> dict[str, float]:
    """Position of the root along each slide at `qpos = 0`, in OpenSim's ground: its coordinates minus qpos.

    Raises `ValueError` for a root that is rotated in OpenSim's ground, or slides that are not along its axes.
    """
    model = body.mj_model
    turned = Y_UP_TO_Z_UP.T @ Rotation.from_quat(model.body_quat[1], scalar_first=True).as_matrix()
    rest = Y_UP_TO_Z_UP.T @ model.body_pos[1]
    axes = {n: np.asarray(model.jnt_axis[body.joint_names.index(n)]) for n in SLIDES}
    if not np.allclose(turned, np.eye(3), atol=1e-9) or not np.allclose(list(axes.values()), np.eye(3), atol=1e-9):
        raise ValueError("the root of the body is turned against OpenSim's ground")
    return {n: float(axis @ rest) for n, axis in axes.items()}


def _body(body: Body, index: int, scale: float, known: tuple[float, Inertia] | None) -> ET.Element:
    model, number = body.mj_model, index + 1
    element = ET.Element("Body", name=body.body_names[index])
    shapes = [_shape(model, g, scale, _turns(body)[g]) for g in range(model.ngeom) if model.geom_bodyid[g] == number]
    components = ET.SubElement(element, "components")
    components.extend(shapes)
    mass, centre, inertia = model.body_mass[number], scale * model.body_ipos[number], scale**2 * _inertias(body)[index]
    if known is not None:
        kg, own = known
        mass, centre, inertia = kg * own.mass[index], own.centre_m[index], kg * np.diag(own.moment_m2[index])
    moments = _vector([*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])
    _texts(element, mass=_number(mass), mass_center=_vector(centre), inertia=moments)
    return element


@functools.cache
def _inertias(body: Body) -> np.ndarray:
    """(B, 3, 3) of the unscaled bodies about their centres of mass, in their frames."""
    turn = Rotation.from_quat(body.mj_model.body_iquat[1:], scalar_first=True).as_matrix()
    return np.einsum("bij,bj,bkj->bik", turn, body.mj_model.body_inertia[1:], turn)


@functools.cache
def _turns(body: Body) -> np.ndarray:
    """(G, 3) body-fixed XYZ angles of the shapes."""
    return Rotation.from_quat(body.mj_model.geom_quat, scalar_first=True).as_euler("XYZ")


def _shape(model: mujoco.MjModel, geom: int, scale: float, turn: np.ndarray) -> ET.Element:
    """Shape for display: capsules, which OpenSim lacks, as ellipsoids of the same length and width."""
    name, size = model.geom(geom).name, np.array(model.geom_size[geom])
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        size = np.array([size[0], size[0], size[1] + size[0]])
    frame = ET.Element("PhysicalOffsetFrame", name=f"{name}_frame")
    shape = ET.SubElement(ET.SubElement(frame, "attached_geometry"), "Ellipsoid", name=f"{name}_shape")
    _texts(shape, socket_frame="..")
    _texts(ET.SubElement(shape, "Appearance"), color="0.55 0.68 0.85")
    _texts(shape, radii=_vector(scale * size))
    _texts(frame, socket_parent="..", translation=_vector(scale * model.geom_pos[geom]), orientation=_vector(turn))
    return frame


def _joint(body: Body, index: int, own_scale: np.ndarray) -> ET.Element:
    model, parent, child = body.mj_model, int(body.parent_index[index]), body.body_names[index]
    coordinates, transform = _movement(body, index)
    base, *side = child.rsplit("_", 1)
    element = ET.Element("CustomJoint", name="_".join([_JOINTS.get(base, f"{base}_joint"), *side]))
    offset = f"{body.body_names[parent] if parent >= 0 else 'ground'}_offset"
    _texts(element, socket_parent_frame=offset, socket_child_frame=f"/bodyset/{child}")
    element.append(coordinates)
    frame = ET.SubElement(ET.SubElement(element, "frames"), "PhysicalOffsetFrame", name=offset)
    place, turn = np.zeros(3), np.zeros(3)
    if parent >= 0:  # the position of the root at qpos 0 is part of its coordinates
        place = own_scale[parent] * model.body_pos[index + 1]
        turn = Rotation.from_quat(model.body_quat[index + 1], scalar_first=True).as_euler("XYZ")
    socket = f"/bodyset/{body.body_names[parent]}" if parent >= 0 else "/ground"
    _texts(frame, socket_parent=socket, translation=_vector(place), orientation=_vector(turn))
    element.append(transform)
    return element


@functools.cache
def _movement(body: Body, index: int) -> tuple[ET.Element, ET.Element]:
    """Coordinates and transform of a body's joint, which do not depend on the scale.

    Raises `ValueError` for joints that cannot be one CustomJoint.
    """
    model = body.mj_model
    joints = np.flatnonzero(body.joint_body == index)
    hinges, slides = joints[body.is_hinge[joints]], joints[body.is_slide[joints]]
    expressible = len(hinges) <= 3 and len(hinges) + len(slides) == len(joints) and not np.any(model.jnt_pos[joints])
    if not expressible or (len(slides) and len(hinges) and slides.max() > hinges.min()):
        raise ValueError(f"the joints of {body.body_names[index]} are not those of one CustomJoint")
    coordinates = ET.Element("coordinates")
    # OpenSim numbers the coordinates of a joint in the order of its transform: rotations first.
    for joint in (*hinges, *sorted(slides, key=lambda j: body.joint_names[j])):
        coordinates.append(_coordinate(body, int(joint)))
    transform = ET.Element("SpatialTransform")
    for k, (axis, joint) in enumerate(_rotations(model.jnt_axis[hinges], hinges), 1):
        _axis(transform, f"rotation{k}", axis, None if joint is None else body.joint_names[joint])
    moved = {int(np.argmax(model.jnt_axis[j])): body.joint_names[j] for j in slides}
    for k, axis in enumerate(np.eye(3)):
        _axis(transform, f"translation{k + 1}", axis, moved.get(k))
    return coordinates, transform


def _rotations(axes: np.ndarray, hinges: np.ndarray) -> list[tuple[np.ndarray, int | None]]:
    """Three axes with their joints: those of the hinges, then axes at right angles to them that do not turn."""
    found: list[tuple[np.ndarray, int | None]] = [(a, int(j)) for a, j in zip(axes, hinges, strict=True)]
    # The remaining rows of V span the complement of the axes.
    _, _, rest = np.linalg.svd(np.reshape(axes, (-1, 3)))
    return [*found, *((axis, None) for axis in rest[len(found) :])]


def _coordinate(body: Body, joint: int) -> ET.Element:
    low, high = body.joint_range_rad[joint]
    if not np.isfinite([low, high]).all():
        high = _FREE_RAD if body.is_hinge[joint] else _FREE_M
        low = -high
    element = ET.Element("Coordinate", name=body.joint_names[joint])
    rest = pelvis_rest_m(body).get(body.joint_names[joint], 0.0)
    _texts(element, default_value=_number(rest), default_speed_value="0", range=_vector([low, high]))
    _texts(element, clamped="false", locked="false")
    return element


def _axis(transform: ET.Element, name: str, axis: np.ndarray, coordinate: str | None) -> None:
    element = ET.SubElement(transform, "TransformAxis", name=name)
    _texts(element, coordinates=coordinate or "", axis=_vector(axis))
    if coordinate is None:
        _texts(ET.SubElement(element, "Constant", name="function"), value="0")
    else:
        _texts(ET.SubElement(element, "LinearFunction", name="function"), coefficients="1 0")


def _marker(name: str, body_name: str, place_m: np.ndarray) -> ET.Element:
    element = ET.Element("Marker", name=name)
    _texts(element, socket_parent_frame=f"/bodyset/{body_name}", location=_vector(place_m), fixed="true")
    return element


def _lines(element: ET.Element, indent: str = "", out: list[str] | None = None) -> list[str]:
    """Indented lines of XML; an element with children has no text. Takes a third of the time of ElementTree."""
    out = [] if out is None else out
    start = f"{indent}<{element.tag}"
    for name, value in element.items():
        start += f" {name}={quoteattr(value)}"
    if len(element):
        out.append(start + ">")
        for child in element:
            _lines(child, indent + "\t", out)
        out.append(f"{indent}</{element.tag}>")
    else:
        out.append(f"{start}>{escape(element.text)}</{element.tag}>" if element.text else start + " />")
    return out


def _objects(model: ET.Element, kind: str, name: str, members: Iterable[ET.Element]) -> None:
    ET.SubElement(ET.SubElement(model, kind, name=name), "objects").extend(members)


def _texts(parent: ET.Element, **texts: str) -> None:
    for name, text in texts.items():
        ET.SubElement(parent, name).text = text


def _vector(values: Iterable[float]) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return f"{value + 0.0:.12g}"
