"""A LeRobot policy as an actor."""

from __future__ import annotations

from typing import Any

import numpy as np

from hdril.actor import Decision, Explanation, Observation
from hdril.simulation.actions import ACTION_NAMES
from hdril.tasks import Task


class LeRobotActor:
    """A LeRobot checkpoint, with its processors, acting on one environment.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        ValueError: the checkpoint does not fit the environment.
    """

    def __init__(self, path: str, task: Task, overrides: tuple[str, ...] = (), device: str = "cpu") -> None:
        import torch
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        # Registers the policy types of lerobot_policy_* distributions.
        from lerobot.utils.import_utils import register_third_party_plugins

        register_third_party_plugins()
        torch.set_num_threads(1)
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[*overrides, f"--device={device}"])
        self.policy = get_policy_class(config.type).from_pretrained(path, config=config)
        self._before, self._after = make_pre_post_processors(
            config, pretrained_path=path, preprocessor_overrides={"device_processor": {"device": device}}
        )
        self._torch = torch
        self._description = task.description
        # Columns of the policy's primitives among the task's labels.
        primitives = getattr(config, "primitives", None) or []
        self._labels = np.array([task.labels.index(name) if name in task.labels else -1 for name in primitives])
        self._count = len(task.labels)
        self._believes = bool(primitives) and hasattr(self.policy, "attention")

    def reset(self, seed: int) -> None:
        """Begin an episode; a policy that samples draws the same numbers for the same seed."""
        self._torch.manual_seed(seed)
        self.policy.reset()

    def act(self, observation: Observation) -> Decision:
        """The action for an observation, and what the policy thinks if it has primitives."""
        from lerobot.envs.utils import preprocess_observation

        batch: dict[str, Any] = preprocess_observation(dict(observation))
        batch["task"] = [self._description]
        with self._torch.inference_mode():
            action = self._after(self.policy.select_action(self._before(batch)))
            return Decision(action[0].numpy().astype(np.float32), self._explain())

    def _explain(self) -> Explanation | None:
        rollout: Any = getattr(self.policy, "rollout", None)
        if not self._believes or rollout is None:
            return None
        probabilities = np.zeros(self._count, np.float32)
        known = self._labels >= 0
        probabilities[self._labels[known]] = rollout.probabilities[0].cpu().numpy()[known]
        plan = rollout.plan[0, :, : len(ACTION_NAMES)].cpu().numpy().copy() if bool(rollout.replanned[0]) else None
        if plan is not None:
            # The plan ends with the longest recorded form of this primitive.
            plan = plan[: max(1, int(self.policy.longest_length[rollout.primitive[0]] - rollout.plan_start[0]))]  # pyright: ignore
        received = self.policy.attention().received()  # pyright: ignore
        attention = {name: float(share[0]) for name, share in received.items()}
        return Explanation(int(self._labels[int(rollout.primitive[0])]), probabilities, plan, attention)
