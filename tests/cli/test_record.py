"""hdril-record as a user runs it."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

from tests.cli.commands import BIN, succeed


def test_ctrl_c_stops_cleanly_and_the_same_command_goes_on(tmp_path: Path) -> None:
    root = tmp_path / "set"
    command = [str(BIN / "hdril-record"), "--repo_id=a/b", f"--root={root}", "--num_episodes=4", "--workers=2"]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("set.partial/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Run the same command again to go on" in out
    assert not root.exists()
    text = succeed(*[Path(command[0]).name, *command[1:]])
    assert "4 episodes (seeds 0 to 3)" in text
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
