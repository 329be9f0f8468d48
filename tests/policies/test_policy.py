"""HDR-IL as a LeRobot policy: every variant trains, saves, loads and runs; what does not fit is refused."""

from __future__ import annotations

import copy
import json
import pickle
import subprocess
import sys
from dataclasses import asdict, fields, replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.policies.factory import make_policy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy, companions
from lerobot_policy_hdril.card import model_card
from lerobot_policy_hdril.demonstrations import Demonstrations
from lerobot_policy_hdril.presets import PLAIN, PRESETS

from tests.policies.tools import BATCH, FRAMES, SMALL, VARIANTS, Training, build, demonstrations, observation, read


def losses(policy: HDRILPolicy) -> dict[str, float]:
    """Without the noise of training."""
    with torch.no_grad():
        return policy.eval().forward({"index": BATCH})[1]


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_learns_saves_loads_and_runs(variant: str, metadata, tmp_path: Path) -> None:
    training = Training(build(metadata, **VARIANTS[variant]), 25)
    policy = training.policy
    first = losses(policy)
    for _ in range(25):
        training.step(BATCH)
    last = losses(policy)
    # Planner and dynamics share no parameter, so each has to learn by itself.
    assert last["planner_loss"] < 0.85 * first["planner_loss"]
    if policy.config.decoder == "linear":  # the maps were solved before the first step
        assert last["dynamics_loss"] == first["dynamics_loss"] < 0.3
    else:
        assert last["dynamics_loss"] < 0.85 * first["dynamics_loss"]
    assert set(last) == {"dynamics_loss", "latent_divergence", "planner_loss", "planner_accuracy"}
    assert (last["latent_divergence"] > 0) == (policy.config.latent == "variational")
    policy.save_pretrained(tmp_path / "checkpoint")
    loaded = HDRILPolicy.from_pretrained(tmp_path / "checkpoint")
    for t in range(25):
        seen = observation(metadata, [t, FRAMES + t, 2 * FRAMES + t])
        together = policy.select_action(seen)
        assert torch.equal(loaded.select_action(seen), together)
        assert together.shape == (3, 16)
        for group in ([3, 4, 5, 6], [11, 12, 13, 14]):
            torch.testing.assert_close(together[:, group].norm(dim=-1), torch.ones(3))


@pytest.mark.parametrize("variant", VARIANTS)
def test_attention_is_shared_among_hands_and_objects(variant: str, metadata) -> None:
    policy = build(metadata, **VARIANTS[variant]).eval()
    policy.select_action(observation(metadata, [0, FRAMES]))
    attention = policy.attention()
    for weights in (attention.planner, attention.dynamics):
        assert weights.shape == (2, len(attention.nodes), len(attention.nodes))
        torch.testing.assert_close(weights.sum(-1), torch.ones(2, len(attention.nodes)))
    told = policy.explain()
    assert told is not None
    assert list(told.attention) == ["left", "right", "table"]
    assert sum(told.attention.values()) == pytest.approx(1.0, abs=1e-5)


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


def test_policy_explains_itself(metadata) -> None:
    policy = build(metadata).eval()
    assert policy.explain() is None
    with pytest.raises(RuntimeError, match="no episode is running"):
        policy.attention()
    begun: list[set[str]] = [set(), set()]
    for t in range(25):
        action = policy.select_action(observation(metadata, [t, FRAMES + t]))
        attention = policy.attention()
        assert attention.nodes == ["left", "right", "table"]
        for weights in (attention.planner, attention.dynamics):
            assert weights.shape == (2, 3, 3)
            torch.testing.assert_close(weights.sum(-1), torch.ones(2, 3))
        received = attention.received()
        for row in range(2):
            told = policy.explain(row)
            assert told is not None
            assert told.primitive == attention.primitives[row]
            assert list(told.probabilities) == policy.config.primitives
            assert sum(told.probabilities.values()) == pytest.approx(1.0, abs=1e-5)
            assert told.attention == {
                name: pytest.approx(float(share[row]), abs=1e-6) for name, share in received.items()
            }
            assert sum(told.attention.values()) == pytest.approx(1.0, abs=1e-5)
            if told.plan is None:
                assert told.events == ()
            else:
                again = (f"{told.primitive} tried again",) if told.primitive in begun[row] else ()
                assert told.events == again
                begun[row].add(told.primitive)
                longest = policy.config.primitive_lengths[policy.config.primitives.index(told.primitive)][1]
                assert told.plan.shape == (longest, 16)
                torch.testing.assert_close(torch.from_numpy(told.plan[0]), action[row])
        if t == 0:
            assert told.primitive == max(told.probabilities, key=told.probabilities.__getitem__)
            assert told.plan is not None
        if t == 1:
            assert told.plan is None
    policy.reset()
    assert policy.explain() is None


@pytest.mark.parametrize("coordinates", ["absolute", "relational"])
def test_plan_undoes_what_the_target_did(coordinates: str, metadata, monkeypatch) -> None:
    """If the dynamics predict their targets, the plan is what was recorded: in the world, metres and unit quaternions."""
    policy = build(metadata, coordinates=coordinates).eval()
    window = demonstrations(policy).window(torch.tensor([0, 25, 140]), 0, 12)
    monkeypatch.setattr(policy, "predict", lambda state, *_: (policy.target(window), state.new_zeros(3)))
    plan = policy.plan(window.seen, window.primitive, window.elapsed)
    torch.testing.assert_close(plan[window.mask], window.target[window.mask], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("preset", "every"),
    [("hdril", 4), ("hdril_paper", 4), ("res_multi_relational", 4), ("network_reactive", 4), ("network_reactive", 1)],
)
def test_stacked_models_are_the_separate_ones(preset: str, every: int, metadata) -> None:
    """Same predictions with several primitives in the batch, same loss gradients, at the start and within primitives."""
    values = {"preset": preset, "replan_every": every}
    separate, stacked = (build(metadata, experts=how, **values) for how in ("separate", "stacked"))
    with torch.no_grad():  # the head starts at zero where there are linear maps
        for policy in (separate, stacked):
            torch.manual_seed(1)
            for parameter in policy.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
    rows = torch.tensor([0, 3, 25, 15, 69, 70, 101, 140, 30, 31])
    gradients = []
    for policy in (separate.eval(), stacked.eval()):
        window = demonstrations(policy).window(rows, every, policy.ahead)
        predicted = policy.predict(window.seen, window.primitive, window.elapsed)
        policy.dynamics_loss(window)[0].backward()
        gradients.append([*predicted, *(p.grad for p in policy.dynamics.parameters() if p.grad is not None)])
    assert len(gradients[0]) == len(gradients[1]) > 10
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_a_window_has_the_numbers_of_its_steps(metadata) -> None:
    """The first is how many frames of the primitive are over; beyond the room of a plan the last number is repeated."""
    policy = build(metadata)
    assert policy.capacity == 12
    assert policy.steps(torch.tensor([0, 9])).tolist() == [[*range(12)], [9, 10, *[11] * 10]]


def test_latent_sees_the_numbers_of_objects_alone(metadata) -> None:
    """The paper's skip connection (Figure 2) passes the objects' poses round the encoder, and not the hands'."""
    with_skip, without = (build(metadata, learned=False, preset=preset) for preset in ("res", "gru_gru"))
    names = [*with_skip.config.state_names, *with_skip.config.environment_names]
    seen = [names[column] for column in with_skip.model_of(0).skip_columns]
    assert seen == with_skip.config.environment_names
    assert len(without.model_of(0).skip_columns) == 0


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
    window = demonstrations(policy).window(rows, 0, 12)

    def predict() -> torch.Tensor:
        return policy.predict(window.seen, window.primitive, window.elapsed)[0]

    policy.train()
    assert not torch.equal(predict(), predict())
    policy.eval()
    sampled = predict()
    assert torch.equal(sampled, predict())
    policy.config.samples = 0
    mean = predict()
    assert torch.equal(mean, predict())
    assert not torch.allclose(mean, sampled)


def test_prediction_is_the_mean_over_samples(metadata) -> None:
    """Without noise every latent is the mean latent, and so is the mean over any number of them."""
    policy = build(metadata, latent="variational", samples=5).eval()
    with torch.no_grad():
        for model in policy.dynamics:
            model.latent[-1].bias[SMALL["hidden_dim"] :] = -100.0  # log variance
            torch.nn.init.normal_(model.head[-1].weight)
    window = demonstrations(policy).window(torch.tensor([0, 15]), 0, 12)
    sampled = policy.predict(window.seen, window.primitive, window.elapsed)[0]
    policy.config.samples = 0
    mean = policy.predict(window.seen, window.primitive, window.elapsed)[0]
    torch.testing.assert_close(sampled, mean, atol=1e-4, rtol=1e-4)


def test_divergence_is_that_of_gaussians(metadata) -> None:
    from torch.distributions import Normal, kl_divergence

    policy = build(metadata, latent="variational", kl_weight=0.1)
    kept = {}
    model = policy.dynamics[0]
    model.latent.register_forward_hook(lambda module, args, out: kept.update(latent=out.detach()))
    window = demonstrations(policy).window(torch.tensor([0]), 0, 12)
    _, divergence = policy.predict(window.seen, window.primitive, window.elapsed)
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
        start = pa.array((frame["frame_index"] == 0).to_list())
        table = table.set_column(table.column_names.index("subtask_start"), "subtask_start", start)
        pq.write_table(table.filter(pc.equal(table["episode_index"], 0)), file)
    names = pd.DataFrame({"subtask_index": [0]}, index=pd.Index(["lift"], name="subtask"))
    names.to_parquet(copy / "meta/subtasks.parquet")
    policy = build(read(copy), learned=False)
    assert policy.config.primitives == ["lift"]
    loss, info = policy.forward({"index": torch.tensor([3])})
    assert policy.config.primitive_lengths == [[70, 70]]
    loss.backward()
    assert torch.isfinite(loss)
    assert info["planner_accuracy"] == 1.0
    policy.eval()
    one = read(copy)
    actions = [policy.select_action(observation(one, [t])) for t in range(5)]
    assert all(action.shape == (1, 16) for action in actions)


@pytest.mark.parametrize(
    ("linear", "whole"),
    [("linear", {}), ("linear_every_frame", {"replan_every": 1}), ("hdril_reactive", {"preset": "network_reactive"})],
)
def test_linear_maps_alone_predict_what_the_whole_does_before_its_network_learns(linear: str, whole, metadata) -> None:
    alone, whole = build(metadata, preset=linear).eval(), build(metadata, **{"preset": "hdril"} | whole).eval()
    assert not list(alone.dynamics.parameters())
    assert list(whole.dynamics.parameters())
    state = torch.cat([observation(metadata, [5, 40])[key] for key in (OBS_STATE, OBS_ENV_STATE)], dim=-1)
    seen = state[:, None].expand(-1, 1 + len(alone.config.filters), -1)
    primitive, elapsed = torch.tensor([0, 2]), torch.tensor([0, 0])
    given = alone.plan(seen, primitive, elapsed)
    assert torch.equal(given, whole.plan(seen, primitive, elapsed))
    assert given.std() > 0.1


@pytest.mark.parametrize(
    "given", [{"state_skip": False}, {"per_primitive": False}, {"latent": "variational"}, {"experts": "stacked"}]
)
def test_linear_maps_alone_refuse_what_would_act_on_nothing(given) -> None:
    with pytest.raises(ValueError, match=r"policy\.decoder=(linear needs|gru; got linear)"):
        HDRILConfig(device="cpu", push_to_hub=False, coordinates="absolute", decoder="linear", **given)


OURS = ("hdril", "linear", "network")


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_is_what_its_name_says(preset: str) -> None:
    config = HDRILConfig(device="cpu", push_to_hub=False, preset=preset)
    for name, value in PRESETS[preset].items():
        assert getattr(config, name) == value
    assert (config.coordinates == "relational") == preset.endswith("_relational")
    assert config.per_primitive == ("multi" in preset or preset.startswith(OURS))
    assert config.skip == (preset.startswith(("res", *OURS)))
    assert (config.decoder == "linear") == (preset.startswith("linear") or preset == "hdril_reactive")
    assert (config.interaction == "none") == preset.startswith(("gru_gru", "res_", "res_multi")) or preset == "res"
    assert (config.termination == "learned") == (config.coordinates == "fused") == preset.endswith("_reactive")


def by_position(config: HDRILConfig) -> HDRILConfig:
    return HDRILConfig(*(getattr(config, entry.name) for entry in fields(config) if not entry.kw_only))


def by_pickle(config: HDRILConfig) -> HDRILConfig:
    return pickle.loads(pickle.dumps(config))


@pytest.mark.parametrize("again", [copy.deepcopy, replace, by_pickle, by_position])
def test_a_copy_of_a_trained_config_is_the_same(again, metadata) -> None:
    config = build(metadata, preset="hdril_reactive").config
    assert asdict(again(config)) == asdict(config)


def test_the_defaults_are_the_reactive_preset() -> None:
    named = asdict(HDRILConfig(device="cpu", push_to_hub=False, preset="hdril_reactive"))
    assert asdict(HDRILConfig(device="cpu", push_to_hub=False)) == named | {"preset": ""}


@pytest.mark.parametrize(
    ("values", "looks"),
    [
        ({"preset": "hdril"}, "the policy looks again when the primitive is over."),
        ({"preset": "hdril", "replan_every": 4}, "the policy looks every 4 frames."),
        ({"preset": "hdril", "rollout": "open_loop"}, "from its own predictions, without looking again."),
        (
            {"preset": "hdril", "termination": "learned"},
            "at every frame which one plays, and plans when a primitive begins.",
        ),
        ({"preset": "hdril_reactive"}, "the policy decides at every frame which one plays, and plans every 2 frames."),
        ({"preset": "hdril_reactive", "replan_every": 1}, "at every frame which one plays, and plans at every frame."),
    ],
)
def test_a_card_says_when_the_policy_looks(values, looks: str, metadata) -> None:
    policy = build(metadata, **values)
    text = str(model_card(policy.config, "user/set", None, None, None, metadata))
    assert looks in text
    for name in PLAIN:
        assert f"`{getattr(policy.config, name)}`" in text.partition(f"| `{name}`")[2].partition("\n")[0]


@pytest.mark.parametrize(
    ("values", "predicts"),
    [
        (
            {"preset": "hdril_reactive"},
            "linear maps in the frames of all objects, fused by their precision, predict its",
        ),
        ({"preset": "network_reactive"}, "a graph-recurrent model of each primitive what they leave, and the policy"),
        ({"preset": "linear"}, "next primitive, linear maps predict its trajectory"),
        ({"preset": "hdril"}, "a graph-recurrent dynamics model of each primitive predicts its trajectory"),
        ({"preset": "res"}, "a graph-recurrent dynamics model of all primitives predicts its trajectory"),
    ],
)
def test_a_card_says_what_predicts(values, predicts: str, metadata) -> None:
    assert predicts in str(model_card(build(metadata, **values).config, "user/set", None, None, None, metadata))


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
    assert demonstrations.window(torch.tensor([0, 5, 9, 10, 70, 139]), 4, 12).first.tolist() == [
        True, True, True, False, True, False,
    ], "of the first primitive of their episodes, however far into it"  # fmt: skip
    torch.testing.assert_close(within.target[0, 0, :16], torch.tensor(data["action"][14]))
    history = demonstrations.history(rows)
    assert history.mask.all()
    assert history.state.shape == (3, 70, 23)
    torch.testing.assert_close(history.state[1, 69, :16], torch.tensor(data["observation.state"][139]))


def test_planner_sees_the_world_whatever_the_dynamics_see(metadata) -> None:
    absolute, relational = (build(metadata, coordinates=name).eval() for name in ("absolute", "relational"))
    relational.planner.load_state_dict(absolute.planner.state_dict())
    for t in range(5):
        seen = observation(metadata, [t])
        actions = [policy.select_action(seen) for policy in (absolute, relational)]
        assert not torch.equal(*actions)
        one, other = absolute.explain(), relational.explain()
        assert one is not None
        assert other is not None
        assert one.probabilities == other.probabilities
        assert torch.equal(absolute.attention().planner, relational.attention().planner)


def test_padding_does_not_count(metadata) -> None:
    policy = build(metadata)
    window = demonstrations(policy).window(torch.tensor([5, 15]), 0, 12)
    assert window.mask[0].sum() == 10
    before = policy.dynamics_loss(window)
    window.target[0, 10:] += 100.0
    torch.testing.assert_close(policy.dynamics_loss(window), before)


def test_planner_learns_from_histories_and_from_single_frames(metadata) -> None:
    policy = build(metadata)
    data, rows = demonstrations(policy), torch.tensor([0, 25, 205])
    history, window = data.history(rows), data.window(rows, 0, 12)

    def loss(states: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        logits, _ = policy.planner(policy.normalise(states), states)
        return torch.nn.functional.cross_entropy(logits.flatten(0, 1), labels.flatten())

    whole, alone = loss(history.state, history.primitive), loss(window.state[:, None], window.primitive[:, None])
    torch.testing.assert_close(policy.planner_loss(history, window)[0], whole + alone)


def test_planner_and_dynamics_share_no_parameter(metadata) -> None:
    policy = build(metadata)
    rows = torch.tensor([0])
    data = demonstrations(policy)
    policy.planner_loss(data.history(rows), data.window(rows, 0, 12))[0].backward()
    assert all(p.grad is None for p in policy.dynamics.parameters())
    assert any(p.grad is not None for p in policy.planner.parameters())


def test_does_not_need_the_simulator(tmp_path: Path, metadata) -> None:
    """A checkpoint loads in a process that can import neither pybullet nor hdril, and where hdril is not installed."""
    build(metadata).save_pretrained(tmp_path)
    program = f"""
import importlib.metadata, sys
sys.modules["pybullet"] = sys.modules["hdril"] = None
installed = importlib.metadata.entry_points
group = "lerobot_policy_hdril.companions"
importlib.metadata.entry_points = lambda **which: [] if which.get("group") == group else installed(**which)
import torch
from lerobot_policy_hdril import HDRILPolicy
policy = HDRILPolicy.from_pretrained({str(tmp_path)!r})
batch = {{"observation.state": torch.zeros(2, 16), "observation.environment_state": torch.zeros(2, 7)}}
print(tuple(policy.select_action(batch).shape))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout.strip().endswith("(2, 16)"), done.stderr


def test_companion_that_cannot_be_imported_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("environment", "a_module_that_is_not_there", companions.GROUP)
    monkeypatch.setattr(companions, "entry_points", lambda group: [entry] if group == companions.GROUP else [])
    with pytest.raises(
        ImportError, match=r"a_module_that_is_not_there, which .* adds to lerobot_policy_hdril, fails: No mod"
    ):
        companions.load_companions()


# ---------------------------------------------------------------------- what does not fit


def test_dataset_without_labels(copy: Path) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"]["subtask_index"]
    (copy / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="no column 'subtask_index' that labels its frames"):
        build(read(copy))


def test_dataset_without_names_of_labels(copy: Path) -> None:
    (copy / "meta/subtasks.parquet").unlink()
    with pytest.raises(ValueError, match=r"no meta/subtasks\.parquet"):
        build(read(copy))


def test_primitive_without_frames(copy: Path) -> None:
    names = pd.read_parquet(copy / "meta/subtasks.parquet")
    more = pd.DataFrame({"subtask_index": [6]}, index=pd.Index(["juggle"], name="subtask"))
    pd.concat([names, more]).to_parquet(copy / "meta/subtasks.parquet")
    with pytest.raises(ValueError, match="labelled juggle"):
        build(read(copy))


def test_labels_without_a_name(copy: Path) -> None:
    pd.read_parquet(copy / "meta/subtasks.parquet").iloc[:3].to_parquet(copy / "meta/subtasks.parquet")
    with pytest.raises(ValueError, match="labels go from 0 to 5"):
        build(read(copy))


def test_checkpoint_of_another_task(copy: Path, metadata, tmp_path: Path) -> None:
    build(metadata).save_pretrained(tmp_path / "checkpoint")
    names = pd.read_parquet(copy / "meta/subtasks.parquet").rename(index={"place": "stack"})
    names.to_parquet(copy / "meta/subtasks.parquet")
    config = HDRILConfig.from_pretrained(tmp_path / "checkpoint")
    config.pretrained_path = tmp_path / "checkpoint"
    with pytest.raises(
        ValueError, match=r"trained on another task: its primitives are .*place.*; the dataset's are .*stack"
    ):
        make_policy(config, ds_meta=read(copy))


def test_dataset_with_longer_primitives_than_the_checkpoint_has_room_for(metadata, varied, tmp_path: Path) -> None:
    build(metadata).save_pretrained(tmp_path / "short")
    build(varied).save_pretrained(tmp_path / "long")
    for name, data in (("short", varied), ("long", metadata)):
        config = HDRILConfig.from_pretrained(tmp_path / name)
        config.pretrained_path = tmp_path / name
        if name == "short":
            with pytest.raises(ValueError, match="predicts 12 frames at most, but a primitive of the dataset has 1"):
                make_policy(config, ds_meta=data)
        else:
            loss, _ = make_policy(config, ds_meta=data).train().forward({"index": BATCH})
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
        ({"experts": "stacked", "decoder": "ode"}, "needs policy.decoder=gru"),
        ({"replan_every": -1}, "0 \\(never\\)"),
        ({"plan_overlap": 1, "coordinates": "absolute"}, "from 0 to policy.replan_every, .* got 1, 2 and absolute"),
        ({"plan_overlap": 3, "coordinates": "fused"}, "from 0 to policy.replan_every, .* got 3, 2 and fused"),
        ({"plan_overlap": -1, "coordinates": "fused"}, "from 0 to policy.replan_every, .* got -1, 2 and fused"),
        ({"least_survival": 1.0}, "from 0 to less than 1, .* got 1.0 and learned"),
        ({"least_survival": -0.1}, "from 0 to less than 1, .* got -0.1 and learned"),
        ({"least_survival": 0.3, "termination": "length"}, "for policy.termination=learned; got 0.3 and length"),
        ({"repeat_discount": 1.0}, "from 0 to less than 1, .* got 1.0 and learned"),
        ({"repeat_discount": -0.1}, "from 0 to less than 1, .* got -0.1 and learned"),
        ({"repeat_discount": 0.5, "termination": "length"}, "for policy.termination=learned; got 0.5 and length"),
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
