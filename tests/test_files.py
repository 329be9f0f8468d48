"""Files appear whole or not at all, and one process at a time works in a folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hdril.files import BusyError, exclusively, is_busy, write_atomically


def test_a_file_appears_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    write_atomically(path, lambda file: file.write(b"one"))
    write_atomically(path, lambda file: file.write(b"two"))
    assert path.read_bytes() == b"two"
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def fail(file) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_process_is_kept_out_until_the_first_is_done(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    code = f"from pathlib import Path; from hdril.files import exclusively\nwith exclusively(Path({str(folder)!r}), 'x'): pass"
    other = [sys.executable, "-c", code]
    with exclusively(folder, "baking bread"):
        with pytest.raises(BusyError, match="another process is baking bread"), exclusively(folder, "baking bread"):
            pass
        assert "BusyError" in subprocess.run(other, capture_output=True, text=True, check=False).stderr
    subprocess.run(other, check=True)


def test_a_failure_inside_ends_the_lock(tmp_path: Path) -> None:
    with pytest.raises(KeyError), exclusively(tmp_path, "failing"):
        raise KeyError
    with exclusively(tmp_path, "going on"):
        pass


def test_others_may_read_what_was_written_as_far_as_the_user_lets_them(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("as any program writes")
    write_atomically(tmp_path / "whole", lambda file: file.write(b"x"))
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_whether_somebody_is_in_there(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    assert not is_busy(folder)
    assert not folder.exists(), "looking makes nothing"
    with exclusively(folder, "working"):
        assert is_busy(folder)
    assert not is_busy(folder)
    with exclusively(folder, "working"):  # looking did not keep the lock
        pass
