"""Rethink Robotics' Baxter with two electric grippers, from the ``example-robot-data`` package."""

from __future__ import annotations

import hashlib
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Iterable
from functools import cache
from importlib.metadata import files
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hdril.files import cache_folder, write_atomically
from hdril.geometry import Pose
from hdril.simulation.kinematics import attribute, origin_transform
from hdril.simulation.robots.spec import Actuation, ArmSpec, GripperSpec, RobotSpec

PACKAGE = "example-robot-data"

# Collision shapes that replace the two that are meshes: (size, centre), m, in the link's frame. The torso's box ends
# below the shoulders, which reach into the mesh.
COLLISION_BOXES = {
    "torso": ((0.22, 0.30, 0.62), (-0.03, 0.0, 0.31)),
    "pedestal": ((0.30, 0.30, 0.68), (-0.10, 0.0, -0.56)),
}
# Frames of sensors and bounding spheres: leaves of 0.1 g behind fixed joints. Without them there is less to step.
# The spheres, 0.22 m around the head for planners that want a wide berth, would also stop the elbows.
LEFT_OUT = (
    "collision_head_link_1", "collision_head_link_2", "left_torso_itb", "right_torso_itb", "sonar_ring", "dummyhead1",
    "head_camera_link", "display",
    *(f"{side}_{part}" for side in ("left", "right") for part in (
        "arm_itb", "hand_camera_link", "hand_camera_axis_link", "hand_range_link", "hand_accelerometer_link")),
)  # fmt: skip

# Hands over the middle of the work area, pitched 45 degrees down. Of 160 random candidates that put them there, the one
# whose joints stay closest to their speed limits over a grid of table lift's start area.
LEFT_POSTURE = (0.278, -0.015, -0.339, 1.959, 0.496, -0.814, 0.700)
MIRROR = (-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
ARM_JOINTS = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
FINGER_STROKE = 0.020833


@cache
def source_urdf() -> Path:
    """The URDF as the package ships it.

    Raises:
        FileNotFoundError: the package is not installed.
    """
    for file in files(PACKAGE) or []:
        if file.name == "baxter.urdf":
            return Path(str(file.locate())).resolve()
    raise FileNotFoundError(f"the package {PACKAGE!r} holds no baxter.urdf; reinstall hdril's requirements")


def mesh_path(uri: str) -> str:
    """A file for a ``package://`` address of the URDF."""
    robots = source_urdf().parents[2]
    return str(robots / uri.split("/robots/", 1)[1])


def _shape(tag: str, attributes: dict[str, str]) -> ElementTree.Element:
    geometry = ElementTree.Element("geometry")
    ElementTree.SubElement(geometry, tag, attributes)
    return geometry


def _prepare(link: ElementTree.Element, meshes: bool) -> None:
    name = link.get("name", "")
    if name == "base":  # the fixed root; without inertia PyBullet prints a warning at every start
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "mass", {"value": "1"})
        ElementTree.SubElement(
            inertial, "inertia", {"ixx": "1", "ixy": "0", "ixz": "0", "iyy": "1", "iyz": "0", "izz": "1"}
        )
    collisions = link.findall("collision")
    if name in COLLISION_BOXES:
        size, centre = COLLISION_BOXES[name]
        for shape in collisions:
            link.remove(shape)
        box = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(box, "origin", {"xyz": " ".join(map(str, centre)), "rpy": "0 0 0"})
        box.append(_shape("box", {"size": " ".join(map(str, size))}))
    if meshes:
        for mesh in link.iter("mesh"):
            mesh.set("filename", mesh_path(mesh.get("filename", "")))
        return
    # Drawing the meshes takes ten times as long as the simple shapes that collide: show those.
    for shape in link.findall("visual"):
        link.remove(shape)
    # One material a colour: PyBullet gives all links the colour that a name had first.
    material, colour = ("finger", "0.2 0.2 0.2 1") if "finger" in name else ("arm", "0.55 0.13 0.13 1")
    for shape in link.findall("collision"):
        visual = ElementTree.SubElement(link, "visual")
        visual.extend(part for part in shape if part.tag in ("origin", "geometry"))
        element = ElementTree.SubElement(visual, "material", {"name": material})
        ElementTree.SubElement(element, "color", {"rgba": colour})


def _put(element: ElementTree.Element, transform: NDArray[np.float64]) -> None:
    """Give a joint or a shape a new <origin>: the old one may be shared by a shape that is seen and one that collides."""
    for former in element.findall("origin"):
        element.remove(former)
    with warnings.catch_warnings():  # at a pitch of 90 degrees several angles say the same
        warnings.filterwarnings("ignore", "Gimbal lock detected")
        turn = Rotation.from_matrix(transform[:3, :3]).as_euler("xyz")
    ElementTree.SubElement(element, "origin", {"xyz": _text(transform[:3, 3]), "rpy": _text(turn)})


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


_INERTIA = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))


def _inertial(link: ElementTree.Element) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Mass, kg, centre of mass (3,), m, and inertia about the link's origin (3, 3), kg m², all in the link's frame."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    mass, transform, about_centre = (
        float(attribute(inertial, "mass", "value")),
        origin_transform(inertial),
        np.empty((3, 3)),
    )
    for name, row, column in _INERTIA:
        about_centre[row, column] = about_centre[column, row] = float(attribute(inertial, "inertia", name))
    turn, centre = transform[:3, :3], transform[:3, 3]
    return mass, centre, turn @ about_centre @ turn.T + mass * _point_inertia(centre)


def _point_inertia(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3), m²: inertia of a unit mass at ``place`` about the origin."""
    return place @ place * np.eye(3) - np.outer(place, place)


def _merge(parent: ElementTree.Element, child: ElementTree.Element, transform: NDArray[np.float64]) -> None:
    """Make ``child``, which stands at ``transform`` (4, 4) in the frame of ``parent``, a part of it."""
    for shape in [*child.findall("visual"), *child.findall("collision")]:
        _put(shape, transform @ origin_transform(shape))
        parent.append(shape)
    mass, centre, inertia = _inertial(parent)
    added, place, about_origin = _inertial(child)
    turn, moved = transform[:3, :3], transform[:3, :3] @ place + transform[:3, 3]
    total = mass + added
    middle = (mass * centre + added * moved) / total
    inertia = inertia + turn @ (about_origin - added * _point_inertia(place)) @ turn.T + added * _point_inertia(moved)
    inertia = inertia - total * _point_inertia(middle)
    for former in parent.findall("inertial"):
        parent.remove(former)
    inertial = ElementTree.SubElement(parent, "inertial")
    ElementTree.SubElement(inertial, "origin", {"xyz": _text(middle), "rpy": "0 0 0"})
    ElementTree.SubElement(inertial, "mass", {"value": repr(total)})
    ElementTree.SubElement(
        inertial, "inertia", {name: repr(float(inertia[row, column])) for name, row, column in _INERTIA}
    )


def _merge_fixed(root: ElementTree.Element, kept: Container[str]) -> None:
    """Make every link that is fixed to another one a part of it, but for those in ``kept``."""
    links = {link.get("name", ""): link for link in root.findall("link")}
    for joint in root.findall("joint"):
        name = attribute(joint, "child", "link")
        if joint.get("type") != "fixed" or name in kept:
            continue
        parent, transform = attribute(joint, "parent", "link"), origin_transform(joint)
        _merge(links[parent], links[name], transform)
        for other in root.findall("joint"):
            if attribute(other, "parent", "link") == name:
                _put(other, transform @ origin_transform(other))
                for told in other.findall("parent"):
                    told.set("link", parent)
        root.remove(joint)
        root.remove(links[name])


def _write_once(text: str, stem: str) -> Path:
    """A cached file with this content."""
    path = cache_folder() / f"{stem}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.urdf"
    if not path.exists():
        write_atomically(path, lambda file: file.write(text.encode()))
    return path


@cache
def simulation_urdf(meshes: bool) -> Path:
    """The model that is simulated: the original with its two collision meshes as boxes, less :data:`LEFT_OUT`.

    Links that are fixed to another one are a part of it, but for the tools and the pads: a link takes as long to step whether it
    can move or not, and the equations of motion are the same. Kinematics and limits are untouched; masses and inertias are the
    sums of the parts'. ``meshes`` keeps the visual meshes (1 s more to load).
    """
    tree = ElementTree.parse(source_urdf())
    root = tree.getroot()
    for joint in root.findall("joint"):
        if attribute(joint, "child", "link") in LEFT_OUT:
            root.remove(joint)
    for link in root.findall("link"):
        if link.get("name") in LEFT_OUT:
            root.remove(link)
        else:
            _prepare(link, meshes)
    _merge_fixed(root, kept={link for arm in BAXTER.arms.values() for link in (arm.tool, *arm.gripper.pads)})
    return _write_once(ElementTree.tostring(root, encoding="unicode"), f"baxter-{'mesh' if meshes else 'simple'}")


def _arm(side: str, posture: tuple[float, ...]) -> ArmSpec:
    fingers = tuple(f"{side[0]}_gripper_{finger}_finger" for finger in "lr")
    return ArmSpec(
        joints=tuple(f"{side}_{joint}" for joint in ARM_JOINTS),
        tool=f"{side}_gripper",
        gripper=GripperSpec(
            joints=tuple(f"{finger}_joint" for finger in fingers),
            closed=(0.0, 0.0),
            opened=(FINGER_STROKE, -FINGER_STROKE),
            pads=tuple(f"{finger}_tip" for finger in fingers),
        ),
        posture=posture,
    )


def _efforts() -> dict[str, float]:
    # The URDF gives 50 Nm to s0, s1, e0, e1. The real s1 is helped by springs that the URDF leaves out: at reach with
    # half of a 2 kg table it needs 64 Nm, so s1 alone gets 100. The URDF gives 20 N to a finger; at 10 N the table
    # slips out of the hands: 40.
    arm = dict(zip(ARM_JOINTS, (50.0, 100.0, 50.0, 50.0, 15.0, 15.0, 15.0), strict=True))
    return {f"{side}_{joint}": effort for side in ("left", "right") for joint, effort in arm.items()} | {
        f"{side}_gripper_{finger}_finger_joint": 40.0 for side in "lr" for finger in "lr"
    }


def _side(link: str) -> str | None:
    if link.startswith(("left_", "l_gripper")) and "torso" not in link:
        return "left"
    if link.startswith(("right_", "r_gripper")) and "torso" not in link:
        return "right"
    return None


def _ignored(links: tuple[str, ...]) -> list[tuple[str, str]]:
    """All pairs but: arm against arm, and an arm from the elbow on against the base, of which torso and pedestal are parts."""
    shoulder = ("shoulder", "upper_elbow")
    body = {"base"}

    def collides(a: str, b: str) -> bool:
        if _side(a) and _side(b):
            return _side(a) != _side(b)
        arm, other = (a, b) if _side(a) else (b, a)
        return other in body and _side(arm) is not None and not any(part in arm for part in shoulder)

    return [pair for pair in combinations(links, 2) if not collides(*pair)]


BAXTER = RobotSpec(
    name="baxter",
    urdf=simulation_urdf,
    source=source_urdf,
    # The pedestal stands on the floor, 0.93 m below the torso's frame; the bench top, z = 0, is 0.23 m above the floor.
    base=Pose((0.0, 0.0, 0.70)),
    arms={
        "left": _arm("left", LEFT_POSTURE),
        "right": _arm("right", tuple(m * q for m, q in zip(MIRROR, LEFT_POSTURE, strict=True))),
    },
    actuation=Actuation(
        efforts=_efforts(),
        # Mean distance from the centre of a 42 x 37 mm pad under even pressure. Without it a table carried forward
        # swings up to 13 degrees about the line through the pads.
        pad_torsion=0.015,
        velocities={f"{side}_{joint}": speed for side in ("left", "right")
                    for joint, speed in zip(ARM_JOINTS, (1.5, 1.5, 1.5, 1.5, 4.0, 4.0, 4.0), strict=True)},
    ),
    ignored_collisions=_ignored,
)  # fmt: skip
