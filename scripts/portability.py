"""What is the same, bit for bit, on other processors and with other numbers of threads.

python scripts/portability.py                            prints a table of digests
python scripts/portability.py -- python -m pytest …      runs a command under each setting; stops at the first failure

Each setting makes the numerical libraries use the instructions of another processor, which this machine must have too.
Demonstrations and the evaluated policy are made once, so that each column tells of one thing alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

TASKS = ("table_lift", "peg_in_hole")
SEED = 7


@dataclass(frozen=True)
class Setting:
    """Environment variables of a run. None: the variable is not set."""

    name: str
    variables: dict[str, str | None]

    def environment(self) -> dict[str, str]:
        merged = os.environ | {"HF_HUB_OFFLINE": "1"} | self.variables
        return {name: value for name, value in merged.items() if value is not None}


def _setting(capability: str | None, threads: int) -> Setting:
    variables = {"ATEN_CPU_CAPABILITY": capability, "OMP_NUM_THREADS": str(threads)}
    words = ", ".join(f"{name}={value or 'unset'}" for name, value in variables.items())
    return Setting(words, variables)


SETTINGS = [_setting(capability, threads) for capability in (None, "avx2", "default") for threads in (1, 2)]
"""PyTorch's own kernels, in the instructions of this processor, in AVX2, and in those that every processor has."""
LIBRARIES = Setting(
    "BLAS, NumPy and oneDNN without AVX, OMP_NUM_THREADS=1",
    {
        "ATEN_CPU_CAPABILITY": "default",
        "OMP_NUM_THREADS": "1",
        "MKL_CBWR": "COMPATIBLE",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": "AVX F16C FMA3 AVX2",
    },
)
"""The matrix products too: these libraries choose their instructions by themselves."""


def digest_of_simulation() -> dict[str, str]:
    """SHA-256 of states, objects and actions of the expert's episode, by task."""
    from hdril.demonstrations.episode import demonstrate
    from hdril.demonstrations.provenance import Recipe

    digests = {}
    for task in TASKS:
        recipe = Recipe(task)
        env = recipe.make_env()
        episode = demonstrate(env, recipe.make_expert(), SEED)
        env.close()
        arrays = (episode.state, episode.environment_state, episode.action)
        digests[task] = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    return digests


def _run(setting: Setting, *command: object) -> str:
    program = Path(sys.executable).with_name(str(command[0]))
    arguments = [str(program), *map(str, command[1:])]
    done = subprocess.run(arguments, env=setting.environment(), capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"portability: {shlex.join(arguments)}\n{done.stderr[-2000:]}")
    return done.stdout


def train(setting: Setting, dataset: Path, output: Path) -> Path:
    """50 steps of stock ``lerobot-train``; returns the checkpoint."""
    _run(
        setting, "lerobot-train", "--config_path=configs/train/table_lift.yaml", f"--dataset.root={dataset}",
        f"--output_dir={output}", "--steps=50", "--save_freq=50", "--num_workers=0",
    )  # fmt: skip
    return output / "checkpoints/000050/pretrained_model"


def evaluate(setting: Setting, checkpoint: Path, output: Path) -> list[dict]:
    """Outcomes of three held-out episodes."""
    _run(
        setting, "hdril-eval", f"--policy.path={checkpoint}", "--num_episodes=3", "--workers=1", "--rerun=none",
        f"--output_dir={output}",
    )  # fmt: skip
    return json.loads((output / "results.json").read_text())["per_episode"]


def distance(one: Path, other: Path) -> float:
    """Largest difference between the weights of two checkpoints."""
    from safetensors.torch import load_file

    ours, theirs = (load_file(path / "model.safetensors") for path in (one, other))
    return max(float((ours[name] - theirs[name]).abs().max()) for name in ours)


def table() -> None:
    """Print a row for each setting, compared with the first one's."""
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        first = SETTINGS[0]
        dataset = base / "dataset"
        _run(first, "hdril-record", "--num_episodes=6", f"--root={dataset}")
        reference = train(first, dataset, base / "reference")
        print("| setting | table lift | peg-in-hole | weights after 50 steps | 3 evaluated episodes |")
        print("|---|---|---|---|---|")
        expected = None
        for number, setting in enumerate((*SETTINGS, LIBRARIES)):
            found = json.loads(_run(setting, "python", __file__, "--simulation").splitlines()[-1])
            gap = distance(reference, train(setting, dataset, base / f"train{number}"))
            outcomes = evaluate(setting, reference, base / f"eval{number}")
            expected = expected or (found, outcomes)
            words = [found[task][:8] + ("" if found[task] == expected[0][task] else ", differs") for task in TASKS]
            words.append("the same" if gap == 0.0 else f"{gap:.1g} apart")
            words.append(_compare(outcomes, expected[1]))
            print(f"| {setting.name} | {' | '.join(words)} |", flush=True)


def _compare(outcomes: list[dict], expected: list[dict]) -> str:
    if outcomes == expected:
        return "the same"
    apart = max(
        abs(one[key] - other[key])
        for one, other in zip(outcomes, expected, strict=True)
        for key in ("position_error_cm",)
    )
    same = [one["success"] for one in outcomes] == [other["success"] for other in expected]
    return f"{'same' if same else 'other'} successes, errors {apart:.1g} cm apart"


def repeat(command: list[str]) -> None:
    """Run a command under each setting.

    Raises:
        SystemExit: it failed; says under which one.
    """
    for setting in SETTINGS:
        print(f"\n== {setting.name}\n$ {shlex.join(command)}", flush=True)
        code = subprocess.run(command, env=setting.environment(), check=False).returncode
        if code:
            sys.exit(f"portability: failed with {setting.name}, exit code {code}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulation", action="store_true", help="print the digests of the simulation only, as JSON")
    parser.add_argument("command", nargs="*", help="a command to run under each setting")
    options = parser.parse_args()
    if options.simulation:
        print(json.dumps(digest_of_simulation()))
    elif options.command:
        repeat(options.command)
    else:
        table()


if __name__ == "__main__":
    main()
