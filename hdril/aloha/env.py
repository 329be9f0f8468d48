"""gym-aloha's tasks as a Gymnasium environment of poses."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hdril.actor import Observation
from hdril.aloha.physics import RATE, AlohaPhysics
from hdril.aloha.tasks import find_task
from hdril.files import MAX_SEED
from hdril.geometry import interpolate
from hdril.simulation.actions import ACTION_NAMES, HandCommand, split_action

FPS = 10
"""Actions in a second."""
STRIDE = RATE // FPS
"""Control steps of an action."""
FRAMES = 400 // STRIDE
"""Frames of an episode: ACT's 400 control steps."""
SUCCESS = 4
"""gym-aloha's highest reward."""


class AlohaPosesEnv(gym.Env):
    """gym-aloha's transfer of a cube, or insertion of a peg, seen and controlled by poses: 10 actions a second.

    **It is easier than what ACT's published numbers are for.** ACT sees images and commands joints at 50 Hz. Here the observation
    is privileged, exact poses, and the actions are poses of the hands, which a weld without limits of force follows (gym-aloha's
    own end-effector control, by which its demonstrations are made).

    Observation: ``agent_pos`` (16,), measured poses and openings of the hands; ``environment_state`` (7 per object,), their
    poses.
    Action (16,): poses and openings for the hands to reach in 0.1 s, on a straight line from those before
    (:data:`~hdril.simulation.actions.ACTION_NAMES`); quaternions are normalised, openings clipped to [0, 1]. Metres, quaternions
    xyzw, gym-aloha's world frame.

    A seed puts the objects where ``gym.make("gym_aloha/…").reset(seed=…)`` puts them. The reward of a frame is the highest of
    gym-aloha's rewards (0 to 4) in its five control steps. The episode is a success once the reward has been 4, as in ACT and
    gym-aloha. It always lasts 80 frames, ACT's 400 control steps: touching is a success, so it would otherwise end in the middle
    of a grasp.

    Raises:
        ValueError: unknown task or render mode.
        MissingExtraError: gym-aloha is not installed.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": FPS}  # pyright: ignore

    def __init__(self, task: str = "transfer_cube", render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render mode {render_mode!r}; choose from: rgb_array")
        self.task_spec = find_task(task)
        self.task, self.task_description = self.task_spec.name, self.task_spec.description
        self.render_mode, self._max_episode_steps = render_mode, FRAMES
        self._physics = AlohaPhysics(self.task_spec)
        sizes = {"agent_pos": len(ACTION_NAMES), "environment_state": len(self.task_spec.state_names)}
        self.observation_space = spaces.Dict(
            {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        )
        lows = [{"x": -2, "y": -2, "z": -2, "pos": 0}.get(name.split(".")[1], -1) for name in ACTION_NAMES]
        highs = [{"x": 2, "y": 2, "z": 2}.get(name.split(".")[1], 1) for name in ACTION_NAMES]
        self.action_space = spaces.Box(np.array(lows, np.float32), np.array(highs, np.float32))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the scene of the seed."""
        super().reset(seed=seed)
        scene = int(self.np_random.integers(MAX_SEED + 1)) if seed is None else seed
        self._commands, self._frame, self._highest = self._physics.reset(scene), 0, 0
        return self._observe(), {"is_success": False}

    def step(self, action: NDArray[np.floating]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for 0.1 s towards ``action`` (16,).

        Raises:
            ValueError: the action has another shape or is not finite; names the entries.
        """
        before, self._commands = self._commands, split_action(action)
        fractions = np.arange(1, STRIDE + 1) / STRIDE
        reward = max(self._physics.step(_between(before, self._commands, fraction)) for fraction in fractions)
        self._frame, self._highest = self._frame + 1, max(self._highest, reward)
        info = {"is_success": self._highest == SUCCESS}
        return self._observe(), float(reward), False, self._frame >= FRAMES, info

    def _observe(self) -> Observation:
        return {
            "agent_pos": self._physics.hands().astype(np.float32),
            "environment_state": self._physics.objects().astype(np.float32),
        }

    def render(self) -> NDArray[np.uint8]:
        """(240, 320, 3) RGB from in front of the table."""
        return self._physics.render()


def _between(start: dict[str, HandCommand], end: dict[str, HandCommand], fraction: float) -> dict[str, HandCommand]:
    """The commands on the way: a straight line in position and opening, a great circle in rotation."""
    return {
        side: HandCommand(
            interpolate(start[side].pose, end[side].pose, fraction),
            (1.0 - fraction) * start[side].opening + fraction * end[side].opening,
        )
        for side in end
    }
