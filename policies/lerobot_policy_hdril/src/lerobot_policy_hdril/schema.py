"""Names that the policy shares with datasets: columns, files beside them, and how numbers of a pose are called."""

from __future__ import annotations

POSE_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Last parts of the names of a pose: position, m, and unit quaternion, xyzw."""
QUATERNION_AXES = POSE_AXES[3:]
PART_SUFFIXES = ("_ee", "_gripper")
"""Parts of a hand: ``left_ee.x`` and ``left_gripper.pos`` belong to the node ``left``."""

SUBTASK_KEY = "subtask_index"
"""Column that labels each frame with its primitive, unless ``policy.subtask_key`` names another."""
SUBTASK_START = "subtask_start"
"""Column that is true where a primitive starts. Without it, a primitive starts where the label changes."""
LANGUAGE, LANGUAGE_STYLE = "language_persistent", "subtask"
"""LeRobot's column of language, and the style of its rows that say which primitive begins when. It labels the frames of a
dataset that has no numbers."""
SUBTASKS_PATH = "meta/subtasks.parquet"
"""Names of the primitives, by label."""
RECIPE_PATH = "meta/hdril.json"
"""How hdril recorded the dataset: recipe and seeds. Other datasets have no such file."""
