"""Held-out seeds: known from records or from the data themselves; otherwise said to be unknown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.demonstrations.provenance import read_provenance
from hdril.digest import digest_json
from hdril.evaluation.checkpoint import Checkpoint, find_checkpoint
from hdril.evaluation.held_out import check_held_out
from tests.evaluation.checkpoints import listing, save_act, save_hdril, save_replay

LEARNED = {
    "digest": "d" * 64, "repo_id": "a/b", "task": "table_lift", "recipe": "e" * 64, "episodes": [[0, 3]],
    "seeds": [[10, 12], [20, 20]], "fitted": 4,
}  # fmt: skip


def checkpoint_with(folder: Path, *records: dict) -> Checkpoint:
    return find_checkpoint(str(save_replay(folder, np.zeros((1, 16)), training_data=list(records))))


def test_seeds_are_compared_with_the_checkpoints_record(tmp_path: Path) -> None:
    checkpoint = checkpoint_with(tmp_path / "c", LEARNED)
    held_out = check_held_out(checkpoint, "table_lift", [13, 14, 19, 21])
    assert held_out.known is True
    assert held_out.basis == "compared with the seeds of the training data, recipe eeeeeeeeeeee"
    for seed in (10, 12, 20):
        with pytest.raises(
            ValueError, match=rf"1 of 2 seeds \({seed} to {seed}\).*seeds 10 to 20; choose a seed above 20"
        ):
            check_held_out(checkpoint, "table_lift", [seed, 30])
    with pytest.raises(ValueError, match="were in the training data"):
        check_held_out(checkpoint, "table_lift:x=1", [10])
    with pytest.raises(ValueError, match="trained on the task table_lift, not on peg_in_hole"):
        check_held_out(checkpoint, "peg_in_hole", [99])
    with pytest.raises(ValueError, match="records what it was trained on: leave out training_data"):
        check_held_out(checkpoint, "table_lift", [99], tmp_path)


@pytest.mark.parametrize("missing", [{"digest": ""}, {"seeds": None}], ids=["digest", "seeds"])
def test_incomplete_records_claim_nothing_but_refuse_what_they_know(tmp_path: Path, missing: dict) -> None:
    checkpoint = checkpoint_with(tmp_path / "c", LEARNED, LEARNED | missing)
    held_out = check_held_out(checkpoint, "table_lift", [99])
    assert held_out.known is None
    assert held_out.basis == "the checkpoint has no record of the seeds of all its training data"
    with pytest.raises(ValueError, match="were in the training data"):
        check_held_out(checkpoint, "table_lift", [11])


def test_seeds_of_another_task_are_others(tmp_path: Path) -> None:
    """A policy that was trained on two tasks: seed 11 of the one says nothing of seed 11 of the other."""
    other = LEARNED | {"task": "peg_in_hole:clearance=0.004", "seeds": [[30, 40]]}
    checkpoint = checkpoint_with(tmp_path / "c", LEARNED, other)
    assert check_held_out(checkpoint, "table_lift", [30]).known
    assert check_held_out(checkpoint, "peg_in_hole", [11]).known
    with pytest.raises(ValueError, match="were in the training data"):
        check_held_out(checkpoint, "peg_in_hole", [30])
    with pytest.raises(ValueError, match=r"trained on the task peg_in_hole, table_lift, not on stacking$"):
        check_held_out(checkpoint, "stacking", [99])


def test_each_recipe_is_named_once(tmp_path: Path) -> None:
    checkpoint = checkpoint_with(tmp_path / "c", LEARNED, LEARNED | {"recipe": "f" * 64}, LEARNED)
    basis = check_held_out(checkpoint, "table_lift", [99]).basis
    assert basis == f"compared with the seeds of the training data, recipes {'e' * 12}, {'f' * 12}"


def test_hdril_refuses_training_seeds_from_any_folder(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The dataset is not needed: what the checkpoint learned from is in it, seed by seed."""
    folder = save_hdril(tmp_path / "policy", dataset, episodes=(0, 1, 5))
    (folder / "train_config.json").unlink()
    monkeypatch.chdir(tmp_path)
    config = EvalConfig(PolicySource("policy"), num_episodes=1, seed=5, output_dir=tmp_path / "eval")
    before = listing(tmp_path)
    with pytest.raises(ValueError, match=r"1 of 1 seeds \(5 to 5\) were in the training data"):
        eval_command(config)
    assert listing(tmp_path) == before
    provenance = read_provenance(dataset)
    assert provenance is not None
    held_out = check_held_out(find_checkpoint("policy"), "table_lift", [3, 4])  # episodes that it never saw
    assert held_out.known
    assert provenance.recipe_digest[:12] in held_out.basis


def test_other_policies_are_known_by_the_statistics_of_their_data(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = find_checkpoint(str(save_act(tmp_path / "run/train/pretrained_model", dataset, "data/set")))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)

    def known() -> bool | None:
        return check_held_out(checkpoint, "table_lift", [77]).known

    assert known() is None
    shutil.copytree(dataset, tmp_path / "run/data/set")  # a folder above the checkpoint is where training ran
    assert known() is True
    with pytest.raises(ValueError, match=r"\(5 to 5\) were in the training data, which are seeds 0 to 5"):
        check_held_out(checkpoint, "table_lift", [5])
    shutil.move(tmp_path / "run/data", elsewhere / "data")  # the folder from which the command is run
    assert known() is True
    # Recorded anew at the same place: no longer what the policy saw, and nothing is claimed of it.
    stats = elsewhere / "data/set/meta/stats.json"
    values = json.loads(stats.read_text())
    values["action"]["mean"][3] += 1e-4
    stats.write_text(json.dumps(values))
    assert known() is None
    with pytest.raises(
        ValueError, match=r"data/set is not the data set that .* was trained on: its action\.mean differs"
    ):
        check_held_out(checkpoint, "table_lift", [77], Path("data/set"))
    assert check_held_out(checkpoint, "table_lift", [77], dataset).known is True  # named by hand
    with pytest.raises(ValueError, match="were in the training data"):
        check_held_out(checkpoint, "table_lift", [5], dataset)
    (tmp_path / "foreign").mkdir()
    shutil.copytree(dataset / "meta", tmp_path / "foreign/meta")
    (tmp_path / "foreign/meta/hdril.json").unlink()
    foreign = check_held_out(checkpoint, "table_lift", [77], tmp_path / "foreign")
    assert (foreign.known, foreign.basis) == (None, "the training data have no record of seeds")


def test_data_of_another_version_of_hdril_tell_their_seeds(dataset: Path, tmp_path: Path) -> None:
    """A recipe that this version cannot play is no reason to forget which seeds a policy has seen."""
    checkpoint = find_checkpoint(str(save_act(tmp_path / "policy", dataset, None)))
    data = tmp_path / "data"
    shutil.copytree(dataset / "meta", data / "meta")
    record = data / "meta/hdril.json"
    told = json.loads(record.read_text())
    del told["dropped"]
    told["recipe"] |= {"hdril_version": "9.0", "weather": "rain"}
    told["recipe"]["physics"] = {"wind": 3.0}
    record.write_text(json.dumps(told))
    held_out = check_held_out(checkpoint, "table_lift", [77], data)
    assert (held_out.known, held_out.basis) == (
        True, f"compared with the seeds of the training data, recipe {digest_json(told['recipe'])[:12]}"
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"1 of 1 seeds \(5 to 5\) were in the training data"):
        check_held_out(checkpoint, "table_lift", [5], data)
    with pytest.raises(ValueError, match="trained on the task table_lift, not on peg_in_hole"):
        check_held_out(checkpoint, "peg_in_hole", [77], data)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"seeds": None}, "has no list of seeds"),
        ({"seeds": []}, "has no list of seeds"),
        ({"seeds": ["5"]}, "has no list of seeds"),
        ({"recipe": None}, "does not name the task of its seeds"),
        ({"recipe": {"task": 3}}, "does not name the task of its seeds"),
    ],
)
def test_data_that_do_not_tell_their_seeds_claim_nothing(
    dataset: Path, tmp_path: Path, change: dict, reason: str
) -> None:
    checkpoint = find_checkpoint(str(save_act(tmp_path / "policy", dataset, None)))
    record = Path(shutil.copytree(dataset / "meta", tmp_path / "data/meta")) / "hdril.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | change))
    held_out = check_held_out(checkpoint, "table_lift", [77], tmp_path / "data")
    assert (held_out.known, held_out.basis) == (None, f"meta/hdril.json of the training data {reason}")
    record.write_text("{")
    with pytest.raises(ValueError, match=r"data/meta/hdril\.json is not valid JSON"):
        check_held_out(checkpoint, "table_lift", [77], tmp_path / "data")


def test_data_without_statistics_to_compare_are_not_taken_for_the_training_data(dataset: Path, tmp_path: Path) -> None:
    """The processors of this checkpoint keep no numbers: any data set would agree with them."""
    checkpoint = checkpoint_with(tmp_path / "c")
    with pytest.raises(ValueError, match="the checkpoint's processors keep no statistics to compare"):
        check_held_out(checkpoint, "table_lift", [77], dataset)
    assert check_held_out(checkpoint, "table_lift", [77]).known is None


def test_data_of_the_hub_are_looked_for_where_lerobot_keeps_them(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training that was given no folder, but the name of a repository."""
    monkeypatch.setattr("lerobot.utils.constants.HF_LEROBOT_HOME", tmp_path / "home")
    checkpoint = find_checkpoint(str(save_act(tmp_path / "policy", dataset, None)))
    assert check_held_out(checkpoint, "table_lift", [77]).known is None
    shutil.copytree(dataset, tmp_path / "home/hdril/test")
    assert check_held_out(checkpoint, "table_lift", [77]).known is True


def test_what_was_fine_tuned_is_not_known(dataset: Path, tmp_path: Path) -> None:
    """LeRobot overwrites the statistics of the first training: those of the last say nothing of its seeds."""
    folder = save_act(tmp_path / "policy", dataset, str(dataset))
    assert check_held_out(find_checkpoint(str(folder)), "table_lift", [500]).known is True
    config = json.loads((folder / "config.json").read_text()) | {"pretrained_path": "user/base"}
    (folder / "config.json").write_text(json.dumps(config))
    held_out = check_held_out(find_checkpoint(str(folder)), "table_lift", [500], dataset)
    assert held_out.known is None
    assert held_out.basis.startswith("training went on from user/base")
