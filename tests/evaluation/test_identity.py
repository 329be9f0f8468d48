"""Results are of weights, scenes and software: whatever differs is named, and refused."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import zipfile
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.digest import digest_json
from hdril.evaluation.checkpoint import find_checkpoint, identify, resolve_config
from hdril.evaluation.evaluate import Job, Worker, make_job
from hdril.evaluation.identity import Identity, differences, identify_trials, require_same
from hdril.evaluation.journal import Journal
from hdril.evaluation.score import Outcome
from hdril.evaluation.software import _plugin_digest, episode_software, evaluation_software
from hdril.evaluation.stored import read_evaluation
from tests.evaluation.checkpoints import listing, save_replay

SEED = 500_000
STILL = np.tile(np.eye(16, dtype=np.float32)[6] + np.eye(16, dtype=np.float32)[14], (3, 1))


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A policy whose hands keep still, as LeRobot's training leaves it: ``last`` is a link."""
    folder = save_replay(tmp_path / "checkpoints/000100/pretrained_model", STILL)
    (tmp_path / "checkpoints/last").symlink_to("000100")
    return tmp_path / "checkpoints/last" / folder.name


def overwrite(checkpoint: Path) -> None:
    """What training does to the checkpoint that it saves next."""
    save_replay(checkpoint.resolve(), STILL + 0.25)


def job_of(checkpoint: Path, **options) -> Job:
    return make_job("table_lift", str(checkpoint), SEED, 2, **options)


def outcome(seed: int, success: bool = True) -> Outcome:
    return Outcome(seed, success, "", 70, 0, 0.1, 0.01, 0.1, {"grasp": 0.1}, (0.5, 0.0), primitives=("grasp",))


def finish(job: Job, output: Path, success: bool = True, against: Path | None = None) -> Path:
    """An evaluation as it lies on disk when it is finished, made without playing."""
    from hdril.cli.eval import describe
    from hdril.evaluation.held_out import HeldOut
    from hdril.evaluation.report import write_report
    from hdril.evaluation.results import compare

    journal = Journal(output, job.identity)
    with journal.writing() as add:
        for seed in job.seeds:
            add(outcome(seed, success))
    outcomes = list(journal.done.values())
    other = None if against is None else compare("other", outcomes, read_evaluation(against).results)
    write_report(journal.folder, describe(job, HeldOut(None, "it is a test")), outcomes, other)
    journal.finish()
    return output


def test_identity_is_of_content_not_of_places(checkpoint: Path, tmp_path: Path) -> None:
    first = job_of(checkpoint).identity
    elsewhere = save_replay(tmp_path / "elsewhere", STILL)
    assert job_of(elsewhere).identity == first
    config = json.loads((elsewhere / "config.json").read_text())
    (elsewhere / "config.json").write_text(json.dumps(config | {"repo_id": "a/b", "tags": ["x"], "push_to_hub": True}))
    assert job_of(elsewhere).identity == first
    assert json.loads(json.dumps(first.as_dict())) == first.as_dict()


def test_each_part_of_a_checkpoint_counts(checkpoint: Path, tmp_path: Path) -> None:
    first = job_of(checkpoint).identity.as_dict()

    def changed(**options) -> list[str]:
        return [line.split(" (")[0] for line in differences(first, job_of(checkpoint, **options).identity.as_dict())]

    assert changed() == []
    assert changed(overrides=("--scale=2.0",)) == ["config"]
    assert changed(overrides=("--scale=1.0",)) == []  # the value that it has already
    assert changed(max_frames=90) == ["max frames"]
    pipeline = checkpoint / "policy_postprocessor.json"
    pipeline.write_text(pipeline.read_text() + "\n")
    assert changed() == ["processors"]
    overwrite(checkpoint)
    assert "weights" in changed()


def test_task_is_compared_by_its_parameters() -> None:
    default = identify_trials("peg_in_hole", 0, 10)
    assert identify_trials("peg_in_hole:clearance=0.005", 0, 10) == default
    (line,) = differences(vars(default), vars(identify_trials("peg_in_hole:clearance=0.004", 0, 10)))
    assert line == "parameters clearance (0.005 there, 0.004 here)"
    assert differences(vars(default), vars(identify_trials("peg_in_hole", 1, 10))) == ["first seed (0 there, 1 here)"]


def test_digest_of_json_is_that_of_its_canonical_form() -> None:
    """Sorted keys and no spaces, whatever the order in which a dictionary was made."""
    expected = hashlib.sha256(b'{"a":[1,2.5],"b":{"c":null,"d":true}}').hexdigest()
    assert digest_json({"b": {"d": True, "c": None}, "a": [1, 2.5]}) == expected


def test_software_is_what_is_installed() -> None:
    """A task of this package has no source of its own: the digest behind hdril's version is of that, too."""
    software = evaluation_software("table_lift")
    packages = ("pybullet", "numpy", "scipy", "dtaidistance")
    assert {name: software.pop(name) for name in packages} == {name: version(name) for name in packages}
    assert set(software) == {"hdril", "robot model"}
    assert re.fullmatch(rf"{re.escape(version('hdril'))} \([0-9a-f]{{12}}\)", software["hdril"])
    robot = re.escape(f"baxter of example-robot-data {version('example-robot-data')}")
    assert re.fullmatch(rf"{robot} \([0-9a-f]{{12}}\)", software["robot model"])


def installed(site: Path, task: str, value: str, files: dict[str, str]) -> None:
    """What an installer leaves of a distribution that declares a task."""
    for name, content in files.items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(content)
    info = site / f"{task}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {task}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[hdril.tasks]\n{task} = {value}\n")


@pytest.mark.parametrize(
    ("value", "folder"),
    [
        ("stack_a.deep.task", "stack_a"),
        ("stack_b.deep.task:PLUGIN", "stack_b"),  # an object, not a module: what it is made of is in the package, too
        ("many_firms.stack_c.task", "many_firms/stack_c"),  # a namespace package: others have modules in it
    ],
)
def test_a_task_of_another_package_counts_by_all_its_files(
    value: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = f"stacking_{folder[-1]}"
    inner = value.partition(":")[0].replace(".", "/")
    files = {f"{folder}/__init__.py": "", f"{folder}/sizes.py": "WIDTH = 1", f"{folder}/cup.obj": "v 0 0 0"}
    files |= {f"{inner}.py": "TASK = None", str(Path(inner).parent / "__init__.py"): ""}
    installed(tmp_path, task, value, files | {"many_firms/other/unrelated.py": ""})
    monkeypatch.syspath_prepend(tmp_path)

    def source() -> str:
        _plugin_digest.cache_clear()
        return episode_software(task)[f"source of {task}"]

    first, seen = source(), set[str]()
    (tmp_path / "many_firms/other/unrelated.py").write_text("X = 1")
    (tmp_path / folder / "__pycache__").mkdir()
    (tmp_path / folder / "__pycache__/sizes.cpython-312.pyc").write_text("bytecode")
    assert source() == first
    for name in (f"{inner}.py", f"{folder}/sizes.py", f"{folder}/cup.obj"):
        (tmp_path / name).write_text("another")
        seen.add(source())
    assert len(seen | {first}) == 4


def test_a_task_in_a_single_module_counts_by_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(tmp_path, "stacking", "stacking_alone", {"stacking_alone.py": "TASK = None", "another.py": ""})
    monkeypatch.syspath_prepend(tmp_path)
    content = hashlib.sha256(b"TASK = None").hexdigest()
    expected = hashlib.sha256(f"{content} stacking_alone.py\n".encode()).hexdigest()[:12]
    assert episode_software("stacking")["source of stacking"] == expected


def test_a_task_whose_files_cannot_be_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package in an archive can be imported, but has no files to tell it by."""
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as archive:
        archive.writestr("packed_tasks/__init__.py", "")
        archive.writestr("packed_tasks/stack.py", "TASK = None")
    monkeypatch.syspath_prepend(tmp_path / "packed.zip")
    installed(tmp_path / "site", "packed", "packed_tasks.stack", {})
    monkeypatch.syspath_prepend(tmp_path / "site")
    with pytest.raises(
        ValueError, match=r"^the task 'packed' comes from packed_tasks\.stack, whose files cannot be read: "
    ):
        episode_software("packed")


def test_digests_are_shown_short_and_missing_records_are_said() -> None:
    there, here = {"weights": "a" * 64}, {"weights": "b" * 64}
    with pytest.raises(ValueError, match=r"^x holds results of other weights \(a{12} there, b{12} here\); do y$"):
        require_same("x", there, here, "do y")
    require_same("x", here, here, "do y")
    with pytest.raises(ValueError, match="x has no record of what made its results"):
        require_same("x", {}, here, "do y")


def test_max_frames_below_the_horizon_are_refused() -> None:
    assert identify_trials("table_lift", 0, 1).max_frames == 70
    assert identify_trials("table_lift", 0, 1, 71).max_frames == 71
    with pytest.raises(ValueError, match=r"max_frames must be at least 70, the horizon of table_lift.*; got 69"):
        identify_trials("table_lift", 0, 1, 69)


# ---------------------------------------------------------------- going on, comparing, publishing


def test_going_on_keeps_what_was_played(checkpoint: Path, tmp_path: Path) -> None:
    job = job_of(checkpoint)
    journal = Journal(tmp_path / "eval", job.identity)
    played = replace(outcome(SEED), events=((3, "push"),), noticed=((14, "grasp tried again"),))
    with journal.writing() as add:
        add(played)
    with (journal.folder / "outcomes.jsonl").open("a") as file:
        file.write('{"seed": 500001, "succ')  # killed in the middle of a line
    assert Journal(tmp_path / "eval", job.identity).done == {SEED: played}


def test_going_on_with_other_weights_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    with Journal(tmp_path / "eval", job_of(checkpoint).identity).writing() as add:
        add(outcome(SEED))
    overwrite(checkpoint)
    before = listing(tmp_path)
    with pytest.raises(ValueError, match=r"eval\.partial holds results of other weights \(\w{12} there, \w{12} here\)"):
        eval_command(EvalConfig(PolicySource(str(checkpoint)), num_episodes=2, seed=SEED, output_dir=tmp_path / "eval"))
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("part", "name", "words"),
    [("policy", "torch", "torch"), ("trials", "pybullet", "pybullet"), ("trials", "robot model", "robot model")],
)
def test_going_on_with_other_software_is_refused(
    checkpoint: Path, tmp_path: Path, part: str, name: str, words: str
) -> None:
    identity = job_of(checkpoint).identity
    with Journal(tmp_path / "eval", identity).writing() as add:
        add(outcome(SEED))
    path = tmp_path / "eval.partial/run.json"
    stored = json.loads(path.read_text())
    stored["identity"][part]["software"][name] = "0.0.0"
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=rf"holds results of other {words} \(0\.0\.0 there, .* here\); delete it"):
        Journal(tmp_path / "eval", identity)


def test_only_one_process_writes(checkpoint: Path, tmp_path: Path) -> None:
    from hdril.files import BusyError

    identity = job_of(checkpoint).identity
    with Journal(tmp_path / "eval", identity).writing() as add:
        with (  # before there is an outcome: what the first has begun must stay
            pytest.raises(BusyError, match="another process is evaluating into"),
            Journal(tmp_path / "eval", identity).writing(),
        ):
            pass
        add(outcome(SEED))
    assert Journal(tmp_path / "eval", identity).done


def test_what_another_process_did_in_between_counts(checkpoint: Path, tmp_path: Path) -> None:
    """Two processes look at the folder before either has the lock: the later one must see what the earlier one wrote."""
    identity = job_of(checkpoint).identity
    later, latest = Journal(tmp_path / "eval", identity), Journal(tmp_path / "eval", identity)
    with Journal(tmp_path / "eval", identity).writing() as add:
        add(outcome(SEED))
    with later.writing() as add:
        assert later.done == {SEED: outcome(SEED)}
        add(outcome(SEED + 1))
        later.finish()
    before = listing(tmp_path)
    with pytest.raises(FileExistsError, match=r"eval exists; choose another output_dir"), latest.writing():
        pass
    assert listing(tmp_path) == before


def test_failing_before_the_first_outcome_leaves_nothing(checkpoint: Path, tmp_path: Path) -> None:
    before = listing(tmp_path)
    with pytest.raises(ZeroDivisionError), Journal(tmp_path / "a/b/eval", job_of(checkpoint).identity).writing():
        raise ZeroDivisionError
    assert listing(tmp_path) == before


def test_another_evaluation_that_began_in_between_is_left_alone(checkpoint: Path, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "eval", job_of(checkpoint).identity)
    with Journal(tmp_path / "eval", job_of(checkpoint, overrides=("--scale=2.0",)).identity).writing() as add:
        add(outcome(SEED))
    before = listing(tmp_path)
    with pytest.raises(ValueError, match=r"eval\.partial holds results of other config"), journal.writing():
        pass
    assert listing(tmp_path) == before


def test_outcomes_that_cannot_be_read_are_left_alone(checkpoint: Path, tmp_path: Path) -> None:
    """They came in between, so that this process knows of none."""
    identity = job_of(checkpoint).identity
    late = Journal(tmp_path / "eval", identity)
    with Journal(tmp_path / "eval", identity).writing() as add:
        add(outcome(SEED))
    (late.folder / "outcomes.jsonl").write_text('{"seed": 500001}\n')
    before = listing(tmp_path)
    with pytest.raises(ZeroDivisionError), late.writing():
        raise ZeroDivisionError
    assert listing(tmp_path) == before


def test_what_is_evaluated_is_written_whole_or_not_at_all(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full while ``run.json`` is written anew: the outcomes of before must not lose what they are of."""
    identity = job_of(checkpoint).identity
    with Journal(tmp_path / "eval", identity).writing() as add:
        add(outcome(SEED))
    written = (tmp_path / "eval.partial/run.json").read_bytes()

    def replace_fails(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", replace_fails)
        with pytest.raises(OSError, match="no space left"), Journal(tmp_path / "eval", identity).writing():
            pass
    assert (tmp_path / "eval.partial/run.json").read_bytes() == written
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_folder_of_something_else_is_left_alone(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "eval.partial").mkdir()
    (tmp_path / "eval.partial/notes.txt").touch()
    with pytest.raises(FileExistsError, match="is no evaluation"):
        Journal(tmp_path / "eval", job_of(checkpoint).identity)


def test_pushing_after_the_weights_were_overwritten_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    """Evaluate ``last``, train on, push: the Hub is not even asked (it is offline here)."""
    output = finish(job_of(checkpoint), tmp_path / "eval")
    overwrite(checkpoint)
    before = listing(tmp_path)
    config = EvalConfig(PolicySource(str(checkpoint)), num_episodes=2, seed=SEED, output_dir=output, push="a/b")
    with pytest.raises(ValueError, match=r"eval holds results of other weights .*; evaluate again or choose another"):
        eval_command(config)
    assert listing(tmp_path) == before


def test_weights_that_change_during_an_evaluation_are_not_published(checkpoint: Path, tmp_path: Path) -> None:
    from hdril.hub.evaluations import publish_evaluation

    job = job_of(checkpoint)
    evaluation = read_evaluation(finish(job, tmp_path / "eval"))
    overwrite(checkpoint)
    with pytest.raises(ValueError, match="holds results of other weights"):
        publish_evaluation("a/b", job, evaluation, private=True)


def test_a_link_is_followed_once(checkpoint: Path, tmp_path: Path) -> None:
    """Training moves ``last`` to its next checkpoint: the evaluation goes on with the one that it began with."""
    job = job_of(checkpoint)
    save_replay(tmp_path / "checkpoints/000200/pretrained_model", STILL + 0.25)
    (tmp_path / "checkpoints/last").unlink()
    (tmp_path / "checkpoints/last").symlink_to("000200")
    Worker(job).env.close()
    assert job_of(checkpoint).identity != job.identity


def test_a_worker_refuses_weights_that_were_overwritten(checkpoint: Path) -> None:
    job = job_of(checkpoint)
    overwrite(checkpoint)
    with pytest.raises(ValueError, match=r"was written over since the evaluation began: other weights \(\w+ there"):
        Worker(job)


def test_comparison_needs_the_same_trials(checkpoint: Path, tmp_path: Path) -> None:
    other = save_replay(tmp_path / "other", STILL + 0.25)
    stored = read_evaluation(finish(job_of(other), tmp_path / "others", success=False))
    trials = job_of(checkpoint).identity.trials
    stored.require_trials(trials)  # other weights are what is compared
    with pytest.raises(ValueError, match=r"others holds results of other first seed \(500000 there, 7 here\)"):
        stored.require_trials(replace(trials, first_seed=7))
    with pytest.raises(ValueError, match=r"of other pybullet \(.* there, 0 here\)"):
        stored.require_trials(replace(trials, software=trials.software | {"pybullet": "0"}))
    config = EvalConfig(
        PolicySource(str(checkpoint)), num_episodes=3, seed=SEED, output_dir=tmp_path / "eval", against=stored.folder
    )
    before = listing(tmp_path)
    with pytest.raises(
        ValueError, match=r"other num episodes \(2 there, 3 here\); compare evaluations of the same task"
    ):
        eval_command(config)
    assert listing(tmp_path) == before


def test_a_finished_comparison_is_with_a_policy_not_with_a_path(checkpoint: Path, tmp_path: Path) -> None:
    """The other policy was trained and evaluated anew at the same place: the comparison of before is not with that one."""
    other = save_replay(tmp_path / "other", STILL + 0.25)
    others = finish(job_of(other), tmp_path / "others", success=False)
    output = finish(job_of(checkpoint), tmp_path / "eval", against=others)
    stored = read_evaluation(output)
    stored.require_comparison(read_evaluation(others))
    config = EvalConfig(
        PolicySource(str(checkpoint)), num_episodes=2, seed=SEED, output_dir=output, against=others, push="a/b"
    )
    shutil.rmtree(others)
    save_replay(other, STILL + 0.5)
    finish(job_of(other), others, success=False)
    with pytest.raises(
        ValueError,
        match=r"the comparison in .*eval holds results of other weights \(\w{12} there, \w{12} here\); evaluate",
    ):
        eval_command(config)
    with pytest.raises(ValueError, match="others compares with no other evaluation; evaluate again with --against"):
        read_evaluation(others).require_comparison(stored)


def test_a_checkpoint_is_found_again_from_another_folder(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``last`` was given by a relative path. Later the command runs elsewhere, and training has moved the link."""
    monkeypatch.chdir(tmp_path)
    name = str(checkpoint.relative_to(tmp_path))
    job = make_job("table_lift", name, SEED, 2)
    stored = read_evaluation(finish(job, tmp_path / "eval"))
    save_replay(tmp_path / "checkpoints/000200/pretrained_model", STILL + 0.25)
    (tmp_path / "checkpoints/last").unlink()
    (tmp_path / "checkpoints/last").symlink_to("000200")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert stored.job() == job
    shutil.rmtree(checkpoint.parents[1] / "000100")
    with pytest.raises(FileNotFoundError, match=f"no checkpoint at {name}"):
        stored.job()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"other weights .* is no longer the one that was evaluated"):
        stored.job()


def test_replaying_needs_the_evaluated_checkpoint(checkpoint: Path, tmp_path: Path) -> None:
    job = job_of(checkpoint, overrides=("--scale=2.0",))
    stored = read_evaluation(finish(job, tmp_path / "eval"))
    assert stored.job() == job
    assert stored.changed_software(job) == []
    newer = replace(job.identity.policy, software=job.identity.policy.software | {"torch": "9"})
    (line,) = stored.changed_software(replace(job, identity=Identity(newer, job.identity.trials)))
    assert line.startswith("torch (")
    stored.identity["policy"]["software"]["torch"] = "0"  # torch was updated since: it may be played again, and is told
    assert stored.job() == job
    assert stored.changed_software(job)[0].startswith("torch (0 there, ")
    overwrite(checkpoint)
    with pytest.raises(ValueError, match=r"other weights .* is no longer the one that was evaluated"):
        stored.job()
    old = tmp_path / "old"
    old.mkdir()
    (old / "results.json").write_text(json.dumps({key: stored.results[key] for key in ("task", "policy", "overrides")}))
    with pytest.raises(ValueError, match="old has no record of which weights made its results"):
        read_evaluation(old).job()


def test_device_is_part_of_what_acts(checkpoint: Path) -> None:
    found = find_checkpoint(str(checkpoint))
    assert identify(found, resolve_config(found)).device == "cpu"
    absent = "xpu" if sys.platform == "darwin" else "mps"
    with pytest.raises(ValueError, match=f"the device '{absent}' is not available here"):
        resolve_config(found, device=absent)
