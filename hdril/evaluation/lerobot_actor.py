"""A LeRobot policy as an actor."""

from __future__ import annotations

from typing import Any

import numpy as np

from hdril.actor import Decision, Explanation, Observation
from hdril.evaluation.checkpoint import Checkpoint, find_checkpoint, identify, resolve_config
from hdril.evaluation.identity import PolicyIdentity, differences
from hdril.tasks import Task


class LeRobotActor:
    """A LeRobot checkpoint, with its processors, acting on one environment.

    Args:
        checkpoint: a folder, or a repository of the Hub.
        task: what it acts on.
        overrides: changes of the policy's config, as ``--name=value``.
        device: of the policy.
        expected: what the checkpoint was when the evaluation began; training may have written over it since.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        ValueError: the checkpoint is damaged, is not the expected one, or does not fit the environment.
    """

    def __init__(
        self,
        checkpoint: str | Checkpoint,
        task: Task,
        overrides: tuple[str, ...] = (),
        device: str = "cpu",
        expected: PolicyIdentity | None = None,
    ) -> None:
        import torch
        from lerobot.policies.factory import make_pre_post_processors

        torch.set_num_threads(1)
        found = find_checkpoint(checkpoint) if isinstance(checkpoint, str) else checkpoint
        config = resolve_config(found, overrides, device)
        self.policy = _load_policy(found, config)
        self._before, self._after = make_pre_post_processors(
            config,
            pretrained_path=str(found.folder),
            preprocessor_overrides={"device_processor": {"device": device}},
        )
        # After loading, not before: whatever was loaded, a file that is the expected one now was so then.
        if expected is not None:
            _check_unchanged(found, expected, identify(found, config))
        self._torch, self._task = torch, task
        self._explains = hasattr(self.policy, "explain")

    def reset(self, seed: int) -> None:
        """Begin an episode; a policy that samples draws the same numbers for the same seed."""
        self._torch.manual_seed(seed)
        self.policy.reset()

    def act(self, observation: Observation) -> Decision:
        """The action for an observation, and why the policy chose it, if it can tell."""
        from lerobot.envs.utils import preprocess_observation

        batch: dict[str, Any] = preprocess_observation(dict(observation))
        batch["task"] = [self._task.description]
        with self._torch.inference_mode():
            action = self._after(self.policy.select_action(self._before(batch)))
            return Decision(action[0].numpy(force=True).astype(np.float32), self._explain())

    def _explain(self) -> Explanation | None:
        """What the policy's ``explain()`` says, in labels of the task; None for policies that have none."""
        told = self.policy.explain() if self._explains else None
        if told is None:
            return None
        labels = self._task.labels
        probabilities = np.array([told.probabilities.get(name, 0.0) for name in labels], np.float32)
        executed = labels.index(told.primitive) if told.primitive in labels else -1
        return Explanation(executed, probabilities, told.plan, dict(told.attention), tuple(told.events))


def foreign_primitives(checkpoint: Checkpoint, task: Task) -> tuple[str, ...]:
    """The primitives of a policy that are none of the task's."""
    primitives = checkpoint.read_config().get("primitives") or ()
    return tuple(name for name in primitives if name not in task.labels)


def _load_policy(checkpoint: Checkpoint, config: Any) -> Any:
    """The policy with all its weights and no others: LeRobot by itself logs what is missing, and leaves it random."""
    from lerobot.policies.factory import get_policy_class

    try:
        return get_policy_class(config.type).from_pretrained(str(checkpoint.folder), config=config, strict=True)
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        _, _, reason = str(error).partition(":")
        raise ValueError(f"{checkpoint.weights} does not fit the policy's config: {' '.join(reason.split())}") from None


def _check_unchanged(checkpoint: Checkpoint, expected: PolicyIdentity, found: PolicyIdentity) -> None:
    if changed := differences(vars(expected), vars(found)):
        raise ValueError(
            f"the checkpoint {checkpoint.name} was written over since the evaluation began: other {', '.join(changed)}; "
            "evaluate a copy, or a checkpoint that training does not change"
        )
