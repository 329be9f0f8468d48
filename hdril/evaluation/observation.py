"""Whether a policy takes what a task lets it observe."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from hdril.tasks import Task

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

ENVIRONMENT_STATE = "observation.environment_state"


def state_width(config: PreTrainedConfig) -> int | None:
    """How many numbers of the objects a policy takes; None if it takes none, or does not say."""
    feature = (config.input_features or {}).get(ENVIRONMENT_STATE)
    return None if feature is None else int(feature.shape[0])


def observes_details(config: PreTrainedConfig, policy: str, task: Task) -> bool:
    """Whether a policy is to be shown all that may vary between scenes of a task: whether it was trained on that.

    Args:
        config: the policy's.
        policy: its name, for messages.
        task: the task, at any level.

    Raises:
        ValueError: it takes neither the numbers of the nominal task nor all.
    """
    width = state_width(config)
    nominal, all_of_it = (len(replace(task, detailed=detailed).state_names) for detailed in (False, True))
    if width not in (None, nominal, all_of_it):
        raise ValueError(
            f"{policy} takes {width} numbers of the objects; {task.name} has {nominal}, or {all_of_it} with all that may vary"
        )
    return width == all_of_it != nominal


def check_observation(config: PreTrainedConfig, policy: str, task: Task) -> None:
    """Raises ValueError if a policy takes other numbers of the objects than a task gives."""
    width, given = state_width(config), len(task.state_names)
    if width in (None, given):
        return
    other = replace(task, detailed=not task.detailed)
    remedy = f"; add detailed={int(other.detailed)} to the task" if width == len(other.state_names) else ""
    raise ValueError(f"{policy} takes {width} numbers of the objects, {task.name} gives {given}{remedy}")
