"""Damaged checkpoints and overrides that cannot act: one line each, and nothing is written."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_policy_hdril import HDRILConfig
from safetensors.torch import load_file, save_file

from hdril.cli.eval import EvalConfig, PolicySource, eval_command, split_overrides
from hdril.evaluation.checkpoint import find_checkpoint, resolve_config
from hdril.evaluation.lerobot_actor import LeRobotActor
from hdril.evaluation.overrides import running_options
from hdril.tasks import get_task
from tests.evaluation.checkpoints import listing, save_act, save_hdril, save_replay


@pytest.fixture
def replay(tmp_path: Path) -> Path:
    return save_replay(tmp_path / "policy", np.zeros((2, 16)))


@pytest.fixture(scope="module")
def act(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_act(tmp_path_factory.mktemp("act") / "policy", dataset, None)


@pytest.fixture(scope="module")
def hdril(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_hdril(tmp_path_factory.mktemp("hdril") / "policy", dataset)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-8])


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        (
            "model.safetensors",
            truncate,
            r"policy/model\.safetensors is not a whole safetensors file: download or save it",
        ),
        ("model.safetensors", Path.unlink, r"is incomplete: model\.safetensors is missing"),
        ("config.json", truncate, r"policy/config\.json is not valid JSON: "),
        ("config.json", Path.unlink, r"no checkpoint at .*policy: it should be a folder with config\.json"),
        ("policy_preprocessor.json", Path.unlink, r"is incomplete: policy_preprocessor\.json is missing"),
        ("policy_postprocessor.json", truncate, r"policy/policy_postprocessor\.json is not valid JSON"),
    ],
)
def test_damaged_files_are_named(replay: Path, tmp_path: Path, name: str, damage, message: str) -> None:
    damage(replay / name)
    before = listing(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        eval_command(EvalConfig(PolicySource(str(replay)), output_dir=tmp_path / "out/eval"))
    assert "\n" not in str(caught.value)
    assert listing(tmp_path) == before


def test_files_that_the_processors_name_are_checked(act: Path, dataset: Path, tmp_path: Path) -> None:
    folder = save_act(tmp_path / "policy", dataset, None)
    (state,) = folder.glob("policy_preprocessor_*.safetensors")
    whole = state.read_bytes()
    truncate(state)
    with pytest.raises(ValueError, match=f"{state.name} is not a whole safetensors file"):
        find_checkpoint(str(folder))
    state.unlink()
    with pytest.raises(FileNotFoundError, match=f"is incomplete: {state.name} is missing"):
        find_checkpoint(str(folder))
    state.write_bytes(whole)
    assert state in find_checkpoint(str(folder)).processors


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("--bogus=7", r"replay has no option policy\.bogus; it has: .*labels.*scale"),
        ("--scale", r"policy\.scale must be given with its value, as --policy\.scale=VALUE"),
        ("--scale=big", r"cannot be made: .*scale"),
        ("--repo_id=a/b", r"policy\.repo_id cannot change an evaluation; what can: .*scale"),
        ("--type=act", r"replay has no option policy\.type"),
    ],
)
def test_overrides_that_cannot_act_are_refused(replay: Path, tmp_path: Path, override: str, message: str) -> None:
    before = listing(tmp_path)
    with pytest.raises(ValueError, match=message) as caught:
        eval_command(EvalConfig(PolicySource(str(replay)), output_dir=tmp_path / "out/eval"), (override,))
    assert "pretrained_path" not in str(caught.value)
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    "override",
    [
        "--optimizer_lr=1", "--dropout=0.5", "--kl_weight=2", "--use_amp=true", "--use_peft=true", "--input_features={}",
        "--pretrained_backbone_weights=null", "--normalization_mapping={}", "--device=cpu",
    ],
)  # fmt: skip
def test_options_without_effect_are_refused(act: Path, override: str) -> None:
    name = override[2:].partition("=")[0]
    message = (
        rf"^policy\.{name} cannot change an evaluation; what can: chunk_size, .*n_action_steps, .*temporal_ensemble"
    )
    with pytest.raises(ValueError, match=message) as caught:
        resolve_config(find_checkpoint(str(act)), (override,))
    assert f" {name}," not in str(caught.value)


def test_options_with_effect_are_taken(act: Path) -> None:
    config = resolve_config(find_checkpoint(str(act)), ("--n_action_steps=3",))
    assert vars(config)["n_action_steps"] == 3


@pytest.mark.parametrize("name", sorted({entry.name for entry in fields(HDRILConfig)}))
def test_each_option_of_hdril_acts_or_is_refused(name: str, hdril: Path) -> None:
    """The policy says which of its options act; that they do is tested with the policy."""
    found = find_checkpoint(str(hdril))
    acting = {
        "experts": "stacked",
        "replan_every": "0",
        "rollout": "open_loop",
        "samples": "0",
        "least_survival": "0.0",
        "repeat_discount": "0.0",
    }
    if name in acting:
        assert str(vars(resolve_config(found, (f"--{name}={acting[name]}",)))[name]) == acting[name]
        return
    message = (
        rf"^policy\.{name} cannot change an evaluation; "
        "what can: experts, least_survival, repeat_discount, replan_every, rollout, samples$"
    )
    with pytest.raises(ValueError, match=message):
        resolve_config(found, (f"--{name}=1",))


def test_options_that_a_policy_declares_anew_are_its_own() -> None:
    """LeRobot's base class has ``n_obs_steps`` and ``use_amp``; diffusion reads the one, ACT reads neither but checks it."""
    register_third_party_plugins()
    known = PreTrainedConfig.get_known_choices()
    assert "n_obs_steps" in running_options(known["diffusion"])
    assert "use_amp" not in running_options(known["diffusion"])
    assert "use_amp" in running_options(known["evo1"])
    assert running_options(known["replay"]) == ["frames", "labels", "primitives", "scale"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("policy", r"^no checkpoint at policy: it should be a folder with config\.json and model\.safetensors$"),
        ("./policy", "^no checkpoint at policy: it should be a folder"),
        ("../policy", r"^no checkpoint at \.\./policy: it should be a folder"),
        ("runs/last/policy", "^no checkpoint at runs/last/policy: it should be a folder"),
        ("/runs", "^no checkpoint at /runs: it should be a folder"),
        ("some/policy", "^no checkpoint at some/policy, and the Hub cannot be asked for such a repository"),
    ],
)
def test_a_checkpoint_that_is_not_there(name: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name of two parts may be a repository of the Hub; any other is a folder."""
    asked = []

    def snapshot_download(repo_id: str, **_: object) -> str:
        asked.append(repo_id)
        raise LocalEntryNotFoundError("offline")

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    with pytest.raises(FileNotFoundError, match=message):
        find_checkpoint(name)
    assert asked == (["some/policy"] if name == "some/policy" else [])


def test_unknown_types_of_policies_are_named(replay: Path) -> None:
    config = replay / "config.json"
    config.write_text(config.read_text().replace('"replay"', '"dreamer"'))
    with pytest.raises(ValueError, match=r"is of a policy of the type 'dreamer'; installed: .*act.*hdril"):
        resolve_config(find_checkpoint(str(replay)))


def test_weights_that_are_missing_or_left_over_are_named(act: Path, dataset: Path, tmp_path: Path) -> None:
    """LeRobot by itself would go on, with random numbers in the place of what is missing."""
    folder, task = save_act(tmp_path / "policy", dataset, None), get_task("table_lift")
    weights = load_file(folder / "model.safetensors")
    save_file({name: value for name, value in weights.items() if name != "model.action_head.bias"},
              folder / "model.safetensors")  # fmt: skip
    with pytest.raises(ValueError, match=r"model\.safetensors does not fit .*model\.action_head\.bias") as caught:
        LeRobotActor(str(folder), task)
    assert "\n" not in str(caught.value)
    save_file(weights | {"model.third_arm": weights["model.action_head.bias"].clone()}, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"does not fit the policy's config: .*model\.third_arm"):
        LeRobotActor(str(folder), task)
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"does not fit the policy's config: .*model\.encoder"):
        LeRobotActor(str(folder), task, ("--n_encoder_layers=2",))
    LeRobotActor(str(folder), task)


def test_overrides_are_told_from_options_of_the_command() -> None:
    ours, theirs = split_overrides(
        ["--policy.path=p", "--policy.rollout=open_loop", "--seed=1", "--policy.device=cuda"]
    )
    assert ours == ["--policy.path=p", "--seed=1", "--policy.device=cuda"]
    assert theirs == ("--rollout=open_loop",)
