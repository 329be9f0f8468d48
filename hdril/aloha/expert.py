"""ACT's scripted experts: waypoints from where everything is at the start, and no look after that."""

from __future__ import annotations

import json
import math

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Observation
from hdril.aloha.env import FRAMES, STRIDE, AlohaPosesEnv
from hdril.aloha.tasks import MEETING, START, STARTS, AlohaTask, Waypoint
from hdril.demonstrations.episode import Episode
from hdril.geometry import POSE_AXES, Pose, interpolate
from hdril.simulation.actions import HandCommand, join_action


def script(task: AlohaTask, observation: Observation) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The expert's actions (80, 16) for an episode that starts with ``observation``, and the primitive of each (80,)."""
    places = observation["environment_state"].astype(np.float64).reshape(-1, len(POSE_AXES))
    anchors = dict(zip(task.objects, places[:, :3], strict=True)) | {MEETING: np.array(task.meeting)}
    steps = [STRIDE * frame for frame in range(1, FRAMES + 1)]  # an action says where to be when its frame is over
    paths = {
        side: [_command(point, anchors | {START: np.array(STARTS[side])}) for point in points]
        for side, points in task.script.items()
    }
    actions = [
        join_action({side: _along(task.script[side], path, step) for side, path in paths.items()}) for step in steps
    ]
    labels = np.searchsorted(list(task.phases.values()), steps)
    return np.array(actions, np.float32), labels


def _command(point: Waypoint, anchors: dict[str, NDArray[np.float64]]) -> HandCommand:
    half = math.radians(point.degrees) / 2.0
    turn = [math.sin(half) * (axis == point.axis) for axis in "xyz"] + [math.cos(half)]
    return HandCommand(Pose(anchors[point.anchor] + np.array(point.offset), turn), point.opening)


def _along(points: tuple[Waypoint, ...], path: list[HandCommand], step: int) -> HandCommand:
    """The command at a control step, between the waypoint before and the one that is not before."""
    after = int(np.searchsorted([point.step for point in points], step))
    first, last = points[after - 1].step, points[after].step
    fraction, a, b = (step - first) / (last - first), path[after - 1], path[after]
    opening = (1.0 - fraction) * a.opening + fraction * b.opening
    return HandCommand(interpolate(a.pose, b.pose, fraction), opening)


def demonstrate(env: AlohaPosesEnv, seed: int) -> Episode:
    """Let the expert play the scene of ``seed`` once, to the end of its script."""
    observation, info = env.reset(seed=seed)
    actions, labels = script(env.task_spec, observation)
    seen, rewards = [], []
    for action in actions:
        seen.append(observation)
        observation, reward, _, _, info = env.step(action)
        rewards.append(reward)
    return Episode(
        seed=seed,
        state=np.stack([frame["agent_pos"] for frame in seen]),
        environment_state=np.stack([frame["environment_state"] for frame in seen]),
        action=actions,
        label=labels,
        start=np.diff(labels, prepend=-1) != 0,
        reward=np.array(rewards, np.float32),
        success=bool(info["is_success"]),
        unmet="" if info["is_success"] else f"the highest reward was {max(rewards):.0f}, not 4",
        scenario=json.dumps({"task": env.task, "seed": seed}),
    )
