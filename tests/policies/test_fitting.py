"""What is fitted comes from the episodes that training batches bring, and from nothing else."""

from __future__ import annotations

import copy as copying
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.fitting import QUIET, LearnedEpisodes
from lerobot_policy_hdril.provenance import Origin, TrainingData, digest_of_json, from_runs, read_told, to_runs
from torch.utils.data import DataLoader, Dataset

from tests.policies.tools import (
    FRAMES,
    Training,
    assert_same,
    build,
    demonstrations,
    edit,
    observation,
    read,
    tensors,
)

CHOSEN = [0, 2, 3, 5]


class Wrapped(Dataset):
    """A dataset around a dataset, which tells nothing of its choice of episodes."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, item: int) -> dict[str, torch.Tensor]:
        return {"index": self.inner[item]["index"]}


LOADERS = {
    "plain": lambda dataset: dataset,
    "wrapped": Wrapped,
    "copied": copying.deepcopy,
}


def batches(dataset: LeRobotDataset | Wrapped, size: int = 16) -> Iterator[torch.Tensor]:
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))
    for batch in DataLoader(dataset, batch_size=size, sampler=order.tolist()):
        yield batch["index"]


def train(root: Path, episodes: list[int] | None, wrap: str = "plain", steps: int = 4, **values: Any) -> HDRILPolicy:
    dataset = LeRobotDataset("hdril/test", root=root, episodes=episodes)
    training = Training(build(dataset.meta, learned=False, **values))
    for _, index in zip(range(steps), batches(LOADERS[wrap](dataset)), strict=False):
        training.step(index)
    return training.policy


def everything(policy: HDRILPolicy) -> tuple[dict[str, torch.Tensor], dict]:
    """Weights, buffers, and the config without the name of the whole dataset's content."""
    config = asdict(policy.config)
    for record in config["training_data"]:
        del record["digest"]
    return tensors(policy), config


def change_all_of(root: Path, episodes: list[int]) -> None:
    """Other states, other actions, and labels whose runs have other lengths (no longer than the longest there is)."""

    def other(episode: int, frame: int, value: list) -> list:
        return [3.0 * x + 0.1 * frame + 1.0 for x in value] if episode in episodes else value

    for key in ("observation.state", "observation.environment_state", "action"):
        edit(root, key, other)
    bounds = [7, 13, 25, 37, 49, 61]
    edit(
        root,
        "subtask_index",
        lambda episode, frame, value: (
            int(np.searchsorted(bounds, frame, "right")) % 6 if episode in episodes else value
        ),
    )


@pytest.mark.parametrize(
    ("wrap", "values"), [*((wrap, {}) for wrap in LOADERS), ("plain", {"coordinates": "relational"})]
)
def test_left_out_episodes_change_nothing(wrap: str, values: dict, copy: Path) -> None:
    """Weights, buffers and config after training are the same bits, whatever is in the other episodes."""
    before = everything(train(copy, CHOSEN, wrap, **values))
    whole = train(copy, None, **values)
    change_all_of(copy, [1, 4])
    after = everything(train(copy, CHOSEN, wrap, **values))
    assert_same(before[0], after[0])
    assert before[1] == after[1]
    # The change would show if they were used.
    changed = train(copy, None, **values)
    assert not torch.equal(changed.state_mean, whole.state_mean)
    assert changed.config.primitive_lengths != whole.config.primitive_lengths


@pytest.mark.parametrize("how", ["evaluation mode", "no gradient"])
def test_loss_of_held_out_episodes_fits_nothing(how: str, metadata) -> None:
    policy = build(metadata, learned=False)
    policy.forward({"index": torch.arange(0, 2 * FRAMES)})
    before = everything(policy)
    if how == "evaluation mode":
        policy.eval()
        loss, _ = policy.forward({"index": torch.arange(3 * FRAMES, 4 * FRAMES)})
    else:
        with torch.no_grad():
            loss, _ = policy.forward({"index": torch.arange(3 * FRAMES, 4 * FRAMES)})
    assert torch.isfinite(loss)
    assert_same(everything(policy)[0], before[0])
    assert everything(policy)[1] == before[1]


def test_statistics_are_those_of_the_episodes_seen(metadata) -> None:
    policy = build(metadata, learned=False)
    policy.forward({"index": torch.tensor([5, 2 * FRAMES + 9])})
    data = pd.read_parquet(Path(metadata.root) / "data")
    data = data[data["episode_index"].isin([0, 2])]
    state, objects, action = (
        np.stack(list(data[key])).astype(np.float64)
        for key in ("observation.state", "observation.environment_state", "action")
    )
    seen = np.concatenate([state, objects], axis=1)
    np.testing.assert_allclose(policy.state_mean, seen.mean(0), atol=1e-6)
    np.testing.assert_allclose(policy.state_std, np.maximum(seen.std(0), policy.config.min_std), atol=1e-6)
    np.testing.assert_allclose(policy.output_mean[:16], action.mean(0), atol=1e-6)
    np.testing.assert_allclose(policy.output_std[:16], np.maximum(action.std(0), policy.config.min_std), atol=1e-6)


def test_fit_depends_on_the_set_of_episodes_alone(metadata) -> None:
    orders = [[0, 3, 1], [1, 0, 3], [3, 1, 0]]
    fitted = []
    for order in orders:
        policy = build(metadata, learned=False, state_skip=True)
        for episode in [*order, *order[:1] * QUIET]:  # the fit follows the last one when no more come
            policy.forward({"index": torch.tensor([FRAMES * episode])})
        fitted.append(dict(policy.named_buffers()))
    assert_same(fitted[0], fitted[1])
    assert_same(fitted[0], fitted[2])


def a_hundred_episodes(known: list[TrainingData]) -> LearnedEpisodes:
    frames = torch.arange(100)
    stub: Any = SimpleNamespace(episode=frames, index=frames, episode_index=frames.tolist())
    return LearnedEpisodes(stub, Origin("digest", "hdril/test"), known)


def test_fit_follows_when_as_many_are_new_or_no_more_come() -> None:
    learned = a_hundred_episodes([])
    assert learned.join(torch.arange(32))
    assert learned.fit_is_due()
    learned.mark_fitted()
    assert learned.join(torch.arange(30, 63))
    assert not learned.fit_is_due()
    learned.join(torch.arange(63, 64))
    assert learned.fit_is_due()
    learned.mark_fitted()
    learned.join(torch.tensor([99]))
    for _ in range(QUIET - 1):
        assert not learned.fit_is_due()
        learned.join(torch.tensor([0]))
        # A resumed run counts on.
        learned = a_hundred_episodes(learned.records())
    assert not learned.fit_is_due()
    learned.join(torch.tensor([0]))
    assert learned.fit_is_due()
    learned.mark_fitted()
    assert not learned.join(torch.tensor([0]))
    assert not learned.fit_is_due()
    assert learned.records()[0].fitted == 65


def test_the_last_episode_of_all_is_fitted_too() -> None:
    """It is one of a hundred, and there is none to wait for."""
    learned = a_hundred_episodes([])
    learned.join(torch.arange(98))
    learned.mark_fitted()
    learned.join(torch.tensor([98]))
    assert not learned.fit_is_due()
    learned.join(torch.tensor([99]))
    assert learned.fit_is_due()
    learned.mark_fitted()
    assert not learned.join(torch.tensor([0]))
    assert learned.records()[0].fitted == 100


def test_record_of_what_was_learned(metadata, tmp_path: Path) -> None:
    policy = build(metadata, learned=False)
    policy.forward({"index": torch.tensor([0, FRAMES, 4 * FRAMES])})
    recipe = json.loads((Path(metadata.root) / "meta/hdril.json").read_text())["recipe"]
    (record,) = policy.config.training_data
    assert record == TrainingData(
        digest=demonstrations(policy).digest,
        repo_id="hdril/test",
        task="table_lift",
        recipe=digest_of_json(recipe),
        episodes=((0, 1), (4, 4)),
        seeds=((0, 1), (4, 4)),
        fitted=3,
    )
    policy.save_pretrained(tmp_path / "policy")
    policy.config.save_pretrained(tmp_path / "config")
    for name in ("policy", "config"):
        saved = json.loads((tmp_path / name / "config.json").read_text())["training_data"]
        assert saved[0]["episodes"] == [[0, 1], [4, 4]]
        assert HDRILConfig.from_pretrained(tmp_path / name).training_data == [record]


def test_seeds_are_those_of_the_episodes_or_unknown(copy: Path) -> None:
    path = copy / "meta/hdril.json"
    told = json.loads(path.read_text())
    path.write_text(json.dumps(told | {"seeds": [7, 9, 8, 40, 41, 43]}))
    policy = build(read(copy), learned=False)
    policy.forward({"index": torch.tensor([FRAMES, 2 * FRAMES, 3 * FRAMES])})
    assert policy.config.training_data[0].seeds == ((8, 9), (40, 40))
    path.write_text(json.dumps(told | {"seeds": [7, 9]}))  # of other episodes
    assert build(read(copy)).config.training_data[0].seeds is None
    path.unlink()
    record = build(read(copy)).config.training_data[0]
    assert (record.task, record.recipe, record.seeds) == (None, None, None)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not valid JSON"),
        ("[]", "must hold a JSON object, not list"),
        ('{"recipe": "mine"}', "recipe must be an object, not str"),
        ('{"seeds": 6}', "seeds must be a list of integers"),
        ('{"seeds": ["6"]}', "seeds must be a list of integers"),
    ],
)
def test_damaged_provenance_is_named(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "meta/hdril.json"
    path.parent.mkdir()
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_told(tmp_path)
    assert str(path) in str(caught.value)


def test_runs() -> None:
    assert to_runs([5, 1, 0, 2, 5]) == ((0, 2), (5, 5))
    assert to_runs([]) == ()
    assert from_runs(((0, 2), (5, 5))) == [0, 1, 2, 5]


def test_digest_is_of_the_content(copy: Path, metadata) -> None:
    digest = demonstrations(build(metadata)).digest
    (file,) = (copy / "data").glob("*/*.parquet")
    table = pq.read_table(file)
    pq.write_table(table.slice(0, 100), file.with_name("file-001.parquet"), row_group_size=7)
    pq.write_table(table.slice(100), file)
    assert demonstrations(build(read(copy))).digest == digest
    edit(copy, "action", lambda episode, frame, value: [*value[:-1], value[-1] + 1e-3 * (frame == 9)])
    assert demonstrations(build(read(copy))).digest != digest


def test_primitive_that_no_episode_shows_is_never_played(copy: Path) -> None:
    """Its length is unknown and nothing was learned of it: the planner's preference for it does not count."""
    edit(copy, "subtask_index", lambda episode, frame, label: label if episode == 5 or label < 5 else 4)
    metadata = read(copy)
    policy = build(metadata, learned=False)
    policy.forward({"index": torch.arange(0, 5 * FRAMES, 10)})
    assert policy.config.primitive_lengths[5] == [0, 0]
    loss, _ = policy.eval().forward({"index": torch.arange(5 * FRAMES, 6 * FRAMES)})
    assert torch.isfinite(loss)
    with torch.no_grad():
        policy.planner.head[-1].bias[5] = 1e3
    for t in range(15):
        policy.select_action(observation(metadata, [t]))
        told = policy.explain()
        assert told is not None
        assert told.probabilities[policy.config.primitives[5]] == 0.0
        assert told.primitive != policy.config.primitives[5]
    for _ in range(1 + QUIET):
        policy.train().forward({"index": torch.tensor([5 * FRAMES])})
    assert policy.config.primitive_lengths[5] == [12, 12]


def test_policy_that_has_learned_nothing_says_so(metadata) -> None:
    policy = build(metadata, learned=False).eval()
    with pytest.raises(RuntimeError, match="learned nothing yet"):
        policy.select_action(observation(metadata, [0]))
    with pytest.raises(RuntimeError, match="learned nothing yet"):
        policy.forward({"index": torch.tensor([0])})


def test_fine_tuning_on_other_data_keeps_the_fit(metadata, copy: Path, tmp_path: Path) -> None:
    policy = build(metadata)
    policy.save_pretrained(tmp_path / "checkpoint")
    edit(copy, "action", lambda episode, frame, value: [x + 0.5 for x in value])
    config = HDRILConfig.from_pretrained(tmp_path / "checkpoint")
    config.pretrained_path = tmp_path / "checkpoint"
    tuned = make_policy(config, ds_meta=read(copy))
    assert isinstance(tuned, HDRILPolicy)
    tuned.train().forward({"index": torch.tensor([FRAMES])})
    assert_same(tensors(tuned), tensors(policy))
    first, second = tuned.config.training_data
    assert first == policy.config.training_data[0]
    assert (second.episodes, second.fitted) == (((1, 1),), 0)
    assert second.digest == demonstrations(tuned).digest != first.digest
    # Back to the first data set: its record is found again, and the list keeps its order.
    tuned.save_pretrained(tmp_path / "tuned")
    config = HDRILConfig.from_pretrained(tmp_path / "tuned")
    config.pretrained_path = tmp_path / "tuned"
    back = make_policy(config, ds_meta=metadata)
    back.train().forward({"index": torch.tensor([0])})
    assert back.config.training_data == [first, second]


def test_frames_that_the_files_do_not_have(metadata) -> None:
    with pytest.raises(ValueError, match="does not have"):
        build(metadata, learned=False).forward({"index": torch.tensor([10_000])})


def test_processes_that_train_together_learn_from_the_batches_of_all(metadata, monkeypatch: pytest.MonkeyPatch) -> None:
    def all_reduce(mask: torch.Tensor, op: object) -> None:
        assert op == torch.distributed.ReduceOp.MAX
        mask[3] = 1  # what the other process's batch holds

    alone = build(metadata, learned=False)
    alone.forward({"index": torch.tensor([0, 3 * FRAMES])})
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "all_reduce", all_reduce)
    one_of_two = build(metadata, learned=False)
    one_of_two.forward({"index": torch.tensor([0])})
    assert one_of_two.config.training_data == alone.config.training_data
    assert_same(dict(one_of_two.named_buffers()), dict(alone.named_buffers()))
