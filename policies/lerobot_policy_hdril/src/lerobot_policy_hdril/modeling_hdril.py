"""HDR-IL as a LeRobot policy: choose the next primitive, predict its trajectory, look again (paper, Section 4)."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from lerobot.utils.device_utils import resolve_safetensors_device
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_hdril.card import model_card
from lerobot_policy_hdril.configuration_hdril import HDRILConfig
from lerobot_policy_hdril.coordinates import Origins, RelationalCoordinates, towards, unit
from lerobot_policy_hdril.demonstrations import Demonstrations, History, Window
from lerobot_policy_hdril.dynamics import PrimitiveDynamics, predict_stacked
from lerobot_policy_hdril.explain import Attention, Explanation, attend, explain
from lerobot_policy_hdril.fitting import LearnedEpisodes, fit
from lerobot_policy_hdril.fusion import FusedMaps, ObjectFrames
from lerobot_policy_hdril.graph import quaternion_groups
from lerobot_policy_hdril.hand_noise import HandNoise
from lerobot_policy_hdril.overrides import check_overrides
from lerobot_policy_hdril.planner import Planner, begin_weights
from lerobot_policy_hdril.player import Choice, PlaybackState, advance
from lerobot_policy_hdril.provenance import read_origin
from lerobot_policy_hdril.weights import load_weights

if TYPE_CHECKING:
    from huggingface_hub import ModelCard
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


_HUB_OPTIONS = (
    "force_download", "resume_download", "proxies", "token", "cache_dir", "local_files_only", "revision",
)  # fmt: skip


def _rows_by_primitive(primitive: Tensor) -> Iterator[tuple[int, Tensor | slice]]:
    """Each primitive that is in ``primitive`` (B,), and its rows. They are a slice of all if there is but one primitive: for one
    running episode, gathering rows takes as long as a small layer."""
    present = primitive.tolist() if len(primitive) == 1 else primitive.unique().tolist()
    for k in present:
        yield k, slice(None) if len(present) == 1 else (primitive == k).nonzero().squeeze(-1)


class HDRILPolicy(PreTrainedPolicy):
    """Hierarchical deep relational imitation learning.

    A state s (S,) is ``observation.state`` and ``observation.environment_state`` side by side. At every frame the
    planner turns s_0 … s_t into a distribution over primitives. When a primitive is over, the most probable one is next,
    and its dynamics model predicts the actions that remain of it, see :func:`~lerobot_policy_hdril.player.advance`. With
    ``replan_every=2``, as by default, it predicts anew at every second frame of a primitive.

    Args:
        config: see :class:`HDRILConfig`.
        dataset_meta: the dataset to train on (LeRobot gives it when it trains). Without it, :meth:`forward` cannot run. It
            gives names and the room that a plan needs; what is learned comes from the episodes that training batches
            bring, see :mod:`lerobot_policy_hdril.fitting`.

    Raises:
        ValueError: no dataset and nothing learned before, or a dataset that does not fit.
    """

    # LeRobot declares both as None.
    config_class: Any = HDRILConfig
    name: Any = "hdril"

    def __init__(
        self,
        config: HDRILConfig,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: HDRILConfig = config
        self._demonstrations: Demonstrations | None = None
        self._begin_weights: Tensor | None = None
        if dataset_meta is not None:
            config.set_dataset_feature_metadata(dataset_meta.features)
            data = Demonstrations(
                dataset_meta, config.subtask_key, config.device or "cpu", config.filters, config.halved, config.forms
            )
            config.forms = [list(form) for form in data.forms]
            config.learn_primitives(data.primitives, data.longest)
            config.learn_replanning()
            self._demonstrations = data
            self._learned = LearnedEpisodes(data, read_origin(dataset_meta, data.digest), config.training_data)
        if not config.primitives:
            raise ValueError(
                "hdril learns its primitives from a dataset: train it with lerobot-train, or load a checkpoint"
            )
        self._build()
        self.reset()

    def _build(self) -> None:
        config = self.config
        names = [*config.state_names, *config.environment_names]
        state_dim, action_dim = len(names), len(config.action_names)
        config.check_replanning()
        self.capacity = config.capacity
        kinds = len(config.forms)
        models = kinds if config.per_primitive else 1
        fused = config.coordinates == "fused"
        self.stride = config.trained_replan_every if fused and config.trained_replan_every > 0 else self.capacity
        self.ahead = self.stride + config.plan_overlap
        self.dynamics = nn.ModuleList(
            PrimitiveDynamics(
                names,
                skip_columns=list(range(len(config.state_names), state_dim)) if config.skip else [],
                context_dim=0 if config.per_primitive else kinds,
                out_dim=action_dim + state_dim,
                steps=self.capacity,
                interaction=config.interaction,
                decoder=config.decoder,
                hidden_dim=config.hidden_dim,
                node_dim=config.node_dim,
                state_skip=config.state_skip and not fused,
                stride=max(config.trained_replan_every, 0),
                variational=config.latent == "variational",
                means=len(config.filters),
                residual=fused,
            )
            for _ in range(models)
        )
        self.planner = Planner(
            names,
            kinds,
            config.interaction,
            config.planner_hidden_dim,
            config.node_dim,
            steps=self.capacity if config.termination == "learned" else 0,
            scale=config.planner_scale,
            dropout=config.planner_dropout,
        )
        self.relational = None
        if config.coordinates == "relational":
            self.relational = RelationalCoordinates(names, config.environment_names, [*config.action_names, *names])
        self.hand_noise = None
        if config.hand_noise:
            self.hand_noise = HandNoise(config.state_names, config.action_names, config.hand_noise)
        self.frames = self.fused = None
        if fused:
            views = 1 + len(config.filters)
            frames = self.frames = ObjectFrames(
                names, config.environment_names, config.action_names, views, config.fourier_features
            )
            starts = -(-self.capacity // self.stride)
            self.fused = nn.ModuleList(FusedMaps(frames, starts, self.ahead) for _ in config.forms)
            self.register_buffer("feature_mean", torch.zeros(frames.dim))
            self.register_buffer("feature_std", torch.ones(frames.dim))
        for key, size in (("state", state_dim), ("output", action_dim + state_dim)):
            self.register_buffer(f"{key}_mean", torch.zeros(size))
            self.register_buffer(f"{key}_std", torch.ones(size))
        for key in ("shortest_length", "longest_length"):
            self.register_buffer(key, torch.zeros(kinds, dtype=torch.long), persistent=False)
        if config.primitive_lengths:
            self.set_lengths(config.primitive_lengths)
        primitive = torch.tensor([form[0] for form in config.forms])
        self.register_buffer("alike", primitive[:, None] == primitive, persistent=False)
        self._quaternions = torch.tensor(quaternion_groups(config.action_names), dtype=torch.long)
        weights = torch.cat([torch.ones(action_dim), torch.full((state_dim,), config.state_loss_weight)])
        self.register_buffer("loss_weights", weights / weights.sum(), persistent=False)

    state_mean: Tensor
    state_std: Tensor
    output_mean: Tensor
    output_std: Tensor
    shortest_length: Tensor
    longest_length: Tensor
    alike: Tensor
    loss_weights: Tensor
    feature_mean: Tensor
    feature_std: Tensor

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        **kwargs: Any,
    ) -> HDRILPolicy:
        """A checkpoint, in evaluation mode.

        Args:
            pretrained_name_or_path: folder, or repository of the Hub.
            config: the checkpoint's config with other values for what may change, see
                :data:`~lerobot_policy_hdril.overrides.CHANGEABLE`.
            kwargs: as LeRobot's.

        Raises:
            FileNotFoundError: there is no such checkpoint.
            ValueError: the config changes what the weights have fixed, or the weights are damaged or those of another model.
        """
        if config is not None:
            hub = {key: value for key, value in kwargs.items() if key in _HUB_OPTIONS}
            saved = PreTrainedConfig.from_pretrained(pretrained_name_or_path, **hub)
            check_overrides(cast(HDRILConfig, config), cast(HDRILConfig, saved), str(pretrained_name_or_path))
        return super().from_pretrained(pretrained_name_or_path, config=config, **kwargs)

    @classmethod
    def _load_as_safetensor[T: PreTrainedPolicy](cls, model: T, model_file: str, map_location: str, strict: bool) -> T:
        # Strict in any case: LeRobot asks for strict=False, and would go on with random weights.
        load_weights(model, Path(model_file), resolve_safetensors_device(map_location))
        return model

    def set_lengths(self, lengths: list[list[int]]) -> None:
        """Keep the shortest and longest run of each primitive, frames; 0 for one that was never learned from."""
        self.config.primitive_lengths = lengths
        for column, buffer in enumerate((self.shortest_length, self.longest_length)):
            buffer.copy_(torch.tensor([run[column] for run in lengths]))

    def get_optim_params(self) -> Any:
        """All parameters, in one group: LeRobot declares a dict, and takes whatever PyTorch's optimisers take."""
        return self.parameters()

    # ------------------------------------------------------------------ training

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of the frames ``batch["index"]`` (B,), for the windows and episodes that they belong to.

        Mean squared error of the normalised actions and states, plus cross-entropy of the planner at every frame of
        ``planner_batch_size`` episodes and at the windows' first frames alone. Planner and dynamics have no parameter in
        common: one run trains what the paper trains apart.

        In training mode, and where gradients are computed, the episodes of the frames are learned from. LeRobot computes
        the loss of held-out episodes in evaluation mode, and that fits nothing.

        Raises:
            RuntimeError: the policy was made without a dataset, or is to be evaluated before it was trained.
            FloatingPointError: the loss is not finite.
        """
        if self._demonstrations is None:
            raise RuntimeError("this policy was loaded without a dataset: train it with lerobot-train")
        rows = self._demonstrations.rows(batch["index"].flatten())
        if self.training and torch.is_grad_enabled():
            self._learn_from(self._demonstrations, rows)
        self._check_learned()
        window = self._demonstrations.window(rows, self.config.trained_replan_every, self.ahead)
        generator = self._generator_of(rows)
        dynamics_loss, divergence = self.dynamics_loss(window, generator)
        history = self._demonstrations.history(rows[: self.config.planner_batch_size])
        planner_loss, accuracy = self.planner_loss(history, window, generator)
        loss = dynamics_loss + planner_loss
        if self.config.kl_weight:
            loss = loss + self.config.kl_weight * divergence
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"the loss is not finite (dynamics {dynamics_loss.item()}, planner {planner_loss.item()}); "
                "try a lower policy.optimizer_lr"
            )
        return loss, {
            "dynamics_loss": dynamics_loss.item(),
            "latent_divergence": divergence.item(),
            "planner_loss": planner_loss.item(),
            "planner_accuracy": accuracy,
        }

    def _learn_from(self, data: Demonstrations, rows: Tensor) -> None:
        """Take in the episodes of the rows, and fit anew if that is due. The config, which LeRobot saves, follows."""
        changed = self._learned.join(rows)
        if self._learned.fit_is_due():
            fit(self, data, self._learned.mask)
            self._learned.mark_fitted()
        if changed:
            self.config.training_data = self._learned.records()
        if self.config.planner_balance and (changed or self._begin_weights is None):
            counts = data.beginnings(self._learned.mask)
            self._begin_weights = begin_weights(counts, self.config.planner_balance)

    def _check_learned(self) -> None:
        if not self.config.primitive_lengths:
            raise RuntimeError("this policy has learned nothing yet: train it with lerobot-train")

    def _generator_of(self, rows: Tensor) -> torch.Generator | None:
        """What draws the noise of the hands, what the planner leaves out and what it is told late for a batch of these rows (B,);
        None where nothing is drawn.

        Seeded by the batch: a resumed run brings the same batches, but its new loader has drawn from PyTorch's own generator.
        """
        drawn = self.hand_noise is not None or self.config.planner_dropout or self.config.planner_late
        if not self.training or not drawn:
            return None
        return torch.Generator(rows.device).manual_seed(zlib.crc32(rows.cpu().numpy().tobytes()))

    def dynamics_loss(self, window: Window, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Mean squared error and mean divergence of the latent, nats; ``generator`` draws the noise of the hands."""
        seen = window.seen
        if self.hand_noise is not None and generator is not None:
            seen = self.hand_noise(seen, self.state_std, generator)
        predicted, divergence = self.predict(seen, window.primitive, window.elapsed)
        difference = predicted - self.target(window)
        if self.config.robust:  # as the linear maps' fit, it is not to follow what is far off
            error = F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none", beta=0.1)
        else:
            error = difference.square()
        error = error @ self.loss_weights  # (B, M)
        return (error * window.mask).sum() / window.mask.sum(), divergence.mean()

    def target(self, window: Window) -> Tensor:
        """Normalised actions and states (B, M, A + S) that the dynamics are to predict."""
        target = window.target
        if self.relational is not None:
            target = self.relational.encode_output(target, window.state)
        return (target - self.output_mean) / self.output_std

    def steps(self, elapsed: Tensor) -> Tensor:
        """Numbers (B, M) of the steps of a window that starts ``elapsed`` (B,) frames into its primitive."""
        ahead = torch.arange(self.ahead, device=elapsed.device)
        return (elapsed[:, None] + ahead).clamp_max(self.capacity - 1)

    def planner_loss(
        self, history: History, window: Window, generator: torch.Generator | None = None
    ) -> tuple[Tensor, float]:
        """Cross-entropy over all frames of the episodes, in which rare beginnings count more in training (``planner_balance``),
        and the share of frames at which the most probable answer is the right one; plus cross-entropy over the frames at which
        windows start, each seen without what was before it. That is all that :meth:`predict_action_chunk` has where no episode
        runs. With ``coordinates=fused``, where that raises, and ``termination=learned``, the planner is asked so where an episode
        begins, and nowhere else: of frames of a later primitive it is told that they are such, because the last of them may look
        like a first one. ``generator`` draws what the planner leaves out, and which beginnings it is told late
        (``planner_late``): in training, the numbers are of these episodes, and a late beginning counts at each of its frames."""
        if generator is not None and self.config.planner_late:
            history = history.late(self.config.planner_late, generator)
        told = (history.playing, history.elapsed) if self.planner.steps else (None, None)
        nothing = torch.zeros_like(window.primitive)[:, None]
        since = nothing if self.fused is None else torch.where(window.first[:, None], 0, self.planner.steps)
        alone_told = (nothing + len(self.config.forms), since) if self.planner.steps else (None, None)
        logits, _ = self.planner(self.normalise(history.state), history.state, None, *told, generator)
        alone, _ = self.planner(
            self.normalise(window.state)[:, None], window.state[:, None], None, *alone_told, generator
        )
        right, first = history.primitive, window.primitive
        if self.planner.steps:  # 0 is that the primitive goes on
            right, first = torch.where(history.begins, right + 1, 0), first + 1
        each = F.cross_entropy(logits[history.mask], right[history.mask], reduction="none")
        if self.training and self._begin_weights is not None:
            weights = self._begin_weights[history.playing, history.primitive].where(history.begins, 1.0)
            each = each * weights[history.mask]
        loss = each.mean() + F.cross_entropy(alone[:, 0], first)
        hits = (logits.argmax(-1) == right)[history.mask]
        return loss, hits.float().mean().item()

    # ------------------------------------------------------------------ prediction

    def normalise(self, state: Tensor) -> Tensor:
        """What the planner sees beside positions on a second scale: always the world's coordinates. Hands that hold an object
        are at rest in its frame. Their millimetres of error are many deviations there, and misled a planner that saw them."""
        return (state - self.state_mean) / self.state_std

    def dynamics_input(self, state: Tensor) -> Tensor:
        """What the dynamics see of states (..., S)."""
        if self.relational is None:
            return self.normalise(state)
        return (self.relational.encode_state(state) - self.relational.state_mean) / self.relational.state_std

    def linear_input(self, seen: Tensor) -> Tensor:
        """What the linear maps see of states and of the means of the last ones (B, 1 + W, S)."""
        return self.dynamics_input(seen).flatten(1)

    def features(self, seen: Tensor) -> tuple[Tensor, Origins]:
        """What the fused maps see of states and of the means of the last ones (B, 1 + W, S); and the origins of their frames."""
        assert self.frames is not None
        origins = self.frames.origins(seen)
        features = (self.frames.features(seen, origins) - self.feature_mean) / self.feature_std
        if self.frames.fourier is not None:
            features = torch.cat([features, self.frames.fourier(seen[:, -1])], dim=-1)
        return features, origins

    def _fused(self, seen: Tensor, primitive: Tensor, elapsed: Tensor) -> Tensor:
        """Normalised outputs (B, M, A + S) of the fused maps; 0 for the states, which they do not predict."""
        assert self.frames is not None
        assert self.fused is not None
        (features, origins), start = self.features(seen), torch.div(elapsed, self.stride, rounding_mode="floor")
        actions = len(self.config.action_names)
        output = seen.new_zeros(len(seen), self.ahead, len(self.loss_weights))
        for k, mine in _rows_by_primitive(primitive):
            action = self.fused[k](features[mine], start[mine], self.frames, origins[:, mine])
            output[mine, :, :actions] = (action - self.output_mean[:actions]) / self.output_std[:actions]
        return output

    def model_of(self, primitive: int) -> PrimitiveDynamics:
        """The dynamics model of a primitive."""
        return cast(PrimitiveDynamics, self.dynamics[primitive if self.config.per_primitive else 0])

    def predict(self, seen: Tensor, primitive: Tensor, elapsed: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised actions and states (B, M, A + S), and divergence of the latent (B,), nats, from raw states and the means of
        the last ones (B, 1 + W, S), ``elapsed`` (B,) frames into primitives (B,)."""
        if self.fused is None:
            return self._network(seen, primitive, elapsed)
        output = self._fused(seen, primitive, elapsed)
        if self.config.decoder == "linear":
            return output, output.new_zeros(len(output))
        rest, divergence = self._network(seen, primitive, elapsed)
        return output + rest, divergence

    def _network(self, seen: Tensor, primitive: Tensor, elapsed: Tensor) -> tuple[Tensor, Tensor]:
        state, samples = seen[:, 0], self.config.samples
        normalised = self.dynamics_input(state)
        linear = self.linear_input(seen) if self.fused is None else normalised  # which nothing reads then
        steps = self.steps(elapsed)
        if not self.config.per_primitive:
            context = F.one_hot(primitive, len(self.config.forms)).to(state.dtype)
            return self.model_of(0)(normalised, state, context, steps, linear, samples)
        if self._stacks(primitive):
            context = state.new_zeros(len(state), 0)
            models = [self.model_of(k) for k in range(len(self.config.forms))]
            return predict_stacked(models, normalised, state, context, steps, linear, primitive, samples)
        result = torch.empty(len(state), self.ahead, len(self.loss_weights), device=state.device, dtype=state.dtype)
        divergence, context = state.new_zeros(len(state)), state.new_zeros(len(state), 0)
        for k, mine in _rows_by_primitive(primitive):
            part, far = self.model_of(k)(
                normalised[mine], state[mine], context[mine], steps[mine], linear[mine], samples
            )
            if isinstance(mine, slice):
                return part, far
            result, divergence = result.index_copy(0, mine, part), divergence.index_copy(0, mine, far)
        return result, divergence

    def _stacks(self, primitive: Tensor) -> bool:
        """Whether to call the models of a batch as one. On a CPU the products take as long either way and padding costs
        more; elsewhere many small calls cost more."""
        if self.config.experts == "auto":
            if self.config.decoder != "gru" or primitive.device.type == "cpu":
                return False
            return bool((primitive != primitive[0]).any())
        return self.config.experts == "stacked"

    # ------------------------------------------------------------------ rollout

    def reset(self) -> None:
        """Forget the running episodes."""
        self._playback: PlaybackState | None = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action (B, A) for this frame. The running episodes go on by a frame.

        Raises:
            ValueError: an observation of another shape than the policy learned.
            RuntimeError: the policy was never trained.
        """
        self._playback = self._next(batch)
        return self._playback.row()[:, : len(self.config.action_names)]

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The actions (B, N, A) from this frame to the end of the plan. Raises as :meth:`select_action`.

        Nothing is remembered: the first action is the one that :meth:`select_action` would give, and the running episodes
        stay where they are. Where no episode runs, as on LeRobot's asynchronous server, which asks for a chunk, plays it and
        asks again, the frame counts as the first of a primitive, and the planner chooses that from this frame alone. So let
        the server play whole chunks (``actions_per_chunk`` at least the longest primitive, ``chunk_size_threshold`` 0).

        N is what remains of the longest form of the primitive; where the rows of a batch differ, shorter ones repeat their
        last action.

        With ``coordinates=fused`` N is ``replan_every`` + ``plan_overlap`` at most, and an episode must run: such a plan ends
        before the primitive does, and alone could only ever begin it. Its last ``plan_overlap`` actions have not faded yet.

        Raises:
            RuntimeError: no episode runs, and ``coordinates=fused``.
        """
        if self.fused is not None and self._playback is None:
            raise RuntimeError(
                "with policy.coordinates=fused, predict_action_chunk tells the next actions of an episode that select_action "
                "plays, and none runs; for chunks alone, as LeRobot's asynchronous server wants them, train policy.preset=hdril"
            )
        rest = self._next(batch).rest(self.longest_length)
        return rest[..., : len(self.config.action_names)]

    def _next(self, batch: dict[str, Tensor]) -> PlaybackState:
        self._check_learned()
        if self.training:  # walking all modules costs as much as the planner
            self.eval()
        return advance(self, self._playback, self._state(batch))

    def _state(self, batch: dict[str, Tensor]) -> Tensor:
        parts = []
        for key, names in ((OBS_STATE, self.config.state_names), (OBS_ENV_STATE, self.config.environment_names)):
            if key not in batch or batch[key].shape[-1] != len(names):
                shape = tuple(batch[key].shape) if key in batch else "nothing"
                raise ValueError(
                    f"the policy learned {key} as {len(names)} numbers ({', '.join(names)}), but was given {shape}; "
                    "is the environment of another task?"
                )
            parts.append(batch[key].flatten(0, -2))
        return torch.cat(parts, dim=-1)

    def choose(self, state: Tensor, previous: PlaybackState | None) -> Choice:
        """What the planner says of states (B, S) that follow the frames of ``previous``. A primitive that was never learned
        from has probability 0."""
        told: tuple[Tensor, ...] = ()
        if self.planner.steps:
            nothing = torch.zeros(len(state), dtype=torch.long, device=state.device)
            playing = nothing + len(self.config.forms) if previous is None else previous.primitive
            elapsed = nothing if previous is None else previous.elapsed + 1
            told = playing[:, None], elapsed[:, None]
        memory = None if previous is None else previous.memory
        logits, updated = self.planner(self.normalise(state)[:, None], state[:, None], memory, *told)
        never = self.longest_length == 0
        if not self.planner.steps:
            return Choice(logits[:, 0].masked_fill(never, -torch.inf).softmax(-1), None, updated)
        answers = logits[:, 0].masked_fill(F.pad(never, (1, 0)), -torch.inf)
        if previous is None:
            answers = torch.cat([torch.full_like(answers[:, :1], -torch.inf), answers[:, 1:]], dim=-1)
        answers = answers.softmax(-1)
        return Choice(answers[:, 1:], answers[:, 0], updated)

    def plan(self, seen: Tensor, primitive: Tensor, elapsed: Tensor) -> Tensor:
        """Actions and states (B, M, A + S) of the rest of primitives (B,), ``elapsed`` (B,) frames into them; metres, unit
        quaternions, in the world's frame. ``seen`` (B, 1 + W, S) is the state, and the means of the last ones."""
        predicted, _ = self.predict(seen, primitive, elapsed)
        plan = predicted * self.output_std + self.output_mean
        if self.relational is not None:
            plan = self.relational.decode_output(plan, seen[:, 0])
        if len(self._quaternions):
            plan[..., self._quaternions] = unit(plan[..., self._quaternions])
        return plan

    def fade(self, old: Tensor, new: Tensor, share: Tensor) -> Tensor:
        """Between rows of two plans (B, M, A + S) for the same frames: ``share`` (M, 1) of ``new``, and the rest of ``old``."""
        between = old.lerp(new, share)
        if len(self._quaternions):
            start, end = old[..., self._quaternions], new[..., self._quaternions]
            between[..., self._quaternions] = unit(towards(start, end).lerp(end, share[..., None]))
        return between

    # ------------------------------------------------------------------ what it tells of itself

    def explain(self, row: int = 0) -> Explanation | None:
        """What the episode in this row of the batch is about, at the frame of its last action; None before the first."""
        return None if self._playback is None else explain(self, self._playback, row)

    def attention(self) -> Attention:
        """The attention weights at the frame of the last action, for the state that was seen there.

        Raises:
            RuntimeError: no episode is running.
        """
        if self._playback is None:
            raise RuntimeError("no episode is running: attention is read after an action")
        return attend(self, self._playback)

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card that ``lerobot-train --policy.push_to_hub=true`` publishes, see :mod:`lerobot_policy_hdril.card`."""
        return model_card(self.config, dataset_repo_id, license, tags, cfg, dataset_meta)
