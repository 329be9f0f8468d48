"""A bimanual task as a Gymnasium environment."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hdril.geometry import IDENTITY_QUATERNION
from hdril.simulation.actions import ACTION_NAMES, split_action
from hdril.simulation.controller import EndEffectorController
from hdril.simulation.robots import ROBOTS
from hdril.simulation.world import ROBOT, Physics, World
from hdril.tasks import get_task
from hdril.tasks.conditions import failed

SETTLE_PERIODS = 2


class BimanualEnv(gym.Env):
    """A world, a task and a controller of the hands: 10 actions a second.

    Observation: ``agent_pos`` (16,), measured hand poses and openings; ``environment_state`` (7 per observed object).
    Action (16,): hand poses and openings to reach, in the same order (:data:`~hdril.simulation.actions.ACTION_NAMES`);
    quaternions are normalised, openings clipped to [0, 1].

    Success is judged at every frame from the task's horizon on. The first success ends the episode with a reward of 1. An
    episode without one is cut after ``max_episode_steps`` frames, which are the horizon unless more are given.

    Raises:
        ValueError: unknown task, robot or render mode, or ``max_episode_steps`` below the horizon.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}  # pyright: ignore

    def __init__(
        self,
        task: str = "table_lift",
        robot: str = "baxter",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        meshes: bool = False,
        physics: Physics | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render mode {render_mode!r}; choose from: rgb_array")
        self.task_spec, self.robot_spec = get_task(task), ROBOTS.find(robot)
        self.task, self.task_description = self.task_spec.name, self.task_spec.description
        self.render_mode = render_mode
        self._max_episode_steps = self.task_spec.episode_limit(max_episode_steps, "max_episode_steps")
        self._physics, self._meshes = physics or self.task_spec.physics, meshes
        self._world: World | None = None
        self.controller = EndEffectorController(self.robot_spec)
        high = np.full(7 * len(self.task_spec.observed), np.inf, np.float32)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-np.inf, np.inf, (len(ACTION_NAMES),), np.float32),
                "environment_state": spaces.Box(-high, high, dtype=np.float32),
            }
        )
        lows = [{"x": -2, "y": -2, "z": -2, "pos": 0}.get(name.split(".")[1], -1) for name in ACTION_NAMES]
        highs = [{"x": 2, "y": 2, "z": 2}.get(name.split(".")[1], 1) for name in ACTION_NAMES]
        self.action_space = spaces.Box(np.array(lows, np.float32), np.array(highs, np.float32))
        self.frame = 0

    @property
    def world(self) -> World:
        """The world of the running episode.

        Raises:
            RuntimeError: there was no :meth:`reset`, or the environment is closed.
        """
        if self._world is None:
            raise RuntimeError("no episode is running: reset() the environment first")
        return self._world

    def _new_world(self) -> World:
        """The robot, and every body where the episode's random numbers put it."""
        robot, task, world = self.robot_spec, self.task_spec, World(self._physics)
        world.add_urdf(ROBOT, robot.urdf(self._meshes), robot.base, self_collision=True)
        world.ignore_collisions(ROBOT, robot.ignored_collisions(world.links(ROBOT)))
        pads = [pad for arm in robot.arms.values() for pad in arm.gripper.pads]
        world.set_link_dynamics(
            ROBOT,
            pads,
            lateralFriction=robot.actuation.pad_friction,
            spinningFriction=robot.actuation.pad_torsion,
            frictionAnchor=1,
        )
        for arm in robot.arms.values():
            # One motor drives both fingers (the URDF's mimic tag, which PyBullet ignores). Fingers driven apart push
            # against each other with equal forces, and what they hold floats between them.
            world.couple_joints(ROBOT, *arm.gripper.joints, max_force=robot.actuation.finger_gear_force)
        world.set_joint_velocity_limits(ROBOT, robot.actuation.velocities)
        for body in task.bodies:
            world.add_body(body, task.placements[body.name].sample(self.np_random))
        return world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Put the objects where the seed says, the arms in their posture, and let everything come to rest."""
        super().reset(seed=seed)
        self.close()
        self._world = self._new_world()
        self.controller.start(self._world)
        self.controller.hold(SETTLE_PERIODS * self._physics.substeps)
        self.frame = 0
        self._stages = 0
        return self._observe(), {"is_success": False} | self._progress(success=False)

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Run one control period towards ``action`` (16,).

        Raises:
            ValueError: the action has another shape or is not finite; names the entries.
        """
        world = self.world
        self.controller.apply(split_action(action))
        self.frame += 1
        over = self.frame >= self.task_spec.horizon
        missing = failed(self.task_spec.success, world) if over else ("the primitives are not over",)
        success = not missing
        info = {
            "is_success": success,
            "unmet": ", ".join(missing),
            "ik_failure": "; ".join(f"{side}: {why}" for side, why in self.controller.failures.items()),
        } | self._progress(success)
        return self._observe(), float(success), success, not success and self.frame >= self._max_episode_steps, info

    def _progress(self, success: bool) -> dict[str, Any]:
        """``stage``: how many of the task's stages have been reached, success being the last; and its measures."""
        task = self.task_spec
        self._stages = task.stages_reached(self.world, self._stages)
        return {"stage": len(task.stages) + 1 if success else self._stages} | task.read_measures(self.world)

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        objects = [
            self.world.pose(name).aligned_to(IDENTITY_QUATERNION).as_vector() for name in self.task_spec.observed
        ]
        return {
            "agent_pos": self.controller.observe().astype(np.float32),
            "environment_state": np.concatenate(objects).astype(np.float32),
        }

    def render(self) -> NDArray[np.uint8]:
        """(height, width, 3) RGB from the task's camera."""
        return self.world.render(self.task_spec.camera)

    def close(self) -> None:
        """Give the simulator back; a reset() opens a new one."""
        if self._world is not None:
            self._world.close()
            self._world = None
