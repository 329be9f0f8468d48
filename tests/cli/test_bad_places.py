"""A full disk, a folder that is read-only, a damaged shard, a foreign file, a dead worker: one line each, and nothing lost."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

import hdril.demonstrations.record as recording
from hdril.cli import eval as evaluation
from hdril.cli import record as command
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe, read_provenance
from hdril.demonstrations.record import record
from hdril.errors import UserError
from tests.demonstrations.broken import Broken
from tests.evaluation.checkpoints import experts_episode, listing, save_replay

SEED = 930_000
ROOM = "; make room there, then give the same command again\n"
READ_ONLY = ": Permission denied; change that, or choose another place\n"
Refuse = Callable[..., str]


@pytest.fixture
def refuse(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refuse:
    """``refuse(main, *arguments)``: run a command that must end in a one-line error; returns that line's message."""

    def run(main: Callable[[], None], *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["hdril-x", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        text = capsys.readouterr().err
        assert caught.value.code == 2
        assert "Traceback" not in text
        assert text.count("error: ") == 1
        return text.partition("error: ")[2]

    return run


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """A system that writes no more than so many bytes to a file: to who writes, it is a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        with pytest.MonkeyPatch.context() as patch:
            # Python would leave the first part of what it compiles in the environment, for good, and then fail to import it.
            patch.setattr(sys, "dont_write_bytecode", True)
            patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder in which nothing can be made, not even by root, which is asked not to override permissions meanwhile."""
    folder.chmod(0o555)
    try:
        if os.geteuid():
            yield
        else:
            with _without_override():
                yield
    finally:
        folder.chmod(0o755)


@contextmanager
def _without_override() -> Iterator[None]:
    libc, override = ctypes.CDLL(None, use_errno=True), 1 << 1  # CAP_DAC_OVERRIDE
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3, this thread
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable, of 32 capabilities; then of the next 32

    def call(function: str) -> None:
        assert getattr(libc, function)(header, sets) == 0, os.strerror(ctypes.get_errno())

    call("capget")
    before = sets[0]
    sets[0] = before & ~override
    call("capset")
    try:
        yield
    finally:
        sets[0] = before
        call("capset")


# --------------------------------------------------------------------- hdril-record


@pytest.fixture
def root(tmp_path: Path, made_up: Callable[..., Episode], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a dataset is recorded, of made-up episodes; the third one is the largest."""

    def play(recipe: Recipe, seeds: Iterable[int], workers: int = 1) -> Generator[Episode]:
        for seed in seeds:
            yield made_up(seed, frames=40 if seed == 2 else 12)

    monkeypatch.setattr(recording, "play", play)
    return tmp_path / "here/set"


def options(root: Path, *more: str) -> list[str]:
    return ["--task=table_lift", "--num_episodes=4", "--workers=1", f"--root={root}", *more]


def kept(root: Path) -> list[str]:
    return sorted(path.name for path in root.with_name("set.partial").glob("*.npz"))


def finish(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same command goes on, and makes the dataset that an undisturbed one makes."""
    monkeypatch.setattr(sys, "argv", ["hdril-record", *options(root)])
    command.main()
    record(Recipe("table_lift"), 4, 0, root.with_name("calm"))
    assert listing(root) == listing(root.with_name("calm"))
    assert sorted(path.name for path in root.parent.iterdir()) == ["calm", "set"]


@pytest.mark.parametrize("more", [[], ["--shards=1", "--shard=0"]])
def test_a_disk_that_is_full_while_episodes_come(more: list[str], root: Path, refuse: Refuse, monkeypatch) -> None:
    with files_of_at_most(9_000):
        assert refuse(command.main, *options(root, *more)) == f"{root}.partial/2.npz: File too large{ROOM}"
    assert kept(root) == ["0.npz", "1.npz"]
    assert not list(root.parent.rglob(".*")), "nothing half-written"
    finish(root, monkeypatch)


def test_a_disk_that_is_full_when_the_dataset_is_written(root: Path, refuse: Refuse, monkeypatch) -> None:
    with files_of_at_most(14_000):
        assert refuse(command.main, *options(root)) == f"{root}.partial/dataset: File too large{ROOM}"
    assert kept(root) == ["0.npz", "1.npz", "2.npz", "3.npz"]
    finish(root, monkeypatch)
    gc.collect()
    assert not root.with_name("set.partial").exists(), "nothing of the failed attempt is written later"


@pytest.mark.parametrize("more", [[], ["--shards=2", "--shard=0"]])
def test_a_folder_that_is_read_only(more: list[str], root: Path, refuse: Refuse, monkeypatch) -> None:
    root.parent.mkdir()
    with read_only(root.parent):
        assert refuse(command.main, *options(root, *more)) == f"{root}.partial{READ_ONLY}"
    assert not list(root.parent.iterdir())
    record_shard = [*options(root), "--shards=2", "--shard=1"]
    monkeypatch.setattr(sys, "argv", ["hdril-record", *record_shard])
    command.main()
    before = listing(root.parent)
    with read_only(root.with_name("set.partial")):
        name = "plan.json" if more else "lock"
        assert refuse(command.main, *options(root, *more)) == f"{root}.partial/{name}{READ_ONLY}"
    assert listing(root.parent) == before
    finish(root, monkeypatch)


@pytest.mark.parametrize("more", [[], ["--shards=2", "--shard=0"]])
def test_a_foreign_folder_is_refused_and_left_alone(more: list[str], root: Path, refuse: Refuse) -> None:
    partial = root.with_name("set.partial")
    (partial / "mine").mkdir(parents=True)
    (partial / "mine/0.npz").write_text("years of work")
    before = listing(root.parent)
    refused = f"{partial} exists and is no unfinished recording; delete it or choose another root\n"
    assert refuse(command.main, *options(root, *more)) == refused
    (partial / "plan.json").write_text("{")
    refused = f"{partial}/plan.json is damaged: what the episodes beside it are of is not known; delete {partial} or"
    assert refuse(command.main, *options(root, *more)).startswith(refused)
    (partial / "plan.json").write_text("{}")
    refused = f"{partial} holds episodes of another recipe; delete it or choose another root\n"
    assert refuse(command.main, *options(root, *more)) == refused
    (partial / "plan.json").unlink()
    assert listing(root.parent) == before


@pytest.mark.parametrize("more", [[], ["--shards=2", "--shard=0"]])
def test_a_foreign_file_in_the_way(more: list[str], root: Path, refuse: Refuse) -> None:
    root.parent.mkdir()
    root.with_name("set.partial").write_text("a letter")
    told = f"{root}.partial: Not a directory; something is in the way: move it, or choose another place\n"
    assert refuse(command.main, *options(root, *more)) == told
    assert listing(root.parent) == {"set.partial": b"a letter"}


def test_a_foreign_file_beside_the_episodes_stays(root: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["hdril-record", *options(root), "--shards=1", "--shard=0"])
    command.main()
    (root.with_name("set.partial") / "notes.txt").write_text("a letter")
    monkeypatch.setattr(sys, "argv", ["hdril-record", *options(root)])
    command.main()
    assert f"{root}.partial stays: notes.txt is there, which the recording did not write" in capsys.readouterr().out
    assert root.exists()
    assert listing(root.with_name("set.partial")) == {"notes.txt": b"a letter"}


def test_a_shard_that_is_damaged_when_the_dataset_is_written(root: Path, refuse: Refuse, monkeypatch) -> None:
    """It was whole when the episodes were counted."""
    write_dataset = recording.write_dataset

    def late(staged: Path, *rest):
        (root.with_name("set.partial") / "1.npz").write_bytes(b"a bad sector")
        return write_dataset(staged, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(recording, "write_dataset", late)
        told = refuse(command.main, *options(root))
    assert told.startswith(f"{root}.partial/1.npz is damaged: ")
    assert told.endswith("; the same command makes the episode again\n")
    assert kept(root) == ["0.npz", "1.npz", "2.npz", "3.npz"]
    finish(root, monkeypatch)


def test_a_dead_worker_loses_no_episode(tmp_path: Path, made_up: Callable[..., Episode]) -> None:
    recipe, partial = Broken("table_lift", killed=True), tmp_path / "set.partial"
    recording.Shards(partial, recipe, 0).put(made_up(0))
    with pytest.raises(UserError, match="a worker process was killed; 2 workers may need more memory"):
        record(recipe, 3, 0, tmp_path / "set", workers=2)
    assert [episode.seed for episode in recording.Shards(partial, recipe, 0).take()] == [0]
    assert read_provenance(tmp_path) is None


# --------------------------------------------------------------------- hdril-eval


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that plays what the expert did on the first seed."""
    return save_replay(tmp_path_factory.mktemp("policies") / "replay", experts_episode(SEED).action)


@pytest.fixture
def evaluating(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Options of ``hdril-eval`` that lead to ``tmp_path/here/eval``."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    where = f"--output_dir={tmp_path / 'here/eval'}"
    return [f"--policy.path={policy}", where, "--num_episodes=2", f"--seed={SEED}", "--workers=1", "--rerun=none"]


def evaluate(*arguments: str, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(sys, "argv", ["hdril-eval", *arguments])
    evaluation.main()


def test_an_evaluation_on_a_full_disk(evaluating: list[str], tmp_path: Path, refuse: Refuse, monkeypatch) -> None:
    output = tmp_path / "here/eval"
    first = tmp_path / "here/eval.partial/outcomes.jsonl"
    with files_of_at_most(1_500):  # more than one outcome, less than two
        assert refuse(evaluation.main, *evaluating) == f"{first}: File too large{ROOM}"
    seen = first.read_bytes().splitlines()[0]
    with files_of_at_most(4_000):
        assert refuse(evaluation.main, *evaluating) == f"{output}.partial: File too large{ROOM}"
    assert first.read_bytes().splitlines()[0] == seen, "not played again"
    with files_of_at_most(100_000):
        partial = f"{output}.partial/rerun/seed_0930000_success.rrd: File too large{ROOM}"
        (tmp_path / "here/eval.partial/outcomes.jsonl").unlink()
        assert refuse(evaluation.main, *evaluating, "--rerun=all") == partial
    assert not list(tmp_path.rglob("*.rrd")), "no half of a recording"
    evaluate(*evaluating, patch=monkeypatch)
    assert sorted(path.name for path in output.parent.rglob("*")) == ["eval", "report.md", "report.png", "results.json"]


def test_an_evaluation_in_a_folder_that_is_read_only(
    evaluating: list[str], tmp_path: Path, refuse: Refuse, monkeypatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    shard = ["--shards=2", "--shard=1"]
    with read_only(here):
        for more in ([], shard):
            assert refuse(evaluation.main, *evaluating, *more) == f"{here}/eval.partial{READ_ONLY}"
    assert not list(here.iterdir())
    evaluate(*evaluating, *shard, patch=monkeypatch)
    before = listing(here)
    with read_only(here / "eval.partial"):
        assert refuse(evaluation.main, *evaluating) == f"{here}/eval.partial/run.json{READ_ONLY}"
    assert listing(here) == before


def test_an_evaluation_leaves_a_foreign_file_alone(evaluating: list[str], tmp_path: Path, refuse: Refuse) -> None:
    partial = tmp_path / "here/eval.partial"
    partial.parent.mkdir()
    partial.write_text("a letter")
    told = f"{partial}: Not a directory; something is in the way: move it, or choose another place\n"
    for more in ([], ["--shards=2", "--shard=1"]):
        assert refuse(evaluation.main, *evaluating, *more) == told
    assert listing(partial.parent) == {"eval.partial": b"a letter"}


class Deadly:
    """Ends the process that it is sent to."""

    def __reduce__(self) -> tuple[Callable[[int], object], tuple[int]]:
        return os._exit, (1,)


def test_an_evaluation_whose_worker_dies(evaluating: list[str], tmp_path: Path, refuse: Refuse, monkeypatch) -> None:
    three = [*evaluating, "--num_episodes=3"]
    evaluate(*three, "--shards=3", "--shard=0", patch=monkeypatch)
    before = listing(tmp_path / "here/eval.partial/shards")
    make_job = evaluation.make_job
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "make_job", lambda *a, **k: replace(make_job(*a, **k), overrides=(Deadly(),)))
        told = refuse(evaluation.main, *three, "--workers=2")
    assert told == "a worker process was killed; 2 workers may need more memory than there is: try fewer\n"
    assert listing(tmp_path / "here/eval.partial/shards") == before
    assert not (tmp_path / "here/eval").exists()
