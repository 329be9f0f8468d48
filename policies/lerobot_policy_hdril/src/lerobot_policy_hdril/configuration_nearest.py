"""Configuration of the nearest demonstration, replayed."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim.optimizers import SGDConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_policy_hdril.provenance import TrainingData
from lerobot_policy_hdril.schema import SUBTASK_KEY
from lerobot_policy_hdril.single_frames import SingleFrameConfig


@PreTrainedConfig.register_subclass("nearest")
@dataclass
class NearestConfig(SingleFrameConfig):
    """A baseline that learns nothing: the demonstration whose first state is nearest is replayed, blindly, to its end.

    With few demonstrations retrieval is hard to beat; see Pari et al. (2022), "The Surprising Effectiveness of Representation
    Learning for Visual Imitation", for its form at every frame.
    """

    subtask_key: str = SUBTASK_KEY
    """Column of the dataset that labels each frame with its primitive. The labels are not used."""

    # Learned from the data.
    episodes: int = 0
    """Demonstrations that there is room for: the dataset's. Those are replayed of which training batches held a frame."""
    longest: int = 0
    """Frames of the longest demonstration of the dataset."""
    training_data: list[TrainingData] = field(default_factory=list)
    """What the policy learned from."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY)
    )

    running_options = frozenset[str]()
    """What of a trained policy may change when it is run: nothing."""

    def validate_features(self) -> None:
        """Raises ValueError unless state, objects and actions are there."""
        missing = [key for key in (OBS_STATE, OBS_ENV_STATE) if key not in (self.input_features or {})]
        if missing or self.action_feature is None:
            raise ValueError(f"nearest needs {OBS_STATE}, {OBS_ENV_STATE} and actions; it lacks {missing or 'actions'}")

    def get_optimizer_preset(self) -> SGDConfig:
        # LeRobot wants an optimiser; there is nothing to optimise.
        return SGDConfig(lr=0.0, weight_decay=0.0)

    def get_scheduler_preset(self) -> None:
        return None
