"""hdril-view: recordings of runs, of two policies side by side, and of datasets."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.cli.view import ViewConfig, view_command
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.record import record
from hdril.tasks import get_task
from tests.evaluation.checkpoints import experts_episode, save_hdril, save_replay
from tests.evaluation.rerun_text import read_back, states, values_of

SEED = 200_002


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Evaluations of a policy that plays the expert's actions of a seed, which is exact on any processor, and of one that
    stops moving when it should lift. Only failures are recorded."""
    base, trace = tmp_path_factory.mktemp("runs"), experts_episode(SEED)
    labels, primitives = trace.scripted, get_task("table_lift").labels
    still = trace.action.copy()
    first = int(np.flatnonzero(labels == primitives.index("lift"))[0])
    still[first:] = still[first - 1]
    found = {}
    for name, actions in (("whole", trace.action), ("damaged", still)):
        checkpoint = save_replay(base / "policies" / name, actions, primitives=list(primitives), labels=labels.tolist())
        found[name] = base / name / "eval"
        eval_command(
            EvalConfig(PolicySource(str(checkpoint)), num_episodes=1, seed=SEED, workers=1, output_dir=found[name],
                       rerun="failures")
        )  # fmt: skip
    return found


def run_script(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(Path(__file__).parents[2] / "scripts" / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def outcome(run: Path) -> dict:
    return json.loads((run / "results.json").read_text())["per_episode"][0]


@pytest.mark.portable
def test_recording_of_a_damaged_policy_names_the_primitive_that_failed(runs: dict[str, Path]) -> None:
    """The policy that stops moving in lift fails, and everything that tells why points at that primitive."""
    assert outcome(runs["whole"])["success"]
    assert outcome(runs["whole"])["departed_in"] == ""
    damaged = outcome(runs["damaged"])
    assert not damaged["success"]
    assert damaged["departed_in"] == "lift"
    first = 10 + 12  # lift begins after grasp and move
    assert first <= damaged["departed_frame"] < first + 12
    (recording,) = (runs["damaged"] / "rerun").iterdir()
    assert recording.name == f"seed_{SEED:07d}_failure.rrd"
    text = read_back(recording)
    assert "more than 2 cm from the expert's path, in lift" in text
    for entity in ("/primitive/executed", "/planner/lift", "/world/hands/left/plan", "/from_expert_cm/left", "/log"):
        assert f"entity_path: {entity} " in text
    assert "lift" in states(text, "/primitive/executed")
    assert "lift (1)" in (runs["damaged"] / "report.md").read_text()


@pytest.mark.portable
def test_damage_is_to_one_primitive(dataset: Path, tmp_path: Path) -> None:
    whole = save_hdril(tmp_path / "whole", dataset)
    done = run_script("damage.py", whole, tmp_path / "damaged", "lift")
    assert done.returncode == 0, done.stderr
    before, after = (load_file(folder / "model.safetensors") for folder in (whole, tmp_path / "damaged"))
    assert before.keys() == after.keys()
    prefix = f"dynamics.{get_task('table_lift').labels.index('lift')}."
    for name, value in after.items():
        assert torch.equal(value, torch.zeros_like(value) if name.startswith(prefix) else before[name]), name
    assert any(before[name].abs().sum() > 0 for name in before if name.startswith(prefix))


def test_damage_names_what_can_be_damaged(dataset: Path, tmp_path: Path) -> None:
    whole = save_hdril(tmp_path / "whole", dataset)
    done = run_script("damage.py", whole, tmp_path / "x", "juggle")
    assert done.returncode == 1
    assert "no model of its own for 'juggle'; there is one for: grasp, move, lift" in done.stderr
    assert list(tmp_path.iterdir()) == [whole]


def test_a_seed_that_was_not_recorded_is_played_again(runs: dict[str, Path], tmp_path: Path, capsys) -> None:
    assert not (runs["whole"] / "rerun").exists()
    view_command(ViewConfig(run=runs["whole"], seed=SEED, save=tmp_path / "one.rrd"))
    assert f"Seed {SEED} was not recorded: playing it again" in capsys.readouterr().out
    text = read_back(tmp_path / "one.rrd")
    assert f"seed {SEED}: success" in text


def test_two_policies_side_by_side(runs: dict[str, Path], tmp_path: Path) -> None:
    view_command(ViewConfig(run=runs["whole"], against=runs["damaged"], seed=SEED, save=tmp_path / "both.rrd"))
    text = read_back(tmp_path / "both.rrd")
    for player in ("whole", "damaged"):
        for entity in (
            "world/table",
            "world/hands/left/executed",
            "primitive/executed",
            "summary",
        ):
            assert f"entity_path: /{player}/{entity} " in text
        for entity in ("joints/left_s0", "baxter/visual_geometries/head/visual_0"):
            assert f"entity_path: /{player}_robot/{entity} " in text
    # A log may lie in several chunks.
    logs = [part.split("entity_path:")[0] for part in text.split("entity_path: /damaged/log")[1:]]
    assert any("in lift" in log for log in logs)


@pytest.mark.parametrize("seed", [SEED - 1, SEED + 1])
def test_a_seed_that_was_not_evaluated_is_refused(runs: dict[str, Path], tmp_path: Path, seed: int, capsys) -> None:
    """Its episode belongs to no result, and it may be a seed of the training data."""
    message = rf"^seed must be one of those of {runs['whole']}, {SEED} to {SEED}, got {seed}$"
    with pytest.raises(ValueError, match=message):
        view_command(ViewConfig(run=runs["whole"], seed=seed, save=tmp_path / "one.rrd"))
    results = json.loads((runs["whole"] / "results.json").read_text()) | {
        "first_seed": min(seed, SEED),
        "n_episodes": 2,
    }
    (tmp_path / "wider").mkdir()
    (tmp_path / "wider/results.json").write_text(json.dumps(results))
    with pytest.raises(ValueError, match=message):
        view_command(ViewConfig(run=tmp_path / "wider", against=runs["whole"], seed=seed, save=tmp_path / "both.rrd"))
    assert capsys.readouterr().out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["wider"]


def test_recordings_of_a_run_are_saved_as_one_file(runs: dict[str, Path], tmp_path: Path) -> None:
    view_command(ViewConfig(run=runs["damaged"], save=tmp_path / "all.rrd"))
    (recording,) = (runs["damaged"] / "rerun").iterdir()
    assert (tmp_path / "all.rrd").read_bytes() == recording.read_bytes()


def test_without_a_display_it_says_what_to_do(runs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    view_command(ViewConfig(run=runs["damaged"]))
    text = capsys.readouterr().out
    assert "There is no display here" in text
    assert f"rerun {runs['damaged']}/rerun/seed_{SEED:07d}_failure.rrd" in text
    assert "--web" in text


def test_episode_of_a_dataset_is_played_again_with_its_labels(dataset: Path, tmp_path: Path, capsys) -> None:
    view_command(ViewConfig(dataset=dataset, episode=2, save=tmp_path / "episode.rrd"))
    assert "seed 2, played again: its states are 0 m or less from the recorded ones" in capsys.readouterr().out
    text = read_back(tmp_path / "episode.rrd")
    for entity in ("/primitive/scripted", "/robot/joints/left_s0", "/world/table", "/grip_force_N/left"):
        assert f"entity_path: {entity} " in text
    assert states(text, "/primitive/scripted") == {"grasp", "move", "lift", "extend", "place", "retract"}


@pytest.mark.parametrize("noise", [{"perturb": 0.003}, {"stray": 0.01}])
def test_episode_of_a_disturbed_robot_is_played_again_with_its_event(
    noise: dict[str, float], tmp_path: Path, capsys
) -> None:
    """The recorded actions are not what the robot was told, and the table was pushed."""
    task = "table_lift:push=1"
    provenance = record(Recipe(task, **noise), 1, 930_000, tmp_path / "dataset")
    view_command(ViewConfig(dataset=tmp_path / "dataset", save=tmp_path / "episode.rrd"))
    (seed,) = provenance.seeds
    assert f"seed {seed}, played again: its states are 0 m or less from the recorded ones" in capsys.readouterr().out
    (event,) = get_task(task).sample(seed).events
    assert str(event) in values_of(tmp_path / "episode.rrd", "/log", "TextLog:text")


def test_dataset_that_hdril_did_not_record(dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    (copy / "meta/hdril.json").unlink()
    view_command(ViewConfig(dataset=copy, save=tmp_path / "foreign.rrd"))
    text = read_back(tmp_path / "foreign.rrd")
    for entity in ("/primitive/scripted", "/action/left_ee.x", "/world/observation.environment_state/table"):
        assert f"entity_path: {entity} " in text


def test_reruns_own_loader_shows_the_labels(dataset: Path, tmp_path: Path) -> None:
    """``rerun <dataset>``: the dataset opens in Rerun's own LeRobot loader, labels as text."""
    rerun = Path(sys.executable).with_name("rerun")
    saved = tmp_path / "loaded.rrd"
    subprocess.run([rerun, str(dataset), "--save", str(saved)], check=True, capture_output=True, timeout=300)
    text = read_back(saved)
    assert "grasp" in text
    assert "retract" in text
    assert "observation.state" in text


def test_lerobots_viewer_takes_the_dataset(dataset: Path, tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("lerobot-dataset-viz")
    subprocess.run(
        [program, "--repo-id=hdril/test", f"--root={dataset}", "--episode-index=1", "--save=1", "--num-workers=0",
         f"--output-dir={tmp_path}"],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    (saved,) = tmp_path.glob("*.rrd")
    text = read_back(saved)
    for entity in ("/action", "/state", "/next.success"):
        assert f"entity_path: {entity} " in text


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"run": None}, ValueError, "either --run .* or --dataset"),
        ({"dataset": Path("x")}, ValueError, "either --run .* or --dataset"),
        ({"against": Path("x")}, ValueError, "on one seed: give --run and --seed"),
        ({"run": Path("no/such")}, FileNotFoundError, r"no/such holds no results\.json"),
        ({"save": Path("x.mp4")}, ValueError, r"must end in \.rrd, got x\.mp4"),
        ({"run": None, "dataset": Path("no/such")}, FileNotFoundError, "no/such is no LeRobot dataset"),
    ],
)
def test_refusals(change: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        view_command(replace(ViewConfig(run=Path("run")), **change))


def test_what_is_not_there_is_named(runs: dict[str, Path], dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"show any of its seeds, {SEED} to {SEED}, with --seed"):
        view_command(ViewConfig(run=runs["whole"]))
    with pytest.raises(ValueError, match="no episode 6; its episodes are 0 to 5"):
        view_command(ViewConfig(dataset=dataset, episode=6, save=tmp_path / "x.rrd"))
    (tmp_path / "there.rrd").touch()
    with pytest.raises(FileExistsError, match="choose another file"):
        view_command(ViewConfig(dataset=dataset, save=tmp_path / "there.rrd"))
