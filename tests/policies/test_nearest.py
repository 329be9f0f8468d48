"""The nearest demonstration, replayed: from what training brought, exactly, and from nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import NearestConfig, NearestPolicy
from lerobot_policy_hdril.provenance import from_runs

from hdril.evaluation.checkpoint import find_checkpoint
from hdril.evaluation.held_out import check_held_out
from tests.evaluation.checkpoints import save_stock
from tests.policies.tools import FRAMES, observation


def learned(metadata: LeRobotDatasetMetadata, episodes: list[int]) -> NearestPolicy:
    """A policy whose training saw a frame of each of these episodes."""
    policy = make_policy(NearestConfig(device="cpu", push_to_hub=False), ds_meta=metadata)
    assert isinstance(policy, NearestPolicy)
    policy.train()
    for episode in episodes:
        loss, _ = policy.forward({"index": torch.tensor([FRAMES * episode + 3])})
        loss.backward()  # as LeRobot does
        assert loss.item() == 0.0
    assert int(policy.learned.sum()) == len(episodes)
    return policy.eval()


def recorded(metadata: LeRobotDatasetMetadata, episode: int) -> torch.Tensor:
    """(T, A) of an episode."""
    data = pd.concat(map(pd.read_parquet, sorted((Path(metadata.root) / "data").glob("*/*.parquet"))))
    return torch.from_numpy(np.stack(list(data[data["episode_index"] == episode]["action"])))


def test_the_demonstration_that_starts_there_is_replayed_to_its_end(metadata: LeRobotDatasetMetadata) -> None:
    policy = learned(metadata, [0, 1, 2, 3, 4, 5])
    episodes = [4, 1]
    first = observation(metadata, [FRAMES * episode for episode in episodes])
    actions = [policy.select_action(first)]
    blind = {key: torch.full_like(value, 9.0) for key, value in first.items()}  # what comes later is not looked at
    actions += [policy.select_action(blind) for _ in range(FRAMES + 4)]
    for row, episode in enumerate(episodes):
        played, expected = torch.stack(actions)[:, row], recorded(metadata, episode)
        assert torch.equal(played[:FRAMES], expected)
        assert torch.equal(played[FRAMES:], expected[-1].expand(5, -1)), "it stays at the end"
    policy.reset()
    chunk = policy.predict_action_chunk(first)
    assert torch.equal(chunk[0], recorded(metadata, 4))
    assert torch.equal(policy.select_action(first), chunk[:, 0]), "a chunk is stateless"
    assert torch.equal(policy.predict_action_chunk(blind), chunk[:, 1:])


def test_nearest_is_in_deviations_and_among_what_was_learned(metadata: LeRobotDatasetMetadata) -> None:
    policy = learned(metadata, [0, 2, 3])
    seen = observation(metadata, [FRAMES * episode for episode in range(6)])
    state = torch.cat(list(seen.values()), dim=-1)
    known = state[[0, 2, 3]]
    scale = known.std(0, correction=0)
    moves = scale > 1e-6
    apart = ((state[:, None] - known[None])[..., moves] / scale[moves]).norm(dim=-1)
    assert policy.nearest(state).tolist() == [[0, 2, 3][i] for i in apart.argmin(-1).tolist()]
    assert policy.nearest(state)[[0, 2, 3]].tolist() == [0, 2, 3]
    assert not policy.actions[[1, 4, 5]].any(), "held-out episodes are not looked at"
    assert from_runs(policy.config.training_data[0].episodes) == [0, 2, 3]


def test_a_number_that_hardly_varies_does_not_drown_the_others(metadata: LeRobotDatasetMetadata) -> None:
    """Forty demonstrations, and a quaternion's w that is 1 but for rounding: each is the nearest to itself."""
    policy = learned(metadata, [0])
    rng = torch.Generator().manual_seed(3)
    starts = 0.1 * torch.randn(40, policy.starts.shape[1], generator=rng)
    starts[:, 7] = 1.0 + 2e-6 * torch.randn(40, generator=rng)
    policy.starts, policy.learned = starts, torch.ones(40, dtype=torch.bool)
    assert policy.nearest(starts).tolist() == list(range(40))
    seen = starts + 0.02 * torch.randn(starts.shape, generator=rng)
    seen[:, 7] = starts[:, 7].flip(0)
    others = [i for i in range(starts.shape[1]) if i != 7]
    spread = starts[:, others].double().std(0, correction=0)
    apart = ((seen[:, None, others] - starts[:, others]).double() / spread).norm(dim=-1)
    assert policy.nearest(seen).tolist() == apart.argmin(-1).tolist()


def test_other_demonstrations_are_refused(metadata: LeRobotDatasetMetadata, varied: LeRobotDatasetMetadata) -> None:
    config = learned(metadata, [0]).config
    NearestPolicy(config, dataset_meta=metadata)
    with pytest.raises(ValueError, match="train it anew on other ones"):
        NearestPolicy(config, dataset_meta=varied)


def test_evaluation_mode_learns_nothing(metadata: LeRobotDatasetMetadata) -> None:
    policy = learned(metadata, [0])
    policy.forward({"index": torch.tensor([FRAMES])})
    policy.train()
    with torch.no_grad():
        policy.forward({"index": torch.tensor([FRAMES])})
    assert policy.learned.tolist() == [True] + 5 * [False]


def test_a_checkpoint_replays_the_same_and_knows_its_seeds(metadata: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    policy = learned(metadata, [1, 5])
    folder = save_stock(tmp_path / "nearest", policy, metadata, None)
    loaded = NearestPolicy.from_pretrained(folder)
    seen = observation(metadata, [FRAMES, 5 * FRAMES, 0])
    assert torch.equal(loaded.predict_action_chunk(seen), policy.predict_action_chunk(seen))
    with pytest.raises(RuntimeError, match="this policy was made without a dataset"):
        loaded.forward({"index": torch.tensor([0])})
    checkpoint = find_checkpoint(str(folder))
    assert check_held_out(checkpoint, "table_lift", [700_000]).known
    with pytest.raises(ValueError, match=r"1 of 1 seeds .* were in the training data, which are seeds 1 to 5"):
        check_held_out(checkpoint, "table_lift", [1])
    (folder / "model.safetensors").write_bytes(b"half")
    with pytest.raises(ValueError, match="is not a whole safetensors file"):
        NearestPolicy.from_pretrained(folder)


def test_without_demonstrations_it_says_so(metadata: LeRobotDatasetMetadata) -> None:
    policy = make_policy(NearestConfig(device="cpu", push_to_hub=False), ds_meta=metadata)
    with pytest.raises(RuntimeError, match="this policy has learned nothing yet"):
        policy.select_action(observation(metadata, [0]))
    config = NearestConfig(device="cpu", input_features=policy.config.input_features)
    config.output_features = policy.config.output_features
    with pytest.raises(ValueError, match="nearest replays demonstrations: train it with lerobot-train"):
        NearestPolicy(config)
    config.input_features = {}
    with pytest.raises(ValueError, match=r"nearest needs observation\.state"):
        NearestPolicy(config)
