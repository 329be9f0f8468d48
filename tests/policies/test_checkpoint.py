"""Checkpoints: they resume bit for bit, overrides act or are refused, damaged or older ones say so."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import asdict, fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy, fitting
from lerobot_policy_hdril.overrides import CHANGEABLE, check_overrides
from lerobot_policy_hdril.presets import PLAIN, PRESETS
from safetensors.torch import load_file, save_file
from torch.utils.data import DataLoader

from tests.policies.tools import BATCH, FRAMES, VARIANTS, Training, assert_same, build, observation, tensors


def save_training(folder: Path, training: Training) -> None:
    _training_states().save_training_state(folder, 1, training.optimizer, training.scheduler)


def load_training(folder: Path, training: Training) -> None:
    _training_states().load_training_state(folder, training.optimizer, training.scheduler)


def _training_states() -> Any:
    """LeRobot's functions that write and read the state of a training; LeRobot 0.6 has them here."""
    try:
        from lerobot.common import train_utils
    except ImportError as error:
        raise AssertionError("lerobot.common.train_utils is gone: find what replaces it in this LeRobot") from error
    missing = [name for name in ("save_training_state", "load_training_state") if not hasattr(train_utils, name)]
    assert not missing, f"lerobot.common.train_utils has no {' or '.join(missing)}: find what replaces it"
    return train_utils


def resume(folder: Path, metadata) -> Training:
    torch.manual_seed(7)
    config = HDRILConfig.from_pretrained(folder / "pretrained_model")
    config.pretrained_path = folder / "pretrained_model"
    policy = make_policy(config, ds_meta=metadata)
    assert isinstance(policy, HDRILPolicy)
    training = Training(policy, 4)
    load_training(folder, training)
    return training


def assert_resumes(batches: list[torch.Tensor], at: int, metadata, folder: Path, **values: Any) -> None:
    """Train, with a checkpoint after ``at`` batches, as LeRobot's trainer writes and reads it: same weights, bit for bit."""
    straight = Training(build(metadata, learned=False, **values), 4)
    for step, index in enumerate(batches):
        if step == at:
            straight.policy.save_pretrained(folder / "pretrained_model")
            save_training(folder, straight)
            saved = {name: value.clone() for name, value in tensors(straight.policy).items()}
        straight.step(index)
    resumed = resume(folder, metadata)
    assert_same(tensors(resumed.policy), saved)
    # LeRobot restores the random generators with the training's state, and then makes a loader, which draws from them.
    load_training(folder, resumed)
    if resumed.policy.config.latent == "deterministic":
        iter(DataLoader(batches))
    for index in batches[at:]:
        resumed.step(index)
    assert_same(tensors(resumed.policy), tensors(straight.policy))
    assert resumed.policy.config.training_data == straight.policy.config.training_data


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_resumes(variant: str, metadata, tmp_path: Path) -> None:
    assert_resumes([BATCH[:12]] * 3, 1, metadata, tmp_path, **VARIANTS[variant])


@pytest.mark.parametrize("at", [1, 3, 4, 5])
def test_resumes_while_episodes_are_still_joining(
    at: int, metadata, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where an episode has joined and is not fitted yet: with these limits, the fit waits after the third batch."""
    monkeypatch.setattr(fitting, "QUIET", 3)
    episodes = [[0, 3], [3, 0], [1], [1, 0], [0], [0, 1], [5, 4]]
    batches = [torch.tensor([FRAMES * e + 7 * i for e in group for i in range(4)]) for group in episodes]
    assert_resumes(batches, at, metadata, tmp_path)


# ---------------------------------------------------------------------- overrides


@pytest.fixture(scope="module")
def checkpoint(metadata, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the paper's Res: five samples of a variational latent."""
    folder = tmp_path_factory.mktemp("res")
    build(metadata, preset="res", hidden_dim=32).save_pretrained(folder)
    return folder


def load(folder: Path, *overrides: str) -> HDRILPolicy:
    return HDRILPolicy.from_pretrained(folder, config=HDRILConfig.from_pretrained(folder, cli_overrides=[*overrides]))


def test_override_acts_whatever_the_preset(checkpoint: Path, metadata) -> None:
    """0 samples are the default of the config, and not what the preset says: it acts all the same."""
    sampled, mean, same = load(checkpoint), load(checkpoint, "--samples=0"), load(checkpoint, "--samples=5")
    assert (sampled.config.samples, mean.config.samples, mean.config.preset) == (5, 0, "res")
    first = observation(metadata, [0])
    assert torch.equal(same.select_action(first), sampled.select_action(first))
    assert not torch.equal(mean.select_action(first), sampled.select_action(first))
    opened = load(checkpoint, "--rollout=open_loop", "--experts=separate", "--device=cpu")
    assert (opened.config.rollout, opened.config.experts) == ("open_loop", "separate")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("--interaction=object", r"policy\.interaction is 'none' in the checkpoint .*; got 'object'"),
        ("--hidden_dim=128", r"policy\.hidden_dim is 32 .*; got 128"),
        ("--skip=false", r"policy\.skip is True .*; got False"),
        ("--per_primitive=true", r"policy\.per_primitive is False .*; got True"),
        ("--preset=int", r"policy\.preset is 'res' .*; got 'int'"),
        ("--preset=", r"policy\.preset is 'res' .*; got "),
        ("--ridge=2", r"policy\.ridge is 1\.0 .*; got 2\.0"),
    ],
)
def test_override_of_what_the_weights_fixed_is_refused(override: str, message: str, checkpoint: Path) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        load(checkpoint, override)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", [entry.name for entry in fields(HDRILConfig) if entry.name not in CHANGEABLE])
def test_every_field_is_fixed_unless_it_is_named_changeable(name: str, checkpoint: Path) -> None:
    given, saved = (HDRILConfig.from_pretrained(checkpoint) for _ in range(2))
    check_overrides(given, saved, "checkpoint")
    setattr(given, name, "something else")
    with pytest.raises(ValueError, match=rf"policy\.{name} is "):
        check_overrides(given, saved, "checkpoint")


def test_preset_contradicted_by_a_value_that_is_the_default() -> None:
    with pytest.raises(ValueError, match=r"policy\.preset=res makes policy\.samples 5, but 0 was given; leave out one"):
        HDRILConfig(device="cpu", push_to_hub=False, preset="res", samples=0)
    assert HDRILConfig(device="cpu", push_to_hub=False, preset="res", samples=5).samples == 5
    assert HDRILConfig(device="cpu", push_to_hub=False, preset="res", hidden_dim=128).hidden_dim == 128


@pytest.mark.parametrize(
    "free", [{"filter_frames": 4, "robust": True}, {"replan_every": 3}, {"hidden_dim": 64, "robust": True}]
)
def test_a_preset_leaves_open_what_makes_no_other_model(free: dict[str, Any]) -> None:
    config = HDRILConfig(device="cpu", push_to_hub=False, preset="hdril", **free)
    for name, value in (PRESETS["hdril"] | free).items():
        assert getattr(config, name) == value


def test_replanning_is_limited_to_what_was_trained(metadata, tmp_path: Path) -> None:
    build(metadata, replan_every=4).save_pretrained(tmp_path / "four")
    for fine in (0, 4, 8):
        assert load(tmp_path / "four", f"--replan_every={fine}").config.replan_every == fine
    with pytest.raises(ValueError, match=r"must be 0 or a multiple of 4, because .* trained with 4; got 3"):
        load(tmp_path / "four", "--replan_every=3")
    build(metadata).save_pretrained(tmp_path / "none")
    with pytest.raises(ValueError, match="must be 0, because the checkpoint was trained with 0; got 5"):
        load(tmp_path / "none", "--replan_every=5")


# ---------------------------------------------------------------------- damaged and older checkpoints


@pytest.fixture
def damaged(checkpoint: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(checkpoint, tmp_path / "damaged"))


@pytest.mark.parametrize("kept", [0, 5, 1000, -10])
def test_truncated_weights(kept: int, damaged: Path) -> None:
    file = damaged / "model.safetensors"
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"model\.safetensors is not a whole safetensors file: download") as raised:
        load(damaged)
    assert "\n" not in str(raised.value)


def test_weights_that_are_missing_unknown_or_of_another_shape(damaged: Path) -> None:
    file = damaged / "model.safetensors"
    whole = load_file(file)
    name = "planner.head.0.bias"
    save_file({key: value for key, value in whole.items() if key != name}, file)
    with pytest.raises(ValueError, match=rf"does not fit its config\.json: it lacks {name}"):
        load(damaged)
    save_file(whole | {"extra": torch.zeros(1)}, file)
    with pytest.raises(ValueError, match="it has unknown extra"):
        HDRILPolicy.from_pretrained(damaged)
    save_file(whole | {name: torch.zeros(3)}, file)
    with pytest.raises(ValueError, match=f"it has other shapes of {name}"):
        load(damaged)
    file.unlink()
    with pytest.raises(FileNotFoundError, match="has no weights"):
        load(damaged)


def without(folder: Path, names: list[str]) -> None:
    """Take options out of a checkpoint's config, as if they had come later."""
    values = json.loads((folder / "config.json").read_text())
    for name in names:
        del values[name]
    (folder / "config.json").write_text(json.dumps(values))


def test_older_checkpoint_acts_as_it_did_whatever_the_defaults_are_now(metadata, tmp_path: Path) -> None:
    """Its config lacks the options that came later."""
    saved = build(metadata, preset="hdril", hidden_dim=32).eval()
    saved.save_pretrained(tmp_path)
    without(tmp_path, [*PLAIN, "coordinates", "ridge_other", "fusion_shrinkage", "fourier_features"])
    older = load(tmp_path)
    assert asdict(older.config) == asdict(HDRILConfig(**asdict(saved.config) | {"pretrained_path": None}))
    first = observation(metadata, [0])
    saved.reset()
    assert torch.equal(older.select_action(first), saved.select_action(first))


def test_checkpoint_from_before_the_second_scale_acts_without_it(metadata, tmp_path: Path) -> None:
    plain = dict.fromkeys(("planner_scale", "planner_dropout", "planner_late"), 0.0)
    saved = build(metadata, preset="hdril_reactive", hidden_dim=32, **plain).eval()
    saved.save_pretrained(tmp_path)
    without(tmp_path, list(plain))
    older = load(tmp_path)
    assert older.config.planner_scale == older.config.planner_dropout == older.config.planner_late == 0.0
    first = observation(metadata, [0])
    saved.reset()
    assert torch.equal(older.select_action(first), saved.select_action(first))


def test_checkpoint_from_before_plans_overlapped_and_primitives_were_given_up_acts_as_it_did(
    metadata, tmp_path: Path
) -> None:
    saved = build(metadata, preset="hdril_reactive", plan_overlap=0, least_survival=0.0, repeat_discount=0.0).eval()
    saved.save_pretrained(tmp_path / "older")
    without(tmp_path / "older", ["plan_overlap", "least_survival", "repeat_discount"])
    older = load(tmp_path / "older")
    assert older.config.plan_overlap == older.config.least_survival == older.config.repeat_discount == 0
    assert load(tmp_path / "older", "--least_survival=0.3").config.least_survival == 0.3
    assert load(tmp_path / "older", "--repeat_discount=0.5").config.repeat_discount == 0.5
    for frame in range(4):
        seen = observation(metadata, [frame])
        assert torch.equal(older.select_action(seen), saved.select_action(seen))
    build(metadata, preset="hdril_reactive", plan_overlap=2).save_pretrained(tmp_path / "two")
    assert load(tmp_path / "two").config.plan_overlap == 2
    with pytest.raises((ValueError, ParsingError)):
        load(tmp_path / "two", "--plan_overlap=1")


def test_older_checkpoint_whose_maps_were_fused_in_another_way_is_refused(metadata, tmp_path: Path) -> None:
    build(metadata, preset="hdril_reactive", hidden_dim=32).save_pretrained(tmp_path)
    without(tmp_path, ["fusion_shrinkage"])
    with pytest.raises((ValueError, ParsingError)) as raised:
        load(tmp_path)
    told = str(raised.value.__cause__ or raised.value)  # draccus wraps what a config says of itself
    assert re.match(r"the checkpoint has policy\.coordinates=fused of a version .*: train it anew, or ", told), told


def test_fused_predictions_that_are_damaged_on_purpose_change_in_one_primitive(
    metadata, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``scripts/damage.py``; tests/viewer/test_view.py has the command, and a policy that is not fused."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "scripts")
    damage = import_module("damage").damage
    build(metadata, preset="hdril_reactive").save_pretrained(tmp_path / "whole")
    damage(tmp_path / "whole", tmp_path / "damaged", "move")
    whole, damaged = (load(tmp_path / name) for name in ("whole", "damaged"))
    seen = observation(metadata, [15])
    state = torch.cat([seen["observation.state"], seen["observation.environment_state"]], dim=-1)
    state = state[:, None].expand(-1, 1 + len(whole.config.filters), -1)
    for primitive, name in enumerate(whole.config.primitives):
        plans = [policy.plan(state, torch.tensor([primitive]), torch.tensor([0])) for policy in (whole, damaged)]
        assert torch.equal(*plans) == (name != "move")
        assert plans[1].isfinite().all()


def test_older_checkpoint_loads_without_provenance(damaged: Path, checkpoint: Path, metadata) -> None:
    """It knows neither ``training_data`` nor ``capacity``. Further training keeps its fit, and says what it adds."""
    values = json.loads((damaged / "config.json").read_text())
    del values["training_data"], values["capacity"]
    (damaged / "config.json").write_text(json.dumps(values))
    older = load(damaged)
    assert older.config.training_data[0].digest == ""
    first = observation(metadata, [0])
    assert torch.equal(older.select_action(first), load(checkpoint).select_action(first))
    config = PreTrainedConfig.from_pretrained(damaged)
    config.pretrained_path = damaged
    tuned = make_policy(config, ds_meta=metadata)
    assert isinstance(tuned, HDRILPolicy)
    tuned.train().forward({"index": torch.tensor([FRAMES])})
    assert_same(tensors(tuned), tensors(older))
    assert [record.episodes for record in tuned.config.training_data] == [(), ((1, 1),)]
