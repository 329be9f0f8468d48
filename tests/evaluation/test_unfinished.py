"""A folder that is not finished: bound to what it is of, and whoever is refused or fails removes only what is its own."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from hdril.evaluation.unfinished import UnfinishedFolder
from hdril.files import BusyError
from tests.evaluation.checkpoints import listing

OLD, NEW = {"policy": {"weights": "old"}, "suite": "s"}, {"policy": {"weights": "new"}, "suite": "s"}
each_key = pytest.mark.parametrize("key", ["", "identity"])


def folder_of(tmp_path: Path, identity: dict = OLD, key: str = "") -> UnfinishedFolder:
    return UnfinishedFolder(tmp_path / "a/cake", "cake", "recipe.json", identity, key)


def begin(tmp_path: Path, key: str = "") -> None:
    with folder_of(tmp_path, key=key).writing():
        (tmp_path / "a/cake.partial/dough").touch()


def fail_after(*steps: Callable[[], object]) -> None:
    for step in steps:
        step()
    raise ZeroDivisionError


@each_key
def test_it_goes_on_with_the_same_and_is_renamed_without_what_is_scratch(tmp_path: Path, key: str) -> None:
    folder_of(tmp_path, key=key)
    assert listing(tmp_path) == {}, "looking writes nothing"
    begin(tmp_path, key)
    assert json.loads((tmp_path / "a/cake.partial/recipe.json").read_text()) == ({key: OLD} if key else OLD)
    unfinished = folder_of(tmp_path, key=key)
    with unfinished.writing():
        (unfinished.folder / "crumbs").touch()
        unfinished.finish("crumbs")
    assert [path.name for path in (tmp_path / "a").rglob("*")] == ["cake", "dough"]
    with pytest.raises(FileExistsError, match=r"a/cake exists; choose another output_dir or delete it$"):
        folder_of(tmp_path, key=key)


@each_key
def test_it_is_refused_if_it_is_of_something_else(tmp_path: Path, key: str) -> None:
    begin(tmp_path, key)
    remedy = "; delete it or choose another output_dir$"
    with pytest.raises(
        ValueError, match=rf"cake\.partial holds results of other weights \(old there, new here\){remedy}"
    ):
        folder_of(tmp_path, NEW, key)
    (tmp_path / "a/cake.partial/recipe.json").write_text("{}")
    with pytest.raises(ValueError, match=rf"cake\.partial has no record of what made its results .*{remedy}"):
        folder_of(tmp_path, key=key)
    (tmp_path / "a/cake.partial/recipe.json").unlink()
    with pytest.raises(FileExistsError, match=rf"cake\.partial exists and is no cake{remedy}"):
        folder_of(tmp_path, key=key)


def test_what_another_process_has_only_recorded_is_left_alone(tmp_path: Path) -> None:
    """Nothing was done in it yet, but it is not the refused one's to remove."""
    late = folder_of(tmp_path, NEW)
    begin(tmp_path)
    (tmp_path / "a/cake.partial/dough").unlink()
    before = listing(tmp_path)
    with pytest.raises(ValueError, match="other weights"), late.writing():
        pass
    assert listing(tmp_path) == before


def test_one_that_is_kept_out_leaves_what_the_other_has_begun(tmp_path: Path) -> None:
    with folder_of(tmp_path).writing():
        with (
            pytest.raises(BusyError, match=r"another process is evaluating into .*a/cake;"),
            folder_of(tmp_path).writing(),
        ):
            pass
        assert (tmp_path / "a/cake.partial/recipe.json").exists()


def test_one_that_comes_after_the_end_removes_the_folder_that_its_lock_made(tmp_path: Path) -> None:
    late, unfinished = folder_of(tmp_path), folder_of(tmp_path)
    with unfinished.writing():
        unfinished.finish()
    with pytest.raises(FileExistsError, match="cake exists"), late.writing():
        pass
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["cake"]


@pytest.mark.parametrize("lock", [False, True])
def test_failing_at_once_leaves_nothing_and_failing_later_leaves_what_was_done(tmp_path: Path, lock: bool) -> None:
    if lock:  # a process was killed before it wrote more
        (tmp_path / "a/cake.partial").mkdir(parents=True)
        (tmp_path / "a/cake.partial/lock").touch()
    unfinished = folder_of(tmp_path)
    with pytest.raises(ZeroDivisionError), unfinished.writing():
        fail_after()
    assert list(tmp_path.rglob("*")) == ([tmp_path / "a"] if lock else []), "folders that were there stay"
    for begun, left in ((None, True), (lambda: False, False), (lambda: True, True)):
        with pytest.raises(ZeroDivisionError), unfinished.writing(begun):
            fail_after((unfinished.folder / "dough").touch)
        assert (unfinished.folder / "dough").exists() == left


def test_failing_after_the_end_is_told_and_takes_nothing_away(tmp_path: Path) -> None:
    unfinished = folder_of(tmp_path)
    with pytest.raises(ZeroDivisionError), unfinished.writing():
        fail_after(unfinished.finish)
    assert unfinished.output.exists()
