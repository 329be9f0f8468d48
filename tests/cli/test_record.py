"""hdril-record as a user runs it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.utils.constants import HF_LEROBOT_HOME

from hdril import __version__
from hdril.cli.record import RecordConfig, default_root, record_command
from hdril.demonstrations.labels import add_words
from hdril.demonstrations.provenance import Provenance, Recipe, read_provenance
from hdril.demonstrations.write import write_dataset
from tests.cli.commands import refuse, start, succeed


def test_ctrl_c_stops_cleanly_and_the_same_command_goes_on(tmp_path: Path) -> None:
    """While it records, a second command on the same root is refused."""
    root = tmp_path / "set"
    command = ["hdril-record", f"--root={root}", "--workers=2"]
    process = start(*command, "--num_episodes=5000", stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("set.partial/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.1)
    try:
        assert refuse(*command).startswith(f"another process is recording to {root}")
    finally:
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Run the same command again to go on" in out
    assert not root.exists()
    text = succeed(*command, "--num_episodes=4")
    assert "4 episodes (seeds 0 to 3)" in text
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_dataset_that_stays_here_needs_no_name(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    record_command(RecordConfig(num_episodes=1, workers=1))
    assert "1 episodes (seeds 0 to 0) in outputs/table_lift/dataset, 0 of 1 dropped" in capsys.readouterr().out
    provenance = read_provenance(tmp_path / "outputs/table_lift/dataset")
    assert provenance is not None
    assert provenance.seeds == (0,)


def test_where_a_dataset_goes_unless_the_user_says() -> None:
    assert default_root("table_lift", "user/name") == HF_LEROBOT_HOME / "user/name"
    assert default_root("peg_in_hole", None) == Path("outputs/peg_in_hole/dataset")
    assert default_root("peg_in_hole:clearance=0.004", None) == Path("outputs/peg_in_hole_clearance_0.004/dataset")


@pytest.fixture
def pushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names that were published to; nothing leaves this machine."""
    names: list[str] = []
    monkeypatch.setattr("hdril.hub.publish.publish", lambda repo_id, *_: names.append(repo_id))
    return names


def test_a_dataset_whose_first_seed_was_dropped_is_known_again(made_up, pushed: list[str], tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_dataset(root, Provenance(Recipe("table_lift"), (6, 7), {5: "table upright"}), [made_up(6), made_up(7)])
    record_command(RecordConfig(repo_id="user/name", num_episodes=2, seed=5, root=root, push=True))
    assert pushed == ["user/name"]
    for other in ({"seed": 6}, {"num_episodes": 3}, {"task": "peg_in_hole"}):
        options: dict[str, Any] = {"num_episodes": 2, "seed": 5} | other
        with pytest.raises(FileExistsError, match="holds something else"):
            record_command(RecordConfig(repo_id="user/name", root=root, push=True, **options))
    assert pushed == ["user/name"]


def test_a_dataset_with_other_labels_is_not_published_as_what_was_asked_for(
    made_up, pushed: list[str], tmp_path: Path
) -> None:
    root = tmp_path / "set"
    write_dataset(root, Provenance(Recipe("table_lift"), (5,)), [made_up(5)])

    def push(labels: str) -> None:
        record_command(RecordConfig(repo_id="user/name", num_episodes=1, seed=5, root=root, push=True, labels=labels))

    with pytest.raises(
        FileExistsError, match="has labels in subtask_index, not in language,subtask_index; give --labels="
    ):
        push("language,subtask_index")
    assert pushed == []
    add_words(root)
    push("language,subtask_index")
    with pytest.raises(FileExistsError, match="not in subtask_index; give --labels=subtask_index,language, or choose"):
        push("subtask_index")
    assert pushed == ["user/name"]


def test_a_dataset_of_another_version_is_not_published_as_made_by_this_one(
    made_up, pushed: list[str], tmp_path: Path
) -> None:
    root = tmp_path / "set"
    write_dataset(root, Provenance(Recipe("table_lift"), (5,), hdril_version="0.0.9"), [made_up(5)])
    with pytest.raises(FileExistsError, match=rf"was recorded by hdril 0\.0\.9, not by {re.escape(__version__)}"):
        record_command(RecordConfig(repo_id="user/name", num_episodes=1, seed=5, root=root, push=True))
    assert pushed == []


@pytest.mark.parametrize("path", sorted(Path("configs/record").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_recipe_can_be_recorded_and_names_its_own_command(path: Path) -> None:
    config = draccus.parse(RecordConfig, config_path=path, args=[])
    recipe = Recipe(config.task, config.noise, perturb=config.perturb, stray=config.stray)
    assert recipe.make_env().task == config.task
    assert path.read_text().startswith(f"# hdril-record --config_path={path.as_posix()}\n")
    assert config.root == Path("outputs") / path.stem / "dataset"
    assert ("level=hard" in config.task) == path.stem.endswith("_hard") == bool(config.perturb)
