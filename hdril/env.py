"""A bimanual task as a Gymnasium environment."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hdril.files import MAX_SEED
from hdril.geometry import IDENTITY_QUATERNION
from hdril.simulation.actions import ACTION_NAMES, split_action
from hdril.simulation.controller import EndEffectorController
from hdril.simulation.disturbances import Disturbances
from hdril.simulation.robots import ROBOTS
from hdril.simulation.sensor import Sensor
from hdril.simulation.world import ROBOT, Physics, World
from hdril.tasks import built_as, get_task
from hdril.tasks.conditions import failed
from hdril.tasks.events import EVENT_KINDS
from hdril.tasks.factors import POSTURE, stream
from hdril.tasks.scenario import Scenario
from hdril.tasks.task import Task

SETTLE_PERIODS = 2
START_CLEARANCE = 0.01
"""Least distance, m, between the robot and an object, where the arms do not start in their usual posture."""
FALLEN = -0.15
"""Height, m, below the bench's top, of an object that has fallen off."""


class BimanualEnv(gym.Env):
    """A world, a task and a controller of the hands: 10 actions a second.

    Observation: ``agent_pos`` (16,), measured hand poses and openings; ``environment_state``, poses of the observed objects
    and, where scenes vary, their attributes (:attr:`hdril.tasks.Task.state_names`).
    Action (16,): hand poses and openings to reach, in the same order (:data:`~hdril.simulation.actions.ACTION_NAMES`);
    quaternions are normalised, openings clipped to [0, 1].

    A seed decides the whole scene and what happens to it (:class:`~hdril.tasks.scenario.Scenario`).

    Success is judged at every frame from the task's horizon on; after the horizon it must hold for the task's ``dwell``. It
    ends the episode with a reward of 1. An episode without one is cut after ``max_episode_steps`` frames, which are the
    task's budget unless given, or when an object has fallen off the bench.

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
        self._declared, self.robot_spec = get_task(task), ROBOTS.find(robot)
        self.task_spec: Task = self._declared
        """The task as it is in the running episode."""
        self.task, self.task_description = self.task_spec.name, self.task_spec.description
        self.render_mode = render_mode
        self._max_episode_steps = self.task_spec.episode_limit(max_episode_steps, "max_episode_steps")
        self._physics, self._meshes = physics or self.task_spec.physics, meshes
        self._world: World | None = None
        self.controller = EndEffectorController(self.robot_spec)
        high = np.full(len(self.task_spec.state_names), np.inf, np.float32)
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
        for side, arm in robot.arms.items():
            world.set_link_dynamics(
                ROBOT,
                arm.gripper.pads,
                lateralFriction=robot.actuation.pad_friction,
                spinningFriction=robot.actuation.pad_torsion,
                frictionAnchor=int(side in task.anchored_hands),
            )
        for arm in robot.arms.values():
            # One motor drives both fingers (the URDF's mimic tag, which PyBullet ignores). Fingers driven apart push
            # against each other with equal forces, and what they hold floats between them.
            world.couple_joints(ROBOT, *arm.gripper.joints, max_force=robot.actuation.finger_gear_force)
        world.set_joint_velocity_limits(ROBOT, robot.actuation.velocities)
        for body in task.bodies:
            world.add_body(body, self.scenario.pose(body.name))
        return world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Build the scene of the seed, the arms in their posture, and let everything come to rest.

        ``options={"scenario": …}`` plays a :class:`~hdril.tasks.scenario.Scenario` instead.

        Raises:
            ValueError: the scenario is of another task, or of this one with other parameters of its own.
        """
        super().reset(seed=seed)
        self.close()
        scenario = (options or {}).get("scenario")
        if scenario is None:
            scenario = self._declared.sample(int(self.np_random.integers(MAX_SEED + 1)) if seed is None else seed)
        elif built_as(scenario.task) != built_as(self.task):
            raise ValueError(f"this is an environment of {self.task}, the scenario is of {scenario.task}")
        self.scenario: Scenario = scenario
        self.task_spec = self._declared.at(scenario.values)
        self._whole = replace(self.task_spec, detailed=True)
        self._world = self._new_world()
        self._start_arms(self._world)
        self.controller.hold(SETTLE_PERIODS * self._physics.substeps)
        self._sensor = Sensor(self.task_spec.sensor(scenario.values), scenario.seed)
        self._disturbances = Disturbances(self._world, self.controller, self._sensor)
        self.frame = 0
        self._stages = 0
        self._held = 0
        return self._observe(), {"is_success": False, "events": ""} | self._progress(success=False)

    def _start_arms(self, world: World) -> None:
        """Put the arms in their posture, each joint off it by a random angle where that varies.

        Of 100 postures the first is taken in which no part of an arm is at an object; the posture itself if there is none.
        """
        largest = self.scenario.values.get(POSTURE.name, 0.0)
        if not largest:
            self.controller.start(world)
            return
        rng = stream(self.scenario.seed, POSTURE.name)
        joints = [joint for arm in self.robot_spec.arms.values() for joint in arm.joints]
        objects = [body.name for body in self.task_spec.bodies if body.mass > 0.0]
        for _ in range(100):
            self.controller.start(world, {joint: float(rng.uniform(-largest, largest)) for joint in joints})
            if not any(world.near(ROBOT, name, START_CLEARANCE) for name in objects):
                return
        self.controller.start(world)

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Run one control period towards ``action`` (16,).

        Raises:
            ValueError: the action has another shape or is not finite; names the entries.
        """
        world, commands = self.world, split_action(action)
        events = self._begin_events()
        self.controller.apply(commands)
        self.frame += 1
        missing = self._missing(world)
        success, fallen = not missing, self._fallen(world)
        info = {
            "is_success": success,
            "unmet": ", ".join((*missing, *(f"{name} has fallen off the bench" for name in fallen))) if missing else "",
            "events": events,
            "ik_failure": "; ".join(f"{side}: {why}" for side, why in self.controller.failures.items()),
        } | self._progress(success)
        truncated = not success and (self.frame >= self._max_episode_steps or bool(fallen))
        return self._observe(), float(success), success, truncated, info

    def _fallen(self, world: World) -> tuple[str, ...]:
        """Objects that have fallen off the bench, after which nothing can be done any more."""
        return tuple(name for name in self.task_spec.observed if world.pose(name).position[2] < FALLEN)

    def _begin_events(self) -> str:
        """Let those events happen that begin at this frame; says which, in words."""
        begun = [event for event in self.scenario.events if event.frame == self.frame]
        for event in begun:
            EVENT_KINDS[event.kind].begin(self._disturbances, event)
        return "; ".join(map(str, begun))

    def _missing(self, world: World) -> tuple[str, ...]:
        """Why the episode is not a success at this frame; empty if it is."""
        task = self.task_spec
        if self.frame < task.horizon:
            return ("the primitives are not over",)
        missing = failed(task.success, world)
        self._held = 0 if missing else self._held + 1
        if not missing and self.frame > task.horizon and self._held < task.dwell:
            return (f"success has held for {self._held} of {task.dwell} frames",)
        return missing

    def _progress(self, success: bool) -> dict[str, Any]:
        """``stage``: how many of the task's stages have been reached, success being the last; and its measures."""
        task = self.task_spec
        self._stages = task.stages_reached(self.world, self._stages)
        return {"stage": len(task.stages) + 1 if success else self._stages} | task.read_measures(self.world)

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        task = self.task_spec
        self._hands = self.controller.observe().astype(np.float32)
        objects = self._sensor.observe([self.world.pose(name) for name in task.objects])
        attributes = [value for _, value in task.attributes if task.detailed]
        return {
            "agent_pos": self._hands.copy(),
            "environment_state": np.concatenate([objects, attributes]).astype(np.float32),
        }

    def exact_observation(self) -> dict[str, NDArray[np.float32]]:
        """The observation without noise and delay, with everything that may vary between scenes: for demonstrators."""
        world = self.world
        seen = [world.pose(name).aligned_to(IDENTITY_QUATERNION).as_vector() for name in self._whole.objects]
        return {
            "agent_pos": self._hands.copy(),
            "environment_state": np.concatenate([*seen, [value for _, value in self._whole.attributes]]).astype(
                np.float32
            ),
        }

    def render(self) -> NDArray[np.uint8]:
        """(height, width, 3) RGB from the task's camera."""
        return self.world.render(self.task_spec.camera)

    def close(self) -> None:
        """Give the simulator back; a reset() opens a new one."""
        if self._world is not None:
            self._world.close()
            self._world = None
