"""``make test-portable`` runs the tests that involve a policy as if on other processors."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts/portability.py"


def run(*arguments: object, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, arguments)]
    environment = os.environ | variables
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.portable
def test_this_run_has_the_kernels_and_threads_that_were_asked_for() -> None:
    """The fixtures of the tests must not overwrite what ``make test-portable`` sets."""
    code = "import torch; print(torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())"
    capability, threads = run("-c", code).stdout.split()
    assert threads == os.environ["OMP_NUM_THREADS"]
    asked = os.environ.get("ATEN_CPU_CAPABILITY")
    assert asked is None or capability.lower() == asked


def test_a_command_runs_under_each_setting_and_a_failure_is_named() -> None:
    report = (
        "import os; print(os.environ.get('ATEN_CPU_CAPABILITY', 'unset'), os.environ['OMP_NUM_THREADS'], flush=True)"
    )
    done = run(SCRIPT, "--", sys.executable, "-c", report, ATEN_CPU_CAPABILITY="avx512")
    assert done.returncode == 0, done.stderr
    settings = {(capability, threads) for capability in ("unset", "avx2", "default") for threads in ("1", "2")}
    assert settings <= {tuple(line.split()) for line in done.stdout.splitlines()}
    done = run(SCRIPT, "--", sys.executable, "-c", "import os; exit(os.environ['OMP_NUM_THREADS'] == '2')")
    assert done.returncode == 1
    assert done.stderr == "portability: failed with ATEN_CPU_CAPABILITY=unset, OMP_NUM_THREADS=2, exit code 1\n"
    assert done.stdout.count("\n== ") == 2


def test_tests_with_a_policy_are_marked() -> None:
    folders = [SCRIPT.parents[1] / "tests" / name for name in ("cli", "viewer")]
    done = run("-m", "pytest", "-n0", "--collect-only", "-q", "-m", "portable", *folders)
    assert "test_train.py::test_training_resumes" in done.stdout, done.stdout[-2000:]
    assert "test_view.py::" in done.stdout
    assert "test_errors.py" not in done.stdout
