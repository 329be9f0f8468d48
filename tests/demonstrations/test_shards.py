"""Episodes of an unfinished recording come back as they were, and what cannot be read is made again."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import hdril.demonstrations.shards
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.shards import Shards
from hdril.tasks.primitives import Noise

RECIPE = Recipe("table_lift")


def assert_equal(one: Episode, two: Episode) -> None:
    for entry in fields(Episode):
        ours, theirs = getattr(one, entry.name), getattr(two, entry.name)
        assert type(ours) is type(theirs), entry.name
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype, entry.name
            np.testing.assert_array_equal(ours, theirs, err_msg=entry.name)
        else:
            assert ours == theirs, entry.name


def test_episodes_come_back_as_they_were(made_up, tmp_path: Path) -> None:
    kept = [made_up(3), made_up(4, frames=5, success=False)]
    shards = Shards(tmp_path, RECIPE, 3)
    for episode in kept:
        shards.put(episode)
    back = list(Shards(tmp_path, RECIPE, 3).take())
    assert len(back) == 2
    for one, two in zip(kept, back, strict=True):
        assert_equal(one, two)


def test_only_episodes_and_the_plan_are_there(made_up, tmp_path: Path) -> None:
    shards = Shards(tmp_path, RECIPE, 0)
    shards.put(made_up(0))
    shards.put(made_up(0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.npz", "plan.json"]


def test_episodes_are_taken_up_to_the_first_gap(made_up, tmp_path: Path) -> None:
    shards = Shards(tmp_path, RECIPE, 5)
    for seed in (4, 5, 6, 8):
        shards.put(made_up(seed))
    assert [episode.seed for episode in shards.take()] == [5, 6]


@pytest.mark.parametrize(
    "damage", ["empty", "garbage", "truncated", "method", "of another seed", "incomplete", "ragged"]
)
def test_what_cannot_be_read_is_named_and_made_again(damage: str, made_up, tmp_path: Path, capsys) -> None:
    shards = Shards(tmp_path, RECIPE, 0)
    for seed in (0, 1, 2):
        shards.put(made_up(seed))
    path = tmp_path / "1.npz"
    whole = path.read_bytes()
    if damage == "of another seed":
        shutil.copy(tmp_path / "2.npz", path)
    elif damage == "incomplete":
        with np.load(path) as data:
            np.savez(path, **{name: data[name] for name in data if name != "action"})
    elif damage == "ragged":
        shards.put(replace(made_up(1), action=made_up(1).action[:-1]))
    else:
        method = whole.index(b"PK\x01\x02") + 10  # of compression, in the archive's directory
        changed = whole[:method] + b"\x63" + whole[method + 1 :]
        half = whole[: len(whole) // 2]
        path.write_bytes({"empty": b"", "garbage": b"no episode", "truncated": half, "method": changed}[damage])
    assert [episode.seed for episode in shards.take()] == [0]
    assert f"{path} is damaged: " in capsys.readouterr().out
    shards.put(made_up(1))
    assert [episode.seed for episode in shards.take()] == [0, 1, 2]


def test_another_plan_is_refused_and_changes_nothing(made_up, tmp_path: Path, monkeypatch) -> None:
    Shards(tmp_path, RECIPE, 0).put(made_up(0))
    plan = (tmp_path / "plan.json").read_text()
    with pytest.raises(ValueError, match="another recipe"):
        Shards(tmp_path, RECIPE, 1)
    with pytest.raises(ValueError, match="another recipe"):
        Shards(tmp_path, replace(RECIPE, noise=Noise(0.0)), 0)
    with monkeypatch.context() as patch:
        patch.setattr(hdril.demonstrations.shards, "__version__", "0.0.9")
        with pytest.raises(ValueError, match="another recipe"):
            Shards(tmp_path, RECIPE, 0)
    assert (tmp_path / "plan.json").read_text() == plan
    assert [episode.seed for episode in Shards(tmp_path, RECIPE, 0).take()] == [0]
