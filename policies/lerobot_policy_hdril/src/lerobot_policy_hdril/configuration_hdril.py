"""Configuration of HDR-IL. Every variant of the paper (Section 5.1) is a value of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_policy_hdril.graph import feature_names, pose_groups
from lerobot_policy_hdril.presets import PLAIN, PRESETS
from lerobot_policy_hdril.provenance import TrainingData
from lerobot_policy_hdril.schema import LANGUAGE, SUBTASK_KEY
from lerobot_policy_hdril.single_frames import SingleFrameConfig

Interaction = Literal["none", "scalar", "object"]
Decoder = Literal["gru", "ode", "linear"]
Rollout = Literal["closed_loop", "open_loop"]
Coordinates = Literal["absolute", "relational", "fused"]
Latent = Literal["deterministic", "variational"]
Experts = Literal["auto", "separate", "stacked"]
Termination = Literal["length", "learned"]


_FREE = (
    "hidden_dim", "termination", "filter_frames", "long_filter_frames", "robust", "hand_noise", "split_forms",
    "planner_balance", "planner_dropout", "planner_late", "planner_scale", "least_survival", "repeat_discount", "replan_every",
    "plan_overlap",
)  # fmt: skip
"""Options that may differ from the preset's value."""
_FILTERS = ("filter_frames", "long_filter_frames")
"""Options that give the lengths of the means, frames."""
_RIDGES = ("ridge", "ridge_other")
_BEFORE = PLAIN | {"coordinates": "absolute", "fourier_features": 0, "split_forms": False}
"""Values of options whose default was another one, or which were not there, when a checkpoint without them was saved."""


def _check_choice(name: str, value: str, choices: Any) -> None:
    if value not in get_args(choices):
        raise ValueError(f"policy.{name} must be one of {', '.join(get_args(choices))}; got {value!r}")


@PreTrainedConfig.register_subclass("hdril")
@dataclass
class HDRILConfig(SingleFrameConfig):
    """HDR-IL: a planner over primitives, and a graph-recurrent dynamics model for each (paper, Sections 4.1 to 4.3).

    The defaults are those of the preset ``hdril_reactive``, which decides at every frame. ``preset=hdril`` looks once a
    primitive, and needs no poses.

    The paper's models are presets. GRU-GRU has ``interaction=none skip=false per_primitive=false``; Res adds ``skip``;
    Int adds ``interaction=scalar``; the Multi models and HDR-IL add ``per_primitive``.
    """

    # Variant.
    preset: str = ""
    """Name of a model in :data:`~lerobot_policy_hdril.presets.PRESETS`, which then decides the values of this group, and
    ``hidden_dim``. ``hidden_dim``, ``termination``, ``filter_frames``, ``long_filter_frames``, ``robust``, ``hand_noise``,
    ``split_forms``, ``planner_balance``, ``planner_dropout``, ``planner_late``, ``planner_scale``, ``least_survival``,
    ``repeat_discount``, ``replan_every`` and ``plan_overlap`` may be given nevertheless, where the model has a use for them.
    Empty to set them one by one. Once the policy has learned it is a name only."""
    interaction: Interaction = "object"
    """Graph attention: ``none``; ``scalar``, the paper's node per number of the state; ``object``, a node per object."""
    skip: bool = True
    """The objects' state skips the encoder and joins its last hidden state (the paper's Res)."""
    state_skip: bool = True
    """A linear map from the state to every step of the prediction, beside the network (ours)."""
    filter_frames: int = 8
    """The linear maps see the mean of the last so many states beside the present one: observations are noisy. 1: no such mean.
    It is 1 without ``state_skip``, which has the maps."""
    long_filter_frames: int = 24
    """The same for a second mean. A short one follows what moves, a long one tells best where something rests; the fit of the
    maps weighs them. Of two that are as long, there is one."""
    robust: bool = True
    """Leave out of the linear maps' fit what is far off it, and train the network with Huber's loss: in demonstrations of
    scenes where something goes wrong, some windows show how that was mended."""
    hand_noise: float = 0.005
    """Deviation, m, by which the measured hands are disturbed when the dynamics learn, so that they do not learn to follow
    themselves; 0: not at all. Rotations are disturbed in proportion. Numbers that actions have by the same name and that
    are no pose, such as an opening, are disturbed by half their deviation whatever the value, see
    :class:`~lerobot_policy_hdril.hand_noise.HandNoise`. For ``coordinates=fused`` alone; it is 0 with others."""
    termination: Termination = "learned"
    """When a primitive is over. ``length``: after its shortest recorded length, as soon as the planner prefers another.
    ``learned``: from that length on, the planner decides at every frame whether it goes on or one begins, maybe the same
    again; for demonstrations in which primitives are broken off and repeated."""
    split_forms: bool = True
    """Whether a primitive that begins with a hand closed, or another number of the actions that is no pose in the other half of
    its range, has a model of its own (:mod:`~lerobot_policy_hdril.forms`). For ``coordinates=fused`` alone; it is false with
    others."""
    planner_balance: float = 0.5
    """How much more the beginnings that are rare count when the planner learns: 0, not; 1, each in total as much as the most
    frequent one. None counts more than ten times. Few demonstrations show how something is mended
    (:func:`~lerobot_policy_hdril.planner.begin_weights`). The planner's probabilities are then higher for what is rare than its
    share. For ``termination=learned`` alone; it is 0 with others."""
    planner_dropout: float = 0.2
    """Share of the planner's embedded states and hidden states that training leaves out, so that few demonstrations teach more
    (:class:`~lerobot_policy_hdril.planner.Planner`)."""
    planner_late: float = 0.5
    """Share of the beginnings, but for an episode's first, that the planner is told of too late when it learns, by up to
    :data:`~lerobot_policy_hdril.demonstrations.LATEST` frames: as if it had missed them, and still had to answer that the
    primitive begins (:meth:`~lerobot_policy_hdril.demonstrations.History.late`). Each of these frames counts as a beginning does
    (``planner_balance``). Demonstrations show the right moment alone; a planner that once misses it would go on for good. For
    ``termination=learned`` alone; it is 0 with others."""
    planner_scale: float = 0.05
    """The planner sees the position p of each pose as asinh(p / planner_scale), too, m; 0: not. For ``interaction=object`` alone;
    it is 0 with others."""
    least_survival: float = 0.3
    """A primitive begins again only if, by all that the planner said since it began first, the probability that nothing else
    began is at least this. If it is less, the primitive is given up for what would most probably have begun; 0: never. A planner
    may doubt at each frame that something is still held, and at none enough. For ``termination=learned`` alone; it is 0 with
    others."""
    repeat_discount: float = 0.5
    """Where a primitive begins, the planner's probability of each counts by this share less for every time that it has begun in
    the episode, in any of its forms, three times at most; 0: not. So what did not help is not done for ever, where the planner is
    of two minds. For ``termination=learned`` alone; it is 0 with others."""
    per_primitive: bool = True
    """One dynamics model per primitive (the paper's Multi), or one for all that is told the primitive. Fused linear maps are one
    for each in any case."""
    decoder: Decoder = "linear"
    """``linear``: no network, the linear maps predict alone. ``gru``: a network learns what they leave, or all; without a preset,
    the default where coordinates are not fused. ``ode``: the paper's other decoder."""
    coordinates: Coordinates = "fused"
    """Of the dynamics. ``relational``: hands and predictions in the frame of the first object, as it stands when a plan is
    made. ``fused``: the linear maps predict the next actions in the world's and every object's frame, and the predictions
    are fused by their precision; needs ``replan_every``, because it plans a few frames at a time. The planner always sees
    the world's."""
    latent: Latent = "deterministic"
    """``variational``: a Gaussian, sampled in training (paper, Figure 2)."""
    kl_weight: float = 0.0
    """Weight of the Kullback-Leibler divergence of the latent from a unit Gaussian; 0 is the authors' loss."""
    samples: int = 0
    """Latents that a prediction averages over; 0: the mean latent."""

    # Rollout.
    rollout: Rollout = "closed_loop"
    """``closed_loop`` makes each plan from what is seen; ``open_loop`` chains predictions from the first state (the paper)."""
    replan_every: int = 2
    """Make a new plan every so many frames within a primitive as well; 0: at its start alone. A policy that was trained
    with n can be run with 0 and with any multiple of n, unless its predictions are fused."""
    plan_overlap: int = 1
    """First frames of the next plan that a plan covers as well. There the old plan fades into the new one, so that the hands
    do not jerk from plan to plan; at most ``replan_every``. For ``coordinates=fused`` alone; it is 0 with others."""

    # Sizes.
    hidden_dim: int = 128
    node_dim: int = 32
    planner_hidden_dim: int = 128
    experts: Experts = "auto"
    """How the models of several primitives are called: ``separate``ly, or ``stacked`` into one batched call. The numbers are
    the same; ``auto`` takes the faster, which is ``separate`` on a CPU. ``stacked`` needs ``decoder=gru``."""
    planner_batch_size: int = 8
    """Whole episodes per step that train the planner. It learns in a fraction of the steps that the dynamics need."""

    # Losses.
    state_loss_weight: float = 0.5
    """Weight of the predicted states beside that of the actions."""
    ridge: float = 1.0
    """Penalty on the squared weights of linear maps that are not fused (``state_skip``); they are solved, not trained."""
    ridge_other: float = 300.0
    """Penalty on the weights of a fused map for all that :data:`~lerobot_policy_hdril.fusion.RIDGES` are not for, which is most:
    a few demonstrations cannot tell which of some hundred numbers matter."""
    fusion_shrinkage: float = 0.2
    """How far the correlations of the frames' errors are shrunk towards 0 where predictions are fused. 1: frames count as
    independent. Estimated correlations are not exact, and maps that are nearly the same would be played off against each
    other."""
    fourier_features: int = 32
    """How many random Fourier features of each object's pose and of all sizes a fused map in its frame sees, so that it can bend
    with where that stands (:class:`~lerobot_policy_hdril.fourier.FourierFeatures`); 0: the maps are linear. For
    ``coordinates=fused`` alone; it is 0 with others."""
    min_std: float = 0.01
    """Floor of the deviations that normalise the data, m or dimensionless: numbers that hardly vary must not dominate."""

    # Optimisation.
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_share: float = 0.03
    scheduler_final_lr: float = 1e-6

    # Learned from the dataset; part of the checkpoint.
    subtask_key: str = SUBTASK_KEY
    """Column of the dataset that labels each frame with its primitive. A dataset without ``subtask_index`` may have LeRobot's
    ``language_persistent`` instead, with rows of the style ``subtask``."""
    primitives: list[str] = field(default_factory=list)
    forms: list[list[int]] = field(default_factory=list)
    """A model for each: the label of its primitive, and which numbers of the actions begin in the upper half of their range."""
    primitive_lengths: list[list[int]] = field(default_factory=list)
    """Shortest and longest run of each primitive in the episodes learned from, frames; [0, 0] for a primitive that is in
    none of them, which is never played. Empty before training."""
    capacity: int = 0
    """Frames that a plan has room for: the longest segment of a primitive in the dataset. The size of an array; what is
    learned comes from the episodes that are learned from."""
    training_data: list[TrainingData] = field(default_factory=list)
    """What the policy learned from, dataset by dataset; a record without a digest stands for data that are not known."""
    trained_replan_every: int = -1
    """``replan_every`` in training, which decides where in a primitive plans can start; -1 before."""
    state_names: list[str] = field(default_factory=list)
    environment_names: list[str] = field(default_factory=list)
    action_names: list[str] = field(default_factory=list)

    normalization_mapping: dict[str, NormalizationMode] = field(
        # The model normalises by itself: it trains on trajectories that never pass through the processors.
        default_factory=lambda: {
            "STATE": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    running_options = frozenset({"samples", "rollout", "replan_every", "experts", "least_survival", "repeat_discount"})
    """What of a trained policy may change when it is run; everything else acts in training, or its weights have fixed it."""

    _given = frozenset[str]()
    """Names of the values that the constructor was given."""

    def __new__(cls, *args: Any, **kwargs: Any) -> HDRILConfig:
        """Note which values were given: one that equals the default must count against a preset, too."""
        config = super().__new__(cls)
        named = [entry.name for entry in fields(cls) if entry.init and not entry.kw_only]
        config._given = frozenset(kwargs) | frozenset(named[: len(args)])
        return config

    def __post_init__(self) -> None:
        super().__post_init__()
        self._complete_older_checkpoint()
        if self.preset and not self.primitives:
            self._apply_preset()
        if self.coordinates != "fused":
            if "hand_noise" not in self._given:
                self.hand_noise = 0.0
            if "fourier_features" not in self._given:
                self.fourier_features = 0
            if "split_forms" not in self._given:
                self.split_forms = False
            if "plan_overlap" not in self._given:
                self.plan_overlap = 0
        if self.termination != "learned":
            for name in ("planner_balance", "planner_late", "least_survival", "repeat_discount"):
                if name not in self._given:
                    setattr(self, name, 0.0)
        if self.interaction != "object" and "planner_scale" not in self._given:
            self.planner_scale = 0.0
        if self.coordinates != "fused" and "decoder" not in self._given and not self.preset:
            self.decoder = "gru"
        if not self.state_skip:
            for name in _FILTERS:
                if name not in self._given:
                    setattr(self, name, 1)
        _check_choice("interaction", self.interaction, Interaction)
        _check_choice("decoder", self.decoder, Decoder)
        _check_choice("rollout", self.rollout, Rollout)
        _check_choice("coordinates", self.coordinates, Coordinates)
        _check_choice("latent", self.latent, Latent)
        _check_choice("experts", self.experts, Experts)
        _check_choice("termination", self.termination, Termination)
        for name in ("hidden_dim", "node_dim", "planner_hidden_dim", "planner_batch_size", *_FILTERS):
            if getattr(self, name) < 1:
                raise ValueError(f"policy.{name} must be at least 1, got {getattr(self, name)}")
        for name in _RIDGES:
            if getattr(self, name) <= 0:
                raise ValueError(f"policy.{name} must be above 0, got {getattr(self, name)}")
        if self.kl_weight < 0 or self.samples < 0:
            raise ValueError(
                f"policy.kl_weight and policy.samples must not be negative, got {self.kl_weight} and {self.samples}"
            )
        if self.latent == "deterministic" and (self.kl_weight or self.samples):
            raise ValueError("policy.kl_weight and policy.samples are for policy.latent=variational")
        if self.experts == "stacked" and self.decoder != "gru":
            raise ValueError(f"policy.experts=stacked needs policy.decoder=gru; got {self.decoder}")
        if self.coordinates == "fused":
            self._check_fused()
        if self.decoder == "linear" and not (self.state_skip and self.per_primitive and self.latent == "deterministic"):
            raise ValueError(
                "policy.decoder=linear needs policy.state_skip=true, policy.per_primitive=true and "
                f"policy.latent=deterministic; got {self.state_skip}, {self.per_primitive} and {self.latent}; "
                "give policy.decoder=gru for a network"
            )
        for name in _FILTERS:
            if getattr(self, name) > 1 and not self.state_skip:
                raise ValueError(
                    f"policy.{name} is for policy.state_skip=true; got {getattr(self, name)} and state_skip=false"
                )
        if self.hand_noise < 0 or (self.hand_noise and self.coordinates != "fused"):
            raise ValueError(
                "policy.hand_noise must not be negative, and is for policy.coordinates=fused; "
                f"got {self.hand_noise} and {self.coordinates}"
            )
        if not 0.0 < self.fusion_shrinkage <= 1.0:
            raise ValueError(f"policy.fusion_shrinkage must be above 0 and at most 1, got {self.fusion_shrinkage}")
        if self.split_forms and self.coordinates != "fused":
            raise ValueError(f"policy.split_forms is for policy.coordinates=fused; got true and {self.coordinates}")
        if self.fourier_features < 0 or (self.fourier_features and self.coordinates != "fused"):
            raise ValueError(
                "policy.fourier_features must be 0 (none) or more, and is for policy.coordinates=fused; "
                f"got {self.fourier_features} and {self.coordinates}"
            )
        if not 0.0 <= self.planner_balance <= 1.0 or (self.planner_balance and self.termination != "learned"):
            raise ValueError(
                "policy.planner_balance must be from 0 to 1, and is for policy.termination=learned; "
                f"got {self.planner_balance} and {self.termination}"
            )
        if not 0.0 <= self.least_survival < 1.0 or (self.least_survival and self.termination != "learned"):
            raise ValueError(
                "policy.least_survival must be from 0 to less than 1, and is for policy.termination=learned; "
                f"got {self.least_survival} and {self.termination}"
            )
        if not 0.0 <= self.repeat_discount < 1.0 or (self.repeat_discount and self.termination != "learned"):
            raise ValueError(
                "policy.repeat_discount must be from 0 to less than 1, and is for policy.termination=learned; "
                f"got {self.repeat_discount} and {self.termination}"
            )
        if not 0.0 <= self.planner_late <= 1.0 or (self.planner_late and self.termination != "learned"):
            raise ValueError(
                "policy.planner_late must be from 0 to 1, and is for policy.termination=learned; "
                f"got {self.planner_late} and {self.termination}"
            )
        if not 0.0 <= self.planner_dropout < 1.0:
            raise ValueError(f"policy.planner_dropout must be from 0 to less than 1, got {self.planner_dropout}")
        if not 0.0 <= self.planner_scale < math.inf or (self.planner_scale and self.interaction != "object"):
            raise ValueError(
                "policy.planner_scale must be 0 or a length in m, and is for policy.interaction=object; "
                f"got {self.planner_scale} and {self.interaction}"
            )
        if self.replan_every < 0:
            raise ValueError(f"policy.replan_every must be 0 (never) or more frames, got {self.replan_every}")
        most = self.replan_every if self.coordinates == "fused" else 0
        if not 0 <= self.plan_overlap <= most:
            raise ValueError(
                "policy.plan_overlap must be from 0 to policy.replan_every, and is for policy.coordinates=fused; "
                f"got {self.plan_overlap}, {self.replan_every} and {self.coordinates}"
            )

    def _check_fused(self) -> None:
        remedy = (
            "train with policy.preset=hdril for another way"
            if self.primitives
            else "or give policy.coordinates=absolute"
        )
        if not (self.state_skip and self.rollout == "closed_loop" and self.replan_every):
            raise ValueError(
                "policy.coordinates=fused needs policy.state_skip=true, policy.rollout=closed_loop and policy.replan_every "
                f"of at least 1; got {self.state_skip}, {self.rollout} and {self.replan_every}; {remedy}"
            )
        if self.decoder == "ode":
            raise ValueError(
                "policy.decoder=ode is integrated over a plan, and policy.coordinates=fused plans a few frames at a time; "
                "give policy.coordinates=absolute"
            )

    def _complete_older_checkpoint(self) -> None:
        """Checkpoints from before an option was there act as they did. Those from before ``training_data`` have what they learned
        from in no record."""
        if self.primitives:
            for name, value in _BEFORE.items():
                if name not in self._given:
                    setattr(self, name, value)
            if self.coordinates == "fused" and "fusion_shrinkage" not in self._given:
                raise ValueError(
                    "the checkpoint has policy.coordinates=fused of a version that fused its maps in another way: "
                    "train it anew, or run it with the version that saved it"
                )
        if self.primitives and not self.forms:
            self.forms = [[k] for k in range(len(self.primitives))]
        if self.primitive_lengths and not self.capacity:
            self.capacity = max(longest for _, longest in self.primitive_lengths)
        if self.primitive_lengths and not self.training_data:
            self.training_data = [TrainingData()]

    def _apply_preset(self) -> None:
        if self.preset not in PRESETS:
            raise ValueError(f"unknown policy.preset {self.preset!r}; choose from: {', '.join(PRESETS)}")
        for name, value in PRESETS[self.preset].items():
            given = getattr(self, name)
            if name not in self._given:
                setattr(self, name, value)
            elif given != value and name not in _FREE:
                raise ValueError(
                    f"policy.preset={self.preset} makes policy.{name} {value!r}, but {given!r} was given; leave out one"
                )

    @property
    def halved(self) -> list[int]:
        """Columns of an action that tell forms of a primitive apart: those that are no pose's."""
        posed = {column for group in pose_groups(self.action_names) for column in group}
        return [i for i in range(len(self.action_names)) if i not in posed] if self.split_forms else []

    @property
    def form_names(self) -> list[str]:
        """The primitive of each form."""
        return [self.primitives[form[0]] for form in self.forms]

    @property
    def filters(self) -> list[int]:
        """Lengths of the means that the linear maps see, frames; the shortest comes first."""
        return sorted({frames for name in _FILTERS if (frames := getattr(self, name)) > 1})

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Learn what each number of state and action is called. LeRobot calls this when it trains.

        Raises:
            ValueError: the dataset has no labels, or lacks a feature, or is not the one that the checkpoint learned.
        """
        in_words = self.subtask_key == SUBTASK_KEY and LANGUAGE in features
        if self.subtask_key not in features and not in_words:
            raise ValueError(
                f"the dataset has no column {self.subtask_key!r} that labels its frames with primitives; "
                f"its columns: {', '.join(features)}"
            )
        for key in (OBS_STATE, OBS_ENV_STATE, ACTION):
            if key not in features:
                raise ValueError(f"hdril needs {key!r}; the dataset has: {', '.join(features)}")
        self._learn("state_names", feature_names(OBS_STATE, features[OBS_STATE]))
        self._learn("environment_names", feature_names(OBS_ENV_STATE, features[OBS_ENV_STATE]))
        self._learn("action_names", feature_names(ACTION, features[ACTION]))

    def learn_replanning(self) -> None:
        """Keep ``replan_every``: training starts.

        Raises:
            ValueError: the checkpoint was trained to plan at other frames.
        """
        if self.trained_replan_every < 0:
            self.trained_replan_every = self.replan_every
        self.check_replanning()

    def check_replanning(self) -> None:
        """Raises ValueError unless the policy learned to plan from every frame at which it is to do so."""
        trained, wanted = self.trained_replan_every, self.replan_every
        if self.coordinates == "fused" and trained not in (-1, wanted):
            raise ValueError(
                f"policy.replan_every must be {trained}, because the checkpoint plans so many frames; got {wanted}"
            )
        if trained < 0 or not wanted or (trained and wanted % trained == 0):
            return
        valid = f"0 or a multiple of {trained}" if trained else "0"
        raise ValueError(
            f"policy.replan_every must be {valid}, because the checkpoint was trained with {trained}; got {wanted}"
        )

    def learn_primitives(self, primitives: list[str], longest: int) -> None:
        """Keep the names of the dataset's primitives, and make room for the longest of their segments, frames.

        Raises:
            ValueError: the checkpoint knows other primitives, or shorter ones: the dataset is of another task.
        """
        self._learn("primitives", primitives)
        self.capacity = self.capacity or longest
        if longest > self.capacity:
            raise ValueError(
                f"the checkpoint predicts {self.capacity} frames at most, but a primitive of the dataset has {longest}"
            )

    def _learn(self, name: str, value: list[str]) -> None:
        known = getattr(self, name)
        if known and known != value:
            raise ValueError(
                f"the checkpoint was trained on another task: its {name} are {', '.join(known)}; "
                f"the dataset's are {', '.join(value)}"
            )
        setattr(self, name, value)

    def validate_features(self) -> None:
        """Raises ValueError unless state, objects and actions are there, as vectors."""
        for key, kind in ((OBS_STATE, FeatureType.STATE), (OBS_ENV_STATE, FeatureType.ENV)):
            feature = (self.input_features or {}).get(key)
            if feature is None or feature.type is not kind or len(feature.shape) != 1:
                raise ValueError(f"hdril needs {key!r} as a vector; inputs: {', '.join(self.input_features or {})}")
        if self.action_feature is None:
            raise ValueError(f"hdril needs {ACTION!r}; outputs: {', '.join(self.output_features or {})}")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        # LeRobot shrinks a longer schedule to the steps of the run: any run decays to its end.
        steps = 1_000_000
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=int(steps * self.scheduler_warmup_share),
            num_decay_steps=steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_final_lr,
        )
