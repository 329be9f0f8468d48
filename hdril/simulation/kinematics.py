"""Forward kinematics of a serial chain, read from a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose


@dataclass(frozen=True)
class Joint:
    """A revolute joint about its own z axis: limits in rad."""

    name: str
    offset: NDArray[np.float64]  # (4, 4) parent_T_joint at zero
    lower: float
    upper: float


class Chain:
    """Revolute joints from ``base`` to ``tool``.

    Poses are those of the tool's frame in the base link's frame.

    Raises:
        ValueError: the URDF has no such links, or a moving joint between them is not revolute about z.
    """

    def __init__(self, urdf: Path, base: str, tool: str) -> None:
        root = ElementTree.parse(urdf).getroot()
        parents = {attribute(joint, "child", "link"): joint for joint in root.findall("joint")}
        pending, joints, link = np.eye(4), [], tool
        while link != base:
            if link not in parents:
                raise ValueError(f"{urdf.name}: no chain from {base!r} to {tool!r}; it ends at {link!r}")
            joint = parents[link]
            link = attribute(joint, "parent", "link")
            if joint.get("type") == "fixed":
                pending = origin_transform(joint) @ pending
                continue
            axis = joint.find("axis")
            if joint.get("type") != "revolute" or axis is None or axis.get("xyz", "").split() != ["0", "0", "1"]:
                raise ValueError(f"{urdf.name}: joint {joint.get('name')!r} is not revolute about z")
            joints.append((joint, origin_transform(joint), pending))
            pending = np.eye(4)
        joints.reverse()
        self.joints: tuple[Joint, ...] = tuple(
            Joint(
                joint.get("name", ""),
                (pending if i == 0 else joints[i - 1][2]) @ offset,
                float(attribute(joint, "limit", "lower")),
                float(attribute(joint, "limit", "upper")),
            )
            for i, (joint, offset, _) in enumerate(joints)
        )
        self._tool = joints[-1][2]
        self.lower = np.array([joint.lower for joint in self.joints])
        self.upper = np.array([joint.upper for joint in self.joints])
        self._offsets = np.stack([joint.offset for joint in self.joints])

    def transform_and_jacobian(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Tool transform (4, 4) and its geometric Jacobian (6, n), linear rows first, in the base link's frame.

        Column i is [z_i x (p - p_i); z_i] for joint axis z_i through p_i.
        """
        cosines, sines = np.cos(q)[:, None], np.sin(q)[:, None]
        links = self._offsets.copy()  # parent_T_joint after the joint has turned: only the x and y columns change
        links[:, :, 0] = cosines * self._offsets[:, :, 0] + sines * self._offsets[:, :, 1]
        links[:, :, 1] = cosines * self._offsets[:, :, 1] - sines * self._offsets[:, :, 0]
        frames = np.empty_like(links)
        frames[0] = links[0]
        for i in range(1, len(links)):
            np.matmul(frames[i - 1], links[i], out=frames[i])
        transform = frames[-1] @ self._tool
        axes = frames[:, :3, 2]
        arms = transform[:3, 3] - frames[:, :3, 3]
        jacobian = np.empty((6, len(links)))
        jacobian[0] = axes[:, 1] * arms[:, 2] - axes[:, 2] * arms[:, 1]
        jacobian[1] = axes[:, 2] * arms[:, 0] - axes[:, 0] * arms[:, 2]
        jacobian[2] = axes[:, 0] * arms[:, 1] - axes[:, 1] * arms[:, 0]
        jacobian[3:] = axes.T
        return transform, jacobian

    def forward(self, q: NDArray[np.float64]) -> Pose:
        """Pose of the tool at joint positions ``q`` (n,), rad."""
        transform, _ = self.transform_and_jacobian(np.asarray(q, dtype=np.float64))
        return Pose(transform[:3, 3], Rotation.from_matrix(transform[:3, :3]).as_quat())


def attribute(element: ElementTree.Element, child: str, name: str) -> str:
    """An attribute of an element's child.

    Raises:
        ValueError: there is none.
    """
    found = element.find(child)
    value = None if found is None else found.get(name)
    if value is None:
        raise ValueError(f"the {element.tag} {element.get('name')!r} has no <{child} {name}=…>")
    return value


def origin_transform(element: ElementTree.Element) -> NDArray[np.float64]:
    """The <origin> of a joint, shape or inertial as a transform (4, 4); the identity if there is none."""
    transform, origin = np.eye(4), element.find("origin")
    if origin is not None:
        transform[:3, 3] = [float(v) for v in origin.get("xyz", "0 0 0").split()]
        # URDF: fixed-axis roll, pitch, yaw.
        transform[:3, :3] = Rotation.from_euler(
            "xyz", [float(v) for v in origin.get("rpy", "0 0 0").split()]
        ).as_matrix()
    return transform
