"""Steps that are kept by what they are made from, and done once whoever is killed."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from hdril.benchmark.engine import Engine, Progress, in_order
from hdril.benchmark.steps import Evaluate, Record, Step, Train
from hdril.benchmark.store import Store, checkout_commit
from hdril.errors import UserError
from tests.benchmark.made_up import PROGRAM, Words


@pytest.fixture
def count(tmp_path: Path) -> Path:
    return tmp_path / "count"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def diamond(count: Path, pause: float = 0.0) -> Words:
    """``top`` is made from ``left`` and ``right``, and both from ``bottom``."""
    bottom = Words("bottom", count, pause=pause)
    sides = tuple(Words(side, count, (bottom,), pause) for side in ("left", "right"))
    return Words("top", count, sides, pause)


def begun(count: Path) -> Counter[str]:
    return Counter(count.read_text().split()) if count.exists() else Counter()


def text_of(store: Store, step: Step) -> str:
    return (store.get(step).output / "text").read_text()


def test_steps_come_after_their_inputs_and_once(count: Path) -> None:
    top = diamond(count)
    titles = [step.title for step in in_order([top, top.made_from[1]])]
    assert titles == ["bottom", "left", "right", "top"]


def test_all_is_done_once_and_told(store: Store, count: Path) -> None:
    told: list[tuple[str, bool, float | None]] = []

    def watch(step: Step, progress: Progress) -> None:
        told.append((step.title, progress.fresh, progress.remaining()))

    top = diamond(count)
    Engine(store, 2, watch).run([top])
    assert text_of(store, top) == "(top (left (bottom)) (right (bottom)))"
    assert begun(count) == dict.fromkeys(("bottom", "left", "right", "top"), 1)
    assert {title for title, fresh, _ in told if fresh} == {"bottom", "left", "right", "top"}
    assert told[-1][2] == 0.0
    told.clear()
    Engine(Store(store.folder), 2, watch).run([top])
    assert sum(begun(count).values()) == 4, "nothing was done again"
    assert [fresh for _, fresh, _ in told] == [False] * 4


def test_what_changed_is_done_anew_and_only_that(store: Store, count: Path) -> None:
    top = diamond(count)
    Engine(store, 2).run([top])
    left, right = top.made_from
    other = replace(top, made_from=(replace(left, text="links"), right))
    Engine(store, 2).run([other])
    assert begun(count) == {"bottom": 1, "left": 1, "right": 1, "top": 2, "links": 1}
    assert text_of(store, other) == "(top (links (bottom)) (right (bottom)))"
    Engine(store, 2).run([top])
    assert begun(count)["top"] == 2, "the first result is still there"


def test_an_input_that_became_another_makes_what_depends_on_it_another(store: Store, count: Path) -> None:
    """By content: the result of an input, and not its options, decides whether a step is done anew."""
    top = diamond(count)
    Engine(store, 2).run([top])
    place = store.place(top.made_from[0])
    assert place is not None
    (place / "step.json").unlink()
    Engine(Store(store.folder), 2).run([top])
    assert begun(count) == {"bottom": 1, "left": 2, "right": 1, "top": 1}, "it gave the same, so top stands"


def test_a_step_that_fails_keeps_back_what_is_made_from_it_alone(store: Store, count: Path) -> None:
    broken = Words("broken", count)
    after, apart = Words("after", count, (broken,)), Words("apart", count)
    with pytest.raises(UserError, match=r"a step failed: broken: see .*/words/\w+/log\.txt") as error:
        Engine(store, 2).run([after, apart])
    assert store.find(apart) is not None
    assert store.find(after) is None
    assert begun(count) == {"broken": 1, "apart": 1}
    log = Path(str(error.value).partition("see ")[2].partition(" (")[0])
    assert "this step cannot be done" in log.read_text()


def test_as_many_at_a_time_as_allowed(store: Store, count: Path) -> None:
    """Four steps of three seconds, three at a time: faster than one after the other, and never more than three."""
    steps = [Words(f"step{i}", count, pause=3.0) for i in range(4)]
    seen, over = [0], threading.Event()

    def look() -> None:
        while not over.wait(0.02):
            seen.append(len(alive(store.folder)))

    looking = threading.Thread(target=look)
    looking.start()
    try:
        Engine(store, 3).run(steps)
    finally:
        over.set()
        looking.join()
    assert 1 < max(seen) <= 3


def test_what_is_left_is_shared_by_the_jobs_and_counts_by_its_size() -> None:
    """100 episodes in 50 s, and 10 minutes in 600: 300 episodes and 60 minutes are left."""
    record, options = Record("table_lift", 10), {"config": Path("c.yaml"), "options": (), "steps": 0, "seed": 1}
    short, long = (Train("act", record, minutes=minutes, **options) for minutes in (10.0, 60.0))
    few, many = (Evaluate("nominal", short, "table_lift:yaw=3", episodes, 5) for episodes in (100, 300))
    progress = Progress.of([record, short, long, few, many], 2)
    assert progress.remaining() is None, "nothing is known yet"
    for step, seconds in ((record, 20.0), (few, 50.0), (short, 600.0)):
        progress.settle(step, seconds)
    assert progress.remaining() == pytest.approx((150.0 + 3600.0) / 2)
    progress.settle(long, None)
    assert progress.remaining() == pytest.approx(75.0), "what cannot be done takes no time"
    other = Progress.of([many, Train("act", record, **options | {"steps": 9})], 1)
    other.settle(many, 30.0)
    assert other.remaining() is None, "of steps, nothing is known"


def test_a_step_has_one_thread_and_says_what_did_it(store: Store, count: Path) -> None:
    step = Words("step", count)
    Engine(store, 1).run([step])
    done = store.get(step)
    assert (done.output / "threads").read_text() == "11"
    assert re.fullmatch(r"\w+, \w+, \d+ cores, \S.*", done.machine)
    assert done.commit == checkout_commit()


def test_a_commit_is_of_the_checkout_and_says_whether_files_were_edited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "checkout/hdril"
    package.mkdir(parents=True)
    source = package / "__init__.py"
    source.write_text("")
    monkeypatch.setattr("hdril.__file__", str(source))
    assert checkout_commit() == "", "no repository"

    def git(*command: str) -> str:
        identity = ("-c", "user.name=A", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
        done = subprocess.run(
            ["git", *identity, *command], cwd=package.parent, check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    git("init", "--quiet")
    assert checkout_commit() == "", "hdril is not in that repository"
    git("add", ".")
    git("commit", "--quiet", "--message=first")
    commit = git("rev-parse", "--short", "HEAD")
    assert checkout_commit() == commit
    (package.parent / "notes.txt").write_text("decides nothing")
    assert checkout_commit() == commit
    (package / "new.py").write_text("a = 1")
    assert checkout_commit() == commit + "+"


ENGINE = """
import sys
from pathlib import Path
from hdril.benchmark.engine import Engine
from hdril.benchmark.store import Store
from tests.benchmark.test_engine import diamond
Engine(Store(Path(sys.argv[1])), 2).run([diamond(Path(sys.argv[2]), float(sys.argv[3]))])
"""


def start(store: Store, count: Path, pause: float) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", ENGINE, str(store.folder), str(count), str(pause)]
    return subprocess.Popen(command, start_new_session=True)


def test_killed_again_and_again_it_ends_with_the_same_and_repeats_nothing(store: Store, count: Path) -> None:
    random.seed(7)
    for _ in range(5):
        process = start(store, count, 0.6)
        begins, until = sum(begun(count).values()), time.monotonic() + 60
        while process.poll() is None and sum(begun(count).values()) == begins and time.monotonic() < until:
            time.sleep(0.02)  # until a step has begun
        time.sleep(random.uniform(0.0, 0.8))
        os.kill(process.pid, signal.SIGKILL)  # the process alone: what it started must notice
        process.wait()
    fresh = Store(store.folder)
    done = [step.title for step in in_order([diamond(count)]) if fresh.find(step)]
    before = begun(count)
    assert start(store, count, 0.0).wait(timeout=120) == 0
    top = diamond(count)
    assert text_of(store, top) == "(top (left (bottom)) (right (bottom)))"
    assert all(begun(count)[title] == before[title] for title in done), "what was done is not done again"
    assert not list(store.folder.rglob("*.tmp"))


def alive(place: Path) -> list[str]:
    """Command lines of processes that write below a folder."""
    lines = []
    for process in psutil.process_iter():
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            lines.append(" ".join(process.cmdline()))
    return [line for line in lines if str(place) in line and PROGRAM.strip().splitlines()[0] in line]


@pytest.mark.parametrize("group", [False, True], ids=["the engine alone", "its whole group"])
def test_no_command_outlives_a_killed_engine(store: Store, count: Path, group: bool) -> None:
    process = start(store, count, 600.0)
    until = time.monotonic() + 60
    while not alive(store.folder) and time.monotonic() < until:
        time.sleep(0.05)
    assert alive(store.folder)
    (os.killpg if group else os.kill)(process.pid, signal.SIGKILL)
    process.wait()
    until = time.monotonic() + 20
    while alive(store.folder) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive(store.folder)


def test_a_result_without_its_record_is_kept_where_the_command_would_refuse_it(store: Store, count: Path) -> None:
    """The process was killed between the two."""
    step = Words("step", count, resumes=True)
    Engine(store, 1).run([step])
    place = store.place(step)
    assert place is not None
    (place / "step.json").unlink()
    Engine(Store(store.folder), 1).run([step])
    assert begun(count) == {"step": 1}


def test_a_result_that_was_deleted_is_made_again(store: Store, count: Path) -> None:
    top = diamond(count)
    Engine(store, 2).run([top])
    for step in (top, top.made_from[0]):
        shutil.rmtree(store.get(step).output)
    again = Store(store.folder)
    Engine(again, 2).run([top])
    assert begun(count) == {"bottom": 1, "left": 2, "right": 1, "top": 2}
    assert text_of(again, top) == "(top (left (bottom)) (right (bottom)))"


def test_what_is_edited_while_the_engine_runs_is_not_taken_for_what_it_was(store: Store, count: Path) -> None:
    top = diamond(count)
    store.made_from(top.made_from[0].made_from[0])  # the engine has looked at it
    count.with_name("edited").write_text("second edition")
    with pytest.raises(UserError, match=r"edition changed while the benchmark ran: start it again"):
        Engine(store, 2).run([top])
    assert not count.exists(), "nothing was begun"
    Engine(Store(store.folder), 2).run([top])
    assert sum(begun(count).values()) == 4


def test_what_is_edited_while_a_step_is_done_spoils_its_result(store: Store, count: Path) -> None:
    step = Words("step", count, pause=3.0, resumes=True)

    def edit() -> None:
        until = time.monotonic() + 60
        while not begun(count) and time.monotonic() < until:
            time.sleep(0.02)
        count.with_name("edited").write_text("second edition")

    editing = threading.Thread(target=edit)
    editing.start()
    with pytest.raises(UserError, match=r"edition changed while the benchmark ran: start it again"):
        Engine(store, 1).run([step])
    editing.join()
    assert begun(count) == {"step": 1}
    assert store.find(step) is None
    count.with_name("edited").unlink()
    Engine(Store(store.folder), 1).run([step])
    assert begun(count) == {"step": 2}, "what was made meanwhile is not taken, even if the edit is undone"


def performers() -> list[psutil.Process]:
    found = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            if "hdril.benchmark.perform" in process.cmdline():
                found.append(process)
    return found


def test_a_command_that_outlived_its_process_is_waited_for(store: Store, count: Path) -> None:
    """Killed alone, as by the kernel for want of memory: a second command would write into the same folder."""
    step = Words("step", count, pause=15.0, resumes=True)

    def kill() -> None:
        until = time.monotonic() + 60
        while not begun(count) and time.monotonic() < until:
            time.sleep(0.02)
        for process in performers():
            process.kill()

    killing = threading.Thread(target=kill)
    killing.start()
    with pytest.raises(UserError, match=r"a step failed: step"):
        Engine(store, 1).run([step])
    killing.join()
    assert len(alive(store.folder)) == 1
    Engine(Store(store.folder), 1).run([step])
    assert begun(count) == {"step": 1}
    assert text_of(Store(store.folder), step) == "(step)"


def test_time_that_was_spent_before_a_kill_counts_where_a_step_goes_on(store: Store, count: Path) -> None:
    process = start(store, count, 600.0)
    until = time.monotonic() + 60
    spent: list[float] = []
    while not any(value > 1.0 for value in spent) and time.monotonic() < until:
        time.sleep(0.05)
        spent = [float(file.read_text()) for file in store.folder.rglob("spent.txt")]
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert [float(file.read_text()) > 1.0 for file in store.folder.rglob("spent.txt")] == [True]
    for resumes in (True, False):
        step = Words(f"resumes {resumes}", count, resumes=resumes)
        place = store.place(step)
        assert place is not None
        place.mkdir(parents=True)
        (place / "spent.txt").write_text("100.0")
        Engine(store, 1).run([step])
        assert (store.get(step).seconds >= 100.0) == resumes, "a training begins anew"
        assert not (place / "spent.txt").exists()


def test_two_engines_share_the_work(store: Store, count: Path) -> None:
    first, second = start(store, count, 0.5), start(store, count, 0.5)
    assert (first.wait(timeout=120), second.wait(timeout=120)) == (0, 0)
    assert begun(count) == dict.fromkeys(("bottom", "left", "right", "top"), 1)
