"""HDR-IL as a LeRobot policy: plan the next primitive, predict its trajectory, look again (paper, Section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_hdril.card import model_card
from lerobot_policy_hdril.configuration_hdril import HDRILConfig
from lerobot_policy_hdril.coordinates import RelationalCoordinates
from lerobot_policy_hdril.demonstrations import Demonstrations, History, Window, selected_episodes
from lerobot_policy_hdril.dynamics import PrimitiveDynamics, predict_stacked
from lerobot_policy_hdril.graph import group_nodes, quaternion_groups
from lerobot_policy_hdril.planner import Planner

if TYPE_CHECKING:
    from huggingface_hub import ModelCard
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


@dataclass(frozen=True)
class Attention:
    """Who attends to whom, for B episodes: row u of a matrix says how much node u takes from each node, and sums to 1."""

    nodes: list[str]
    primitives: list[str]  # (B,), what each episode plays
    planner: Tensor  # (B, N, N)
    dynamics: Tensor  # (B, N, N), of the model of the primitive that plays

    def received(self) -> dict[str, Tensor]:
        """For every hand and object, the share (B,) of the dynamics model's attention that goes to it, mean over all
        nodes; the shares sum to 1."""
        return {
            name: self.dynamics[:, :, columns].sum(-1).mean(-1) for name, columns in group_nodes(self.nodes).items()
        }


@dataclass
class Rollout:
    """Where B running episodes are. ``plan`` (B, M, A + S) starts at frame ``plan_start`` (B,) of the primitive."""

    primitive: Tensor  # (B,), -1 before the first
    elapsed: Tensor  # (B,), frames of the primitive that are over
    plan: Tensor
    plan_start: Tensor
    replanned: Tensor  # (B,), whether the last step made a new plan
    probabilities: Tensor  # (B, K), of the last step
    seen: Tensor  # (B, S), the state of the last step: observed, or predicted in an open loop
    memory: Tensor | None = None

    @staticmethod
    def begin(state: Tensor, steps: int, width: int, primitives: int) -> Rollout:
        batch, device = len(state), state.device
        whole = torch.zeros(batch, dtype=torch.long, device=device)
        return Rollout(
            primitive=whole - 1,
            elapsed=whole.clone(),
            plan=torch.zeros(batch, steps, width, device=device),
            plan_start=whole.clone(),
            replanned=whole.bool(),
            probabilities=torch.zeros(batch, primitives, device=device),
            seen=state,
        )


class HDRILPolicy(PreTrainedPolicy):
    """Hierarchical deep relational imitation learning.

    A state s (S,) is ``observation.state`` and ``observation.environment_state`` side by side. At every frame the
    planner turns s_0 … s_t into a distribution over primitives. When a primitive is over, the most probable one is next,
    and its dynamics model predicts the actions that remain of it. A primitive is over after its longest recorded length,
    or from its shortest on as soon as the planner prefers another; the planner may prefer the same one again.

    Args:
        config: see :class:`HDRILConfig`.
        dataset_meta: the dataset to train on (LeRobot gives it when it trains). Without it, :meth:`forward` cannot run. Of
            a ``LeRobotDataset`` with chosen episodes, these alone decide normalisation, lengths and linear maps.

    Raises:
        ValueError: no dataset and nothing learned before, or a dataset that does not fit.
    """

    config_class = HDRILConfig  # pyright: ignore
    name = "hdril"  # pyright: ignore

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
        if dataset_meta is not None:
            config.set_dataset_feature_metadata(dataset_meta.features)
            chosen = selected_episodes(dataset_meta)
            self._demonstrations = Demonstrations(dataset_meta, config.subtask_key, config.device or "cpu", chosen)
            config.learn_primitives(self._demonstrations.primitives, self._demonstrations.lengths)
            config.learn_replanning()
        if not config.primitives:
            raise ValueError(
                "hdril learns its primitives from a dataset: train it with lerobot-train, or load a checkpoint"
            )
        self._build()
        if self._demonstrations is not None:
            self._fit_normalisation(self._demonstrations)
            if config.state_skip:
                self._fit_state_skips(self._demonstrations)
        self.reset()

    def _build(self) -> None:
        config = self.config
        names = [*config.state_names, *config.environment_names]
        state_dim, action_dim = len(names), len(config.action_names)
        config.check_replanning()
        self.longest = max(longest for _, longest in config.primitive_lengths)
        models = len(config.primitives) if config.per_primitive else 1
        self.dynamics = nn.ModuleList(
            PrimitiveDynamics(
                names,
                skip_columns=list(range(len(config.state_names), state_dim)) if config.skip else [],
                context_dim=0 if config.per_primitive else len(config.primitives),
                out_dim=action_dim + state_dim,
                steps=self.longest,
                interaction=config.interaction,
                decoder=config.decoder,
                hidden_dim=config.hidden_dim,
                node_dim=config.node_dim,
                state_skip=config.state_skip,
                stride=max(config.trained_replan_every, 0),
                variational=config.latent == "variational",
            )
            for _ in range(models)
        )
        self.planner = Planner(
            names, len(config.primitives), config.interaction, config.planner_hidden_dim, config.node_dim
        )
        self.relational = None
        if config.coordinates == "relational":
            self.relational = RelationalCoordinates(names, config.environment_names, [*config.action_names, *names])
        for key, size in (("state", state_dim), ("output", action_dim + state_dim)):
            self.register_buffer(f"{key}_mean", torch.zeros(size))
            self.register_buffer(f"{key}_std", torch.ones(size))
        lengths = torch.tensor(config.primitive_lengths)
        self.register_buffer("shortest_length", lengths[:, 0].contiguous(), persistent=False)
        self.register_buffer("longest_length", lengths[:, 1].contiguous(), persistent=False)
        self._quaternions = torch.tensor(quaternion_groups(config.action_names), dtype=torch.long)
        weights = torch.cat([torch.ones(action_dim), torch.full((state_dim,), config.state_loss_weight)])
        self.register_buffer("loss_weights", weights / weights.sum(), persistent=False)

    state_mean: Tensor
    state_std: Tensor
    output_mean: Tensor
    output_std: Tensor
    shortest_length: Tensor
    longest_length: Tensor
    loss_weights: Tensor

    @torch.no_grad()
    def _fit_normalisation(self, demonstrations: Demonstrations) -> None:
        """Mean and deviation of what the models see and predict. LeRobot's statistics are of all episodes, also of those
        that are held out, and of absolute poses."""
        window = demonstrations.window(demonstrations.look_rows(0), 0, self.longest)
        state, output = demonstrations.state[demonstrations.learned], window.target
        parts = [(self, "state", state)]
        if self.relational is not None:
            parts.append((self.relational, "state", self.relational.encode_state(state)))
            output = self.relational.encode_output(output, window.state)
        parts.append((self, "output", output[window.mask]))
        for owner, name, values in parts:
            getattr(owner, f"{name}_mean").copy_(values.mean(0))
            getattr(owner, f"{name}_std").copy_(values.std(0, correction=0).clamp_min(self.config.min_std))

    def _fit_state_skips(self, demonstrations: Demonstrations) -> None:
        """Solve the linear maps on all windows that training can draw."""
        window = demonstrations.window(demonstrations.look_rows(self.config.trained_replan_every),
                                       self.config.trained_replan_every, self.longest)  # fmt: skip
        normalised, target, steps = (
            self._dynamics_input(window.state),
            self._target(window),
            self._steps(window.elapsed),
        )
        for k, model in enumerate(self.dynamics):
            mine = window.primitive == k if self.config.per_primitive else torch.ones_like(window.primitive).bool()
            model.state_skip.fit(normalised[mine], steps[mine], target[mine], window.mask[mine], self.config.ridge)  # pyright: ignore

    def get_optim_params(self) -> dict[str, Any]:
        """All parameters, in one group."""
        return self.parameters()  # pyright: ignore

    # ------------------------------------------------------------------ training

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of the frames ``batch["index"]`` (B,), for the windows and episodes that they belong to.

        Mean squared error of the normalised actions and states, plus cross-entropy of the planner at every frame of
        ``planner_batch_size`` episodes. The two have no parameter in common: one run trains what the paper trains apart.

        Raises:
            RuntimeError: the policy was made without a dataset.
            FloatingPointError: the loss is not finite.
        """
        if self._demonstrations is None:
            raise RuntimeError("this policy was loaded without a dataset: train it with lerobot-train")
        rows = self._demonstrations.rows(batch["index"].flatten())
        dynamics_loss, divergence = self._dynamics_loss(
            self._demonstrations.window(rows, self.config.trained_replan_every, self.longest)
        )
        planner_loss, accuracy = self._planner_loss(
            self._demonstrations.history(rows[: self.config.planner_batch_size])
        )
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

    def _dynamics_loss(self, window: Window) -> tuple[Tensor, Tensor]:
        """Mean squared error and mean divergence of the latent, nats."""
        predicted, divergence = self._predict(window.state, window.primitive, window.elapsed)
        error = (predicted - self._target(window)).square() @ self.loss_weights  # (B, M)
        return (error * window.mask).sum() / window.mask.sum(), divergence.mean()

    def _target(self, window: Window) -> Tensor:
        """Normalised actions and states (B, M, A + S) that the dynamics are to predict."""
        target = window.target
        if self.relational is not None:
            target = self.relational.encode_output(target, window.state)
        return (target - self.output_mean) / self.output_std

    def _steps(self, elapsed: Tensor) -> Tensor:
        """Numbers (B, M) of the steps of a window that starts ``elapsed`` (B,) frames into its primitive."""
        ahead = torch.arange(self.longest, device=elapsed.device)
        return (elapsed[:, None] + ahead).clamp_max(self.longest - 1)

    def _planner_loss(self, history: History) -> tuple[Tensor, float]:
        logits, _ = self.planner(self._normalise(history.state), history.state)
        loss = F.cross_entropy(logits[history.mask], history.primitive[history.mask])
        hits = (logits.argmax(-1) == history.primitive)[history.mask]
        return loss, hits.float().mean().item()

    def _normalise(self, state: Tensor) -> Tensor:
        """What the planner sees: always the world's coordinates. Hands that hold an object do not move in its frame; what
        they are beside the demonstrations there, in millimetres, is many deviations, and misleads it."""
        return (state - self.state_mean) / self.state_std

    def _dynamics_input(self, state: Tensor) -> Tensor:
        """What the dynamics see of states (..., S)."""
        if self.relational is None:
            return self._normalise(state)
        return (self.relational.encode_state(state) - self.relational.state_mean) / self.relational.state_std

    def _predict(self, state: Tensor, primitive: Tensor, elapsed: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised actions and states (B, M, A + S), and divergence of the latent (B,), nats, from raw states (B, S),
        ``elapsed`` (B,) frames into primitives."""
        normalised, samples = self._dynamics_input(state), self.config.samples
        steps = self._steps(elapsed)
        if not self.config.per_primitive:
            context = F.one_hot(primitive, len(self.config.primitives)).to(state.dtype)
            return self.dynamics[0](normalised, state, context, steps, samples)
        if self._stacks(primitive):
            context = state.new_zeros(len(state), 0)
            return predict_stacked(self.dynamics, normalised, state, context, steps, primitive, samples)  # pyright: ignore
        result = torch.empty(len(state), self.longest, len(self.loss_weights), device=state.device, dtype=state.dtype)
        divergence = state.new_zeros(len(state))
        for k in primitive.unique().tolist():
            mine = (primitive == k).nonzero().squeeze(-1)
            context = state.new_zeros(len(mine), 0)
            part, far = self.dynamics[k](normalised[mine], state[mine], context, steps[mine], samples)
            result, divergence = result.index_copy(0, mine, part), divergence.index_copy(0, mine, far)
        return result, divergence

    def _stacks(self, primitive: Tensor) -> bool:
        """Whether to call the models of a batch as one. On a CPU the products are as long either way and padding costs;
        elsewhere many small calls cost more."""
        if self.config.experts == "auto":
            if self.config.decoder == "ode" or primitive.device.type == "cpu":
                return False
            return bool((primitive != primitive[0]).any())
        return self.config.experts == "stacked"

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

    # ------------------------------------------------------------------ rollout

    def reset(self) -> None:
        """Forget the running episodes."""
        self._rollout: Rollout | None = None

    @property
    def rollout(self) -> Rollout | None:
        """Where the running episodes are: for viewers. None before the first action."""
        return self._rollout

    @torch.no_grad()
    def attention(self) -> Attention:
        """The attention weights at the last step, for the state that was seen there.

        Raises:
            RuntimeError: no episode is running.
        """
        if self._rollout is None:
            raise RuntimeError("no episode is running: attention is read after an action")
        seen, playing = self._rollout.seen, self._rollout.primitive.tolist()
        given = self._dynamics_input(seen)
        rows = [
            self.dynamics[k if self.config.per_primitive else 0].graph.attention(given[i : i + 1], seen[i : i + 1])
            for i, k in enumerate(playing)
        ]
        return Attention(
            nodes=list(self.planner.graph.node_names),
            primitives=[self.config.primitives[k] for k in playing],
            planner=self.planner.graph.attention(self._normalise(seen), seen),
            dynamics=torch.cat(rows),
        )

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Look at a frame, and give the actions (B, M, A) from it to the end of the plan, which the last one pads.

        Raises:
            ValueError: an observation of another shape than the policy learned.
        """
        if self.training:  # walking all modules costs as much as the planner
            self.eval()
        rollout = self._advance(self._state(batch))
        ahead = (rollout.elapsed - rollout.plan_start)[:, None] + torch.arange(self.longest, device=rollout.plan.device)
        chunk = rollout.plan[..., : len(self.config.action_names)]
        index = ahead.clamp_max(self.longest - 1)[..., None].expand(-1, -1, chunk.shape[-1])
        rollout.elapsed = rollout.elapsed + 1
        return chunk.gather(1, index)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action (B, A) for this frame. Raises as :meth:`predict_action_chunk`."""
        return self.predict_action_chunk(batch)[:, 0]

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

    def _advance(self, state: Tensor) -> Rollout:
        """Update the planner, end and begin primitives, and make the plans that are due."""
        config, rollout = self.config, self._rollout
        if rollout is None or len(rollout.primitive) != len(state):
            rollout = Rollout.begin(state, self.longest, len(self.loss_weights), len(config.primitives))
            self._rollout = rollout
        elif config.rollout == "open_loop":
            # The state that the plan predicted for this frame, whatever is seen.
            done = (rollout.elapsed - rollout.plan_start - 1)[:, None, None].expand(-1, 1, rollout.plan.shape[-1])
            state = rollout.plan.gather(1, done).squeeze(1)[:, len(config.action_names) :]
        rollout.seen = state
        logits, rollout.memory = self.planner(self._normalise(state)[:, None], state[:, None], rollout.memory)
        rollout.probabilities = logits[:, 0].softmax(-1)
        best = rollout.probabilities.argmax(-1)
        current = rollout.primitive.clamp_min(0)
        over = (rollout.primitive < 0) | (rollout.elapsed >= self.longest_length[current])
        over |= (rollout.elapsed >= self.shortest_length[current]) & (best != rollout.primitive)
        rollout.primitive = torch.where(over, best, rollout.primitive)
        rollout.elapsed = torch.where(over, 0, rollout.elapsed)
        rollout.replanned = over
        if config.replan_every:
            rollout.replanned = over | (rollout.elapsed % config.replan_every == 0)
        if rollout.replanned.any():
            due = rollout.replanned.nonzero().squeeze(-1)
            predicted, _ = self._predict(state[due], rollout.primitive[due], rollout.elapsed[due])
            plan = predicted * self.output_std + self.output_mean
            if self.relational is not None:
                plan = self.relational.decode_output(plan, state[due])
            rollout.plan[due] = self._unit_quaternions(plan)
            rollout.plan_start = torch.where(rollout.replanned, rollout.elapsed, rollout.plan_start)
        return rollout

    def _unit_quaternions(self, plan: Tensor) -> Tensor:
        if len(self._quaternions) == 0:
            return plan
        plan = plan.clone()
        plan[..., self._quaternions] = F.normalize(plan[..., self._quaternions], dim=-1)
        return plan
