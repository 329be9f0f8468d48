"""The scene graph: which numbers of the state belong to which node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_policy_hdril.schema import PART_SUFFIXES, POSE_AXES, QUATERNION_AXES


def feature_names(key: str, feature: Mapping[str, Any]) -> list[str]:
    """One name per number of a feature. A dataset may list them, group them in a dict, or not name them at all."""
    names = feature.get("names")
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in group]
    shape = tuple(feature["shape"])
    if names and len(names) == shape[0]:
        return [str(name) for name in names]
    return [f"{key.rsplit('.', 1)[-1]}.{i}" for i in range(shape[0])]


def node_of(name: str) -> str:
    """The node that a number belongs to: ``left_ee.x`` and ``left_gripper.pos`` to ``left``, ``table.qw`` to ``table``."""
    node = name.split(".", 1)[0]
    for suffix in PART_SUFFIXES:
        node = node.removesuffix(suffix)
    return node


def group_nodes(names: list[str]) -> dict[str, list[int]]:
    """Nodes in the order of their first number, each with the indices of its numbers."""
    nodes: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        nodes.setdefault(node_of(name), []).append(index)
    return nodes


def quaternion_groups(names: list[str]) -> list[list[int]]:
    """Indices (qx, qy, qz, qw) of every quaternion among the names."""
    return _groups(names, QUATERNION_AXES)


def pose_columns(names: list[str], indices: list[int]) -> list[int] | None:
    """Where in a node's numbers its pose (x, y, z, qx, qy, qz, qw) is; None if it has none."""
    axes = {names[index].rsplit(".", 1)[-1]: column for column, index in reversed(list(enumerate(indices)))}
    return [axes[axis] for axis in POSE_AXES] if all(axis in axes for axis in POSE_AXES) else None


def pose_groups(names: list[str]) -> list[list[int]]:
    """Indices (x, y, z, qx, qy, qz, qw) of every pose among the names."""
    return _groups(names, POSE_AXES)


def _groups(names: list[str], axes: tuple[str, ...]) -> list[list[int]]:
    position = {name: index for index, name in enumerate(names)}
    prefixes = dict.fromkeys(name.rsplit(".", 1)[0] for name in names if "." in name)
    groups = [[position.get(f"{prefix}.{axis}") for axis in axes] for prefix in prefixes]
    return [[i for i in group if i is not None] for group in groups if None not in group]
