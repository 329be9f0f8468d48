"""gym-aloha's simulation of two arms, driven by the poses of their hands. The only module that imports gym-aloha."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.aloha.tasks import AlohaTask
from hdril.errors import UserError
from hdril.geometry import IDENTITY_QUATERNION, POSE_AXES, Pose
from hdril.simulation.actions import HandCommand, join_action
from hdril.simulation.robots.spec import SIDES

RATE = 50
"""Control steps in a second, gym-aloha's."""
GRIPPER_JOINTS = (6, 14)
"""Where the left finger of each hand stands in ``qpos``."""
ARMS = 16
"""Joints of both arms in ``qpos``; the free joints of the objects come after them."""
PICTURE = {"height": 240, "width": 320, "camera_id": "angle"}


class MissingExtraError(UserError):
    """gym-aloha is not installed."""


def require_extra() -> None:
    """Raises :class:`MissingExtraError` unless gym-aloha is installed; names the command that installs it."""
    if find_spec("gym_aloha") is None:
        raise MissingExtraError("this needs gym-aloha, the extra aloha of hdril: pip install -e '.[aloha]'")


def _wxyz(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """MuJoCo's order."""
    return np.roll(quaternion, 1)


def _pose(position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> Pose:
    """A pose of MuJoCo's, with one of the two signs of its quaternion in all frames."""
    return Pose(position, np.roll(wxyz, -1)).aligned_to(IDENTITY_QUATERNION)


class AlohaPhysics:
    """One task of gym-aloha with its end-effector control: a weld pulls each gripper to a pose, and motors move its fingers.

    Model, control, start of the arms, places of the objects and reward are gym-aloha's (``gym_aloha.tasks.sim_end_effector``,
    ``gym_aloha.utils``). Its ``dm_control`` environment is left out, because that draws three pictures at each step.
    Poses are in the world's frame, m: x from the left arm to the right one, z up, the table at z = 0.

    Raises:
        MissingExtraError: gym-aloha is not installed.
    """

    def __init__(self, task: AlohaTask) -> None:
        require_extra()
        from dm_control import mujoco  # pyright: ignore[reportMissingImports]
        from gym_aloha import constants  # pyright: ignore[reportMissingImports]
        from gym_aloha.tasks import sim_end_effector  # pyright: ignore[reportMissingImports]

        self.task = task
        self._normalize = constants.normalize_puppet_gripper_position
        self._rules: Any = getattr(sim_end_effector, task.rules)()
        self._physics: Any = mujoco.Physics.from_xml_path(str(constants.ASSETS_DIR / task.model))
        self._substeps = round(1 / RATE / self._physics.timestep())
        self._restore_welds()
        # The weld of a hand holds the gripper in this pose to the commanded one: MuJoCo's eq_data has it after an anchor.
        welds = self._physics.model.eq_data[: len(SIDES), 3:10]
        self._grips = {side: Pose(weld[:3], np.roll(weld[3:], -1)) for side, weld in zip(SIDES, welds, strict=True)}

    def _restore_welds(self) -> None:
        """Let the welds turn the grippers as firmly as in MuJoCo 2, for which model and scripts were made.

        MuJoCo 2 gave the three rotational rows of a weld the inverse inertia that belongs to translation; 3.0 corrected that
        (github.com/google-deepmind/mujoco/issues/1483). Since then the grippers lag behind in rotation, and the scripted experts
        miss: they succeed in 0 of 8 scenes, and with MuJoCo 2.3.7 in 20 of 20. Contacts of the fingers, which are bodies of
        their own, do not read this number.
        """
        model = self._physics.model
        for side in SIDES:
            inverse_inertia = model.body_invweight0[model.name2id(f"vx300s_{side}/gripper_link", "body")]
            inverse_inertia[1] = inverse_inertia[0]

    def reset(self, seed: int) -> dict[str, HandCommand]:
        """Start the scene of a seed, the one that gym-aloha's own environment starts; returns the hands' first commands."""
        with self._physics.reset_context():
            self._rules.initialize_episode(self._physics)
            # It puts the objects anywhere, without a seed: gym-aloha's own environment does so for joint control alone.
            self._physics.data.qpos[ARMS:] = _places(self.task, seed)
        poses = zip(self._physics.data.mocap_pos, self._physics.data.mocap_quat, strict=True)
        return {side: HandCommand(_pose(*pose), 0.0) for side, pose in zip(SIDES, poses, strict=True)}

    def step(self, commands: dict[str, HandCommand]) -> int:
        """One control step of 0.02 s towards the commands, by side; returns gym-aloha's reward, 0 to 4."""
        action = [
            (command.pose.position, _wxyz(command.pose.quaternion), [command.opening])
            for command in (commands[side] for side in SIDES)
        ]
        self._rules.before_step(np.concatenate([part for hand in action for part in hand]), self._physics)
        self._physics.step(self._substeps)
        return int(self._rules.get_reward(self._physics))

    def hands(self) -> NDArray[np.float64]:
        """(16,): measured poses of the hands, in the frames that are commanded, and their openings.

        In the order of :data:`~hdril.simulation.actions.ACTION_NAMES`.
        """
        return join_action({side: self._hand(side, joint) for side, joint in zip(SIDES, GRIPPER_JOINTS, strict=True)})

    def _hand(self, side: str, joint: int) -> HandCommand:
        data, gripper = self._physics.named.data, f"vx300s_{side}/gripper_link"
        pose = _pose(data.xpos[gripper], data.xquat[gripper]) @ self._grips[side].inverse()
        opening = self._normalize(self._physics.data.qpos[joint])
        return HandCommand(pose.aligned_to(IDENTITY_QUATERNION), float(opening))

    def objects(self) -> NDArray[np.float64]:
        """(7 per object,): poses of the task's objects, in its order."""
        rows = self._physics.data.qpos[ARMS:].reshape(-1, len(POSE_AXES))
        return np.concatenate([_pose(row[:3], row[3:]).as_vector() for row in rows])

    def render(self) -> NDArray[np.uint8]:
        """(240, 320, 3) RGB from in front of the table; black where ``MUJOCO_GL=disable`` says that nothing can be drawn.

        Raises:
            UserError: MuJoCo finds nothing to draw with; says what to set.
        """
        if os.environ.get("MUJOCO_GL", "").lower() in ("disable", "disabled", "off", "false", "0"):
            return np.zeros((PICTURE["height"], PICTURE["width"], 3), np.uint8)
        try:
            return self._physics.render(**PICTURE)
        except Exception as error:  # whatever the driver raises
            raise UserError(
                "MuJoCo cannot draw here: set MUJOCO_GL=egl or osmesa, or MUJOCO_GL=disable for black videos"
            ) from error


def _places(task: AlohaTask, seed: int) -> NDArray[np.float64]:
    """(7 per object,): where gym-aloha puts the objects for a seed, in MuJoCo's order of numbers."""
    from gym_aloha import utils  # pyright: ignore[reportMissingImports]

    return np.ravel(getattr(utils, task.places)(seed))
