"""HDR-IL as a LeRobot policy: every variant trains, saves, loads and runs; what does not fit is refused."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.common.train_utils import load_training_state, save_training_state
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.demonstrations import Demonstrations
from lerobot_policy_hdril.presets import PRESETS

SMALL = {
    "device": "cpu",
    "push_to_hub": False,
    "hidden_dim": 32,
    "node_dim": 8,
    "planner_hidden_dim": 16,
    "optimizer_lr": 1e-2,
}
VARIANTS = {name: {"preset": name} for name in PRESETS} | {
    "replanning": {"replan_every": 4},
    "ODE": {"decoder": "ode"},
    "variational": {"latent": "variational", "kl_weight": 1e-3},
    "relational": {"coordinates": "relational"},
}


@pytest.fixture(scope="module")
def metadata(dataset: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata("hdril/test", root=dataset)


def build(metadata: LeRobotDatasetMetadata, **values) -> HDRILPolicy:
    torch.manual_seed(0)
    return make_policy(HDRILConfig(**SMALL | values), ds_meta=metadata)  # pyright: ignore


def observation(metadata: LeRobotDatasetMetadata, frames: list[int]) -> dict[str, torch.Tensor]:
    data = pd.read_parquet(Path(metadata.root) / "data").iloc[frames]
    return {key: torch.tensor(list(data[key])) for key in ("observation.state", "observation.environment_state")}


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_learns_saves_loads_and_runs(variant: str, metadata, tmp_path: Path) -> None:
    policy = build(metadata, **VARIANTS[variant])
    batch = {"index": torch.arange(0, 420, 9)}
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    first, _ = policy.forward(batch)
    for _ in range(40):
        loss, info = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    assert loss.item() < 0.5 * first.item()
    assert set(info) == {"dynamics_loss", "latent_divergence", "planner_loss", "planner_accuracy"}
    assert (info["latent_divergence"] > 0) == (policy.config.latent == "variational")
    policy.save_pretrained(tmp_path / "checkpoint")
    loaded = HDRILPolicy.from_pretrained(tmp_path / "checkpoint")
    frames = [0, 70, 140]
    policy.eval()
    for t in range(25):
        seen = observation(metadata, [frame + t for frame in frames])
        together = policy.select_action(seen)
        torch.testing.assert_close(loaded.select_action(seen), together, atol=0, rtol=0)
        assert together.shape == (3, 16)
        for group in ([3, 4, 5, 6], [11, 12, 13, 14]):
            torch.testing.assert_close(together[:, group].norm(dim=-1), torch.ones(3))
    assert policy.rollout is not None
    torch.testing.assert_close(policy.rollout.probabilities.sum(-1), torch.ones(3))


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_resumes(variant: str, metadata, tmp_path: Path) -> None:
    """Four steps, and two, a checkpoint as LeRobot's trainer writes and reads it, and two: the same weights, bit for bit."""

    def prepare(policy: HDRILPolicy):
        policy.train()
        optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
        return policy, optimizer, policy.config.get_scheduler_preset().build(optimizer, 4)

    def train(policy: HDRILPolicy, optimizer, scheduler) -> None:
        for _ in range(2):
            policy.forward({"index": torch.arange(0, 420, 9)})[0].backward()
            optimizer.step()
            optimizer.zero_grad()
            scheduler.step()

    straight = prepare(build(metadata, **VARIANTS[variant]))
    train(*straight)
    straight[0].save_pretrained(tmp_path / "pretrained_model")
    save_training_state(tmp_path, 2, *straight[1:])
    saved = {name: value.clone() for name, value in straight[0].state_dict().items()}
    train(*straight)
    torch.manual_seed(7)
    config = HDRILConfig.from_pretrained(tmp_path / "pretrained_model")
    config.pretrained_path = tmp_path / "pretrained_model"
    resumed = prepare(make_policy(config, ds_meta=metadata))
    for name, value in resumed[0].state_dict().items():
        torch.testing.assert_close(value, saved[name], atol=0, rtol=0)
    assert load_training_state(tmp_path, *resumed[1:])[0] == 2
    train(*resumed)
    for name, value in resumed[0].state_dict().items():
        torch.testing.assert_close(value, straight[0].state_dict()[name], atol=0, rtol=0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_batched_and_single_give_the_same_actions(variant: str, metadata) -> None:
    policy = build(metadata, **VARIANTS[variant]).eval()
    frames = [0, 70, 140]
    together = [policy.select_action(observation(metadata, [frame + t for frame in frames])) for t in range(25)]
    for i, frame in enumerate(frames):
        policy.reset()
        for t in range(25):
            alone = policy.select_action(observation(metadata, [frame + t]))
            torch.testing.assert_close(alone[0], together[t][i], atol=1e-5, rtol=1e-4)


def test_attention_can_be_read_by_name_at_any_step(metadata) -> None:
    policy = build(metadata).eval()
    with pytest.raises(RuntimeError, match="no episode is running"):
        policy.attention()
    for t in range(12):
        policy.select_action(observation(metadata, [t, 70 + t]))
        attention = policy.attention()
        assert attention.nodes == ["left", "right", "table"]
        assert attention.primitives == [policy.config.primitives[k] for k in policy.rollout.primitive]  # pyright: ignore
        for weights in (attention.planner, attention.dynamics):
            assert weights.shape == (2, 3, 3)
            torch.testing.assert_close(weights.sum(-1), torch.ones(2, 3))
        received = attention.received()
        assert list(received) == ["left", "right", "table"]
        torch.testing.assert_close(torch.stack(list(received.values())).sum(0), torch.ones(2))


@pytest.mark.parametrize("preset", ["hdril", "hdril_paper", "res_multi_relational"])
def test_stacked_models_are_the_separate_ones(preset: str, metadata) -> None:
    """Same predictions with several primitives in the batch, same loss gradients, at the start and within primitives."""
    values = {"preset": preset, "replan_every": 4}
    separate, stacked = (build(metadata, experts=how, **values) for how in ("separate", "stacked"))
    with torch.no_grad():  # the head starts at zero where there are linear maps
        for policy in (separate, stacked):
            torch.manual_seed(1)
            for parameter in policy.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
    rows = torch.tensor([0, 3, 25, 15, 69, 70, 101, 140, 30, 31])
    gradients = []
    for policy in (separate.eval(), stacked.eval()):
        window = policy._demonstrations.window(rows, 4, 12)  # pyright: ignore
        predicted = policy._predict(window.state, window.primitive, window.elapsed)
        policy._dynamics_loss(window)[0].backward()
        gradients.append([*predicted, *(p.grad for p in policy.dynamics.parameters() if p.grad is not None)])
    assert len(gradients[0]) == len(gradients[1]) > 10
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_linear_maps_are_the_ridge_solution(metadata) -> None:
    """Without a penalty to speak of, they fit a linear relation exactly, from every frame at which a window starts."""
    policy = build(metadata, replan_every=5)
    maps = policy.dynamics[2].state_skip
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(200, 23, generator=generator)
    truth = torch.randn(39, 23, generator=generator)
    steps = torch.arange(12) + torch.tensor([0, 5, 10]).repeat(67)[:200, None]
    mask = steps < 12
    steps = steps.clamp_max(11)
    target = (states @ truth.T)[:, None] * (1.0 + steps[..., None]) + 3.0
    maps.fit(states, steps, target, mask, 1e-9)
    torch.testing.assert_close(maps(states, steps)[mask], target[mask], atol=1e-2, rtol=1e-3)
    maps.fit(states, steps, target, mask, 1e9)
    assert maps.weight.abs().max() < 1e-3
    policy.forward({"index": torch.arange(40)})[0].backward()
    assert all(".state_skip." not in name for name, _ in policy.named_parameters())


def test_latent_is_sampled_in_training_and_steady_afterwards(metadata) -> None:
    policy = build(metadata, latent="variational", samples=3, state_skip=False)
    rows = torch.tensor([0, 15])
    window = policy._demonstrations.window(rows, 0, 12)  # pyright: ignore

    def predict() -> torch.Tensor:
        return policy._predict(window.state, window.primitive, window.elapsed)[0]

    policy.train()
    assert not torch.equal(predict(), predict())
    policy.eval()
    sampled = predict()
    assert torch.equal(sampled, predict())
    policy.config.samples = 0
    mean = predict()
    assert torch.equal(mean, predict())
    assert not torch.allclose(mean, sampled)


def test_divergence_is_that_of_gaussians(metadata) -> None:
    from torch.distributions import Normal, kl_divergence

    policy = build(metadata, latent="variational", kl_weight=0.1)
    kept = {}
    model = policy.dynamics[0]
    model.latent.register_forward_hook(lambda module, args, out: kept.update(latent=out.detach()))
    window = policy._demonstrations.window(torch.tensor([0]), 0, 12)  # pyright: ignore
    _, divergence = policy._predict(window.state, window.primitive, window.elapsed)
    mean, log_variance = kept["latent"].chunk(2, dim=-1)
    expected = kl_divergence(Normal(mean, (0.5 * log_variance).exp()), Normal(0.0, 1.0)).sum(-1)
    torch.testing.assert_close(divergence, expected)
    free = policy.forward({"index": torch.arange(8)})[1]
    policy.config.kl_weight = 0.0
    torch.manual_seed(1)
    without = policy.forward({"index": torch.arange(8)})[0]
    policy.config.kl_weight = 0.1
    torch.manual_seed(1)
    with_it = policy.forward({"index": torch.arange(8)})[0]
    assert with_it.item() - without.item() == pytest.approx(0.1 * free["latent_divergence"], rel=1e-3)


def test_one_primitive_and_one_episode_and_a_batch_of_one(copy: Path) -> None:
    """K = 1: a dataset that labels everything with one primitive. Then one episode alone."""
    for file in (copy / "data").glob("*/*.parquet"):
        frame = pd.read_parquet(file)
        table = pq.read_table(file)
        label = pa.array([0] * len(frame), pa.int64())
        table = table.set_column(table.column_names.index("subtask_index"), "subtask_index", label)
        pq.write_table(table.filter(pc.equal(table["episode_index"], 0)), file)
    names = pd.DataFrame({"subtask_index": [0]}, index=pd.Index(["lift"], name="subtask"))
    names.to_parquet(copy / "meta/subtasks.parquet")
    policy = build(LeRobotDatasetMetadata("hdril/test", root=copy))
    assert policy.config.primitives == ["lift"]
    assert policy.config.primitive_lengths == [[70, 70]]
    loss, info = policy.forward({"index": torch.tensor([3])})
    loss.backward()
    assert torch.isfinite(loss)
    assert info["planner_accuracy"] == 1.0
    policy.eval()
    one = LeRobotDatasetMetadata("hdril/test", root=copy)
    actions = [policy.select_action(observation(one, [t])) for t in range(5)]
    assert all(action.shape == (1, 16) for action in actions)


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_is_what_its_name_says(preset: str) -> None:
    config = HDRILConfig(device="cpu", push_to_hub=False, preset=preset)
    for name, value in PRESETS[preset].items():
        assert getattr(config, name) == value
    assert (config.coordinates == "relational") == preset.endswith("_relational")
    assert config.per_primitive == ("multi" in preset or preset.startswith("hdril"))
    assert config.skip == (preset.startswith(("res", "hdril")))
    assert (config.interaction == "none") == preset.startswith(("gru_gru", "res_", "res_multi")) or preset == "res"


def test_preset_that_is_unknown_or_contradicted() -> None:
    with pytest.raises(ValueError, match=r"unknown policy\.preset 'gat'; choose from: gru_gru, res, "):
        HDRILConfig(device="cpu", push_to_hub=False, preset="gat")
    with pytest.raises(
        ValueError, match=r"policy\.preset=res makes policy\.interaction 'none', but 'scalar' was given"
    ):
        HDRILConfig(device="cpu", push_to_hub=False, preset="res", interaction="scalar")


def test_learns_names_and_primitives_from_the_dataset(metadata, tmp_path: Path) -> None:
    policy = build(metadata)
    policy.save_pretrained(tmp_path)
    saved = json.loads((tmp_path / "config.json").read_text())
    assert saved["primitives"] == ["grasp", "move", "lift", "extend", "place", "retract"]
    assert saved["primitive_lengths"] == [[10, 10], [12, 12], [12, 12], [12, 12], [12, 12], [12, 12]]
    assert saved["environment_names"][0] == "table.x"


def test_windows_are_what_the_dataset_says(metadata) -> None:
    data = pd.read_parquet(Path(metadata.root) / "data")
    demonstrations = Demonstrations(metadata, "subtask_index", "cpu")
    rows = torch.tensor([15, 70 + 69, 200])
    window = demonstrations.window(rows, stride=0, length=12)
    assert window.primitive.tolist() == [1, 5, 5]
    assert window.elapsed.tolist() == [0, 0, 0]
    torch.testing.assert_close(window.state[0, :16], torch.tensor(data["observation.state"][10]))
    torch.testing.assert_close(window.target[0, 3, :16], torch.tensor(data["action"][13]))
    torch.testing.assert_close(window.target[0, 3, 32:], torch.tensor(data["observation.environment_state"][14]))
    assert window.mask.sum(1).tolist() == [12, 12, 12]
    within = demonstrations.window(rows, stride=4, length=12)
    assert within.elapsed.tolist() == [4, 8, 0]
    assert within.mask.sum(1).tolist() == [8, 4, 12]
    torch.testing.assert_close(within.target[0, 0, :16], torch.tensor(data["action"][14]))
    history = demonstrations.history(rows)
    assert history.mask.all()
    assert history.state.shape == (3, 70, 23)
    torch.testing.assert_close(history.state[1, 69, :16], torch.tensor(data["observation.state"][139]))


def test_episodes_that_are_left_out_are_not_learned_from(copy: Path) -> None:
    """Nothing that is fitted before training (normalisation, linear maps, lengths) sees them; a loss on them is possible."""

    def fitted(values: dict) -> dict[str, torch.Tensor]:
        dataset = LeRobotDataset("hdril/test", root=copy, episodes=[0, 2])
        policy = build(dataset.meta, **values)
        assert torch.isfinite(policy.forward({"index": torch.tensor([75, 100])})[0])
        return policy.state_dict()

    def everywhere() -> dict[str, torch.Tensor]:
        return build(LeRobotDatasetMetadata("hdril/test", root=copy)).state_dict()

    before, whole = [fitted(values) for values in ({}, {"coordinates": "relational"})], everywhere()
    for file in (copy / "data").glob("*/*.parquet"):
        table = pq.read_table(file)
        actions = [
            [x + (1.0 if episode == 1 else 0.0) for x in action]
            for episode, action in zip(table["episode_index"].to_pylist(), table["action"].to_pylist(), strict=True)
        ]
        at = table.column_names.index("action")
        pq.write_table(table.set_column(at, "action", pa.array(actions, table["action"].type)), file)
    for old, values in zip(before, ({}, {"coordinates": "relational"}), strict=True):
        torch.testing.assert_close(fitted(values), old, atol=0, rtol=0)
    assert not torch.equal(everywhere()["dynamics.0.state_skip.bias"], whole["dynamics.0.state_skip.bias"])


def test_planner_sees_the_world_whatever_the_dynamics_see(metadata) -> None:
    absolute, relational = (build(metadata, coordinates=name).eval() for name in ("absolute", "relational"))
    relational.planner.load_state_dict(absolute.planner.state_dict())
    for t in range(5):
        seen = observation(metadata, [t, 70 + t])
        actions = [policy.select_action(seen) for policy in (absolute, relational)]
        assert not torch.equal(*actions)
        assert absolute.rollout is not None
        assert relational.rollout is not None
        torch.testing.assert_close(relational.rollout.probabilities, absolute.rollout.probabilities, atol=0, rtol=0)
        torch.testing.assert_close(relational.attention().planner, absolute.attention().planner, atol=0, rtol=0)


def test_primitives_follow_the_planner_at_boundaries(metadata) -> None:
    """The planner is made to say what comes next; it is heard when a primitive is over, and may repeat one."""
    policy = build(metadata).eval()
    wishes = iter([0] * 10 + [0] * 10 + [3] * 12 + [1] * 60)

    def planner(normalised, raw, memory):
        logits = torch.full((1, 1, 6), -9.0)
        logits[..., next(wishes)] = 9.0
        return logits, memory

    policy.planner.forward = planner
    played = []
    for t in range(50):
        policy.select_action(observation(metadata, [t]))
        played.append(int(policy.rollout.primitive[0]))  # pyright: ignore
    assert played == [0] * 20 + [3] * 12 + [1] * 18


def test_open_loop_does_not_look(metadata) -> None:
    policy = build(metadata, rollout="open_loop").eval()
    first = [policy.select_action(observation(metadata, [t])) for t in range(30)]
    policy.reset()
    blind = [policy.select_action(observation(metadata, [0])) for _ in range(30)]
    torch.testing.assert_close(torch.stack(first), torch.stack(blind))
    looking = build(metadata, rollout="closed_loop").eval()
    seeing = [looking.select_action(observation(metadata, [t])) for t in range(30)]
    assert not torch.allclose(torch.stack(seeing), torch.stack(blind))


def test_replanning_is_limited_to_what_was_trained(metadata, tmp_path: Path) -> None:
    build(metadata, replan_every=4).save_pretrained(tmp_path / "four")
    for fine in (0, 4, 8):
        config = HDRILConfig.from_pretrained(tmp_path / "four", cli_overrides=[f"--replan_every={fine}"])
        assert HDRILPolicy.from_pretrained(tmp_path / "four", config=config).config.replan_every == fine
    config = HDRILConfig.from_pretrained(tmp_path / "four", cli_overrides=["--replan_every=3"])
    with pytest.raises(
        ValueError, match="must be 0 or a multiple of 4, because the checkpoint was trained with 4; got 3"
    ):
        HDRILPolicy.from_pretrained(tmp_path / "four", config=config)
    build(metadata).save_pretrained(tmp_path / "none")
    config = HDRILConfig.from_pretrained(tmp_path / "none", cli_overrides=["--replan_every=5"])
    with pytest.raises(ValueError, match="must be 0, because the checkpoint was trained with 0; got 5"):
        HDRILPolicy.from_pretrained(tmp_path / "none", config=config)


def test_padding_does_not_count(metadata) -> None:
    policy = build(metadata)
    window = policy._demonstrations.window(torch.tensor([5, 15]), 0, 12)  # pyright: ignore
    assert window.mask[0].sum() == 10
    before = policy._dynamics_loss(window)
    window.target[0, 10:] += 100.0
    torch.testing.assert_close(policy._dynamics_loss(window), before)


def test_planner_and_dynamics_share_no_parameter(metadata) -> None:
    policy = build(metadata)
    loss, _ = policy._planner_loss(policy._demonstrations.history(torch.tensor([0])))  # pyright: ignore
    loss.backward()
    assert all(p.grad is None for p in policy.dynamics.parameters())
    assert any(p.grad is not None for p in policy.planner.parameters())


def test_does_not_need_the_simulator(tmp_path: Path, metadata) -> None:
    """A checkpoint loads in a process that can import neither pybullet nor hdril."""
    build(metadata).save_pretrained(tmp_path)
    program = f"""
import sys
sys.modules["pybullet"] = sys.modules["hdril"] = None
import torch
from lerobot_policy_hdril import HDRILPolicy
policy = HDRILPolicy.from_pretrained({str(tmp_path)!r})
batch = {{"observation.state": torch.zeros(2, 16), "observation.environment_state": torch.zeros(2, 7)}}
print(tuple(policy.select_action(batch).shape))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("(2, 16)")


# ---------------------------------------------------------------------- what does not fit


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


def test_dataset_without_labels(copy: Path) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"]["subtask_index"]
    (copy / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="no column 'subtask_index' that labels its frames"):
        build(LeRobotDatasetMetadata("hdril/test", root=copy))


def test_dataset_without_names_of_labels(copy: Path) -> None:
    (copy / "meta/subtasks.parquet").unlink()
    with pytest.raises(ValueError, match=r"no meta/subtasks\.parquet"):
        build(LeRobotDatasetMetadata("hdril/test", root=copy))


def test_primitive_without_frames(copy: Path) -> None:
    names = pd.read_parquet(copy / "meta/subtasks.parquet")
    more = pd.DataFrame({"subtask_index": [6]}, index=pd.Index(["juggle"], name="subtask"))
    pd.concat([names, more]).to_parquet(copy / "meta/subtasks.parquet")
    with pytest.raises(ValueError, match="labelled juggle"):
        build(LeRobotDatasetMetadata("hdril/test", root=copy))


def test_labels_without_a_name(copy: Path) -> None:
    pd.read_parquet(copy / "meta/subtasks.parquet").iloc[:3].to_parquet(copy / "meta/subtasks.parquet")
    with pytest.raises(ValueError, match="labels go from 0 to 5"):
        build(LeRobotDatasetMetadata("hdril/test", root=copy))


def test_checkpoint_of_another_task(copy: Path, metadata, tmp_path: Path) -> None:
    build(metadata).save_pretrained(tmp_path / "checkpoint")
    names = pd.read_parquet(copy / "meta/subtasks.parquet").rename(index={"place": "stack"})
    names.to_parquet(copy / "meta/subtasks.parquet")
    config = HDRILConfig.from_pretrained(tmp_path / "checkpoint")
    config.pretrained_path = tmp_path / "checkpoint"
    with pytest.raises(
        ValueError, match=r"trained on another task: its primitives are .*place.*; the dataset's are .*stack"
    ):
        make_policy(config, ds_meta=LeRobotDatasetMetadata("hdril/test", root=copy))


def test_fine_tuning_on_shorter_and_longer_primitives(metadata, tmp_path: Path) -> None:
    policy = build(metadata)
    policy.config.primitive_lengths[1] = [9, 20]
    policy.config.learn_primitives(policy.config.primitives, [[10, 10]] * 6)
    with pytest.raises(ValueError, match="predicts 20 frames at most, but a primitive of the dataset has 30"):
        policy.config.learn_primitives(policy.config.primitives, [[30, 30]] * 6)
    policy.save_pretrained(tmp_path)
    config = HDRILConfig.from_pretrained(tmp_path)
    longer = make_policy(config, ds_meta=metadata)
    loss, _ = longer.forward({"index": torch.arange(0, 420, 9)})
    assert torch.isfinite(loss)


def test_observation_of_another_task(metadata) -> None:
    policy = build(metadata)
    batch = {"observation.state": torch.zeros(1, 16), "observation.environment_state": torch.zeros(1, 14)}
    with pytest.raises(ValueError, match="is the environment of another task"):
        policy.select_action(batch)


def test_training_without_a_dataset(metadata, tmp_path: Path) -> None:
    build(metadata).save_pretrained(tmp_path)
    with pytest.raises(RuntimeError, match="without a dataset"):
        HDRILPolicy.from_pretrained(tmp_path).forward({"index": torch.zeros(1, dtype=torch.long)})


def test_loss_that_is_not_finite(metadata) -> None:
    policy = build(metadata)
    with torch.no_grad():
        policy.planner.head[0].weight.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="not finite"):
        policy.forward({"index": torch.arange(4)})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"interaction": "telepathy"}, "none, scalar, object"),
        ({"decoder": "rnn"}, "gru, ode"),
        ({"rollout": "sideways"}, "closed_loop, open_loop"),
        ({"hidden_dim": 0}, "at least 1"),
        ({"experts": "piled"}, "auto, separate, stacked"),
        ({"experts": "stacked", "decoder": "ode"}, "works with policy.decoder=gru"),
        ({"replan_every": -1}, "0 \\(never\\)"),
        ({"coordinates": "polar"}, "absolute, relational"),
        ({"latent": "quantum"}, "deterministic, variational"),
        ({"kl_weight": -1.0}, "must not be negative"),
        ({"ridge": 0.0}, "ridge must be above 0"),
        ({"samples": 5}, "policy.latent=variational"),
    ],
)
def test_config_names_the_choices(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HDRILConfig(**SMALL | values)
