"""The steps of a benchmark: demonstrations, the speed of a training, a training, an evaluation. Each is a command and all that
decides its result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from hdril.benchmark.calibrate import SPEED, Speed
from hdril.benchmark.episode import EPISODE
from hdril.demonstrations.provenance import read_provenance
from hdril.digest import digest_file, digest_files, digest_json
from hdril.evaluation.checkpoint import Checkpoint, read_json
from hdril.evaluation.held_out import STATISTICS
from hdril.evaluation.overrides import ELSEWHERE
from hdril.evaluation.software import (
    distribution_version,
    evaluation_software,
    package_software,
    policy_software,
    recording_software,
    source_software,
)
from hdril.evaluation.stored import RESULTS
from hdril.tasks import base_name

Folders = Mapping[str, Path]
"""Results of a step's inputs, by the names of the inputs."""
ENDLESS = 10**9
"""Steps of a training that is stopped when its speed is known."""
_EVALUATED = (
    "cli/eval.py",
    *(f"evaluation/{name}.py" for name in (
        "checkpoint", "held_out", "identity", "observation", "overrides", "results")),
)  # fmt: skip
"""Sources that decide what hdril-eval plays and writes, besides those that decide scenes and scores."""


class Step(ABC):
    """Something to be made. Equal steps are the same step. Must be picklable."""

    kind: str
    """What it makes, in one word; steps of a kind are kept together."""
    resumes = True
    """Whether the command goes on where it was killed. If not, what it left is removed before it runs again."""

    @property
    @abstractmethod
    def title(self) -> str:
        """What it is, for people."""

    @property
    def inputs(self) -> Mapping[str, Step]:
        """The steps whose results it is made from, by names."""
        return {}

    @property
    def effort(self) -> tuple[str, float]:
        """In which unit its work is counted, and how much it is."""
        return self.kind, 1.0

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All that decides the result, the inputs aside, as JSON: options, and the versions of the software."""

    @abstractmethod
    def command(self, output: Path, inputs: Folders) -> list[str]:
        """The command line that makes the result in the folder ``output``, which does not exist."""

    @abstractmethod
    def digest(self, output: Path) -> str:
        """Digest of the result, in hexadecimal: what decides the steps that are made from it.

        Raises:
            OSError, ValueError: the result is not whole.
        """


@dataclass(frozen=True)
class Record(Step):
    """Demonstrations of a task, with its parameters, from a seed on."""

    task: str
    episodes: int
    first_seed: int = 0
    perturb: float = 0.0
    stray: float = 0.0

    kind = "record"

    @property
    def title(self) -> str:
        return f"{self.episodes} demonstrations of {self.task}"

    @property
    def effort(self) -> tuple[str, float]:
        return f"demonstrations of {base_name(self.task)}", self.episodes

    def settings(self) -> dict[str, Any]:
        return dict(vars(self)) | {"software": recording_software(base_name(self.task))}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        noise = {"perturb": self.perturb, "stray": self.stray}
        options = [f"--{name}={value:g}" for name, value in noise.items() if value]
        return ["hdril-record", f"--task={self.task}", f"--num_episodes={self.episodes}", f"--seed={self.first_seed}",
                *options, "--workers=1", f"--root={output}"]  # fmt: skip

    def digest(self, output: Path) -> str:
        provenance = read_provenance(output)
        if provenance is None or not provenance.digest:
            raise ValueError(f"{output} is no dataset of hdril with a digest")
        # Policies learn from the statistics, too. The order of their columns means nothing.
        return digest_json([provenance.digest, *(read_json(output / name) for name in ("meta/info.json", STATISTICS))])


@dataclass(frozen=True)
class Train(Step):
    """Stock ``lerobot-train`` with a config file.

    It trains ``steps``, or as many steps as the command does in ``minutes`` on one core, its start included. LeRobot's schedules
    depend on the number of steps, so that it is worked out before, from the speed.
    """

    name: str
    """Of the policy, for people; it decides nothing."""
    data: Record
    config: Path
    options: tuple[str, ...]
    steps: int
    """0 if ``minutes`` are given."""
    seed: int
    """Of weights and batches."""
    minutes: float = 0.0
    """0 if ``steps`` are given."""
    in_memory: bool = False
    """Whether the loader holds the frames in memory. It yields the same batches, sooner: it decides the speed alone."""

    kind = "train"
    resumes = False  # lerobot-train refuses the folder that it left

    @property
    def title(self) -> str:
        budget = f", {self.minutes:g} minutes" if self.minutes else ""
        return f"{self.name} on {self.data.episodes} of {self.data.task}{budget}, seed {self.seed}"

    @property
    def effort(self) -> tuple[str, float]:
        return ("minutes of training", self.minutes) if self.minutes else ("steps of training", self.steps)

    @property
    def inputs(self) -> Mapping[str, Step]:
        speed = {"speed": Calibrate(replace(self, steps=ENDLESS, seed=0, minutes=0.0))} if self.minutes else {}
        return {"data": self.data, **speed}

    def count_steps(self, inputs: Folders) -> int:
        """How many steps are trained, as given or by the speed among the results of the inputs."""
        return Speed.read(inputs["speed"] / SPEED).steps(60.0 * self.minutes) if self.minutes else self.steps

    @property
    def policy_type(self) -> str:
        """The type of the policy, as LeRobot names it."""
        return str(self._decided("type"))

    def _decided(self, name: str) -> object:
        """An option of the policy, as the command line or the config file gives it.

        Raises:
            ValueError: neither does.
        """
        given = [option.partition("=")[2] for option in self.options if option.startswith(f"--policy.{name}=")]
        told = yaml.safe_load(self.config.read_text())
        values = (told.get("policy") if isinstance(told, dict) else None) or {}
        if not given and name not in values:
            raise ValueError(f"policy {self.name}: neither its options nor {self.config} say --policy.{name}")
        return given[-1] if given else values[name]

    def settings(self) -> dict[str, Any]:
        software = training_software(self.policy_type)
        return {
            "config": digest_file(self.config),
            "options": list(self.options),
            "device": self._decided("device"),  # unless told, LeRobot takes what the machine has
            "episodes": self.data.episodes,
            **({"minutes": self.minutes, "calibration": _calibration()} if self.minutes else {"steps": self.steps}),
            **({"in_memory": _in_memory_software()} if self.in_memory else {}),
            "seed": self.seed,
            "software": software,
        }

    def command(self, output: Path, inputs: Folders) -> list[str]:
        steps = self.count_steps(inputs)
        program = ["python", "-m", "lerobot_policy_hdril.in_memory"] if self.in_memory else ["lerobot-train"]
        return [*program, f"--config_path={self.config}", "--dataset.repo_id=local/benchmark",
                f"--dataset.root={inputs['data']}", f"--output_dir={output}", f"--steps={steps}",
                f"--save_freq={steps}", f"--seed={self.seed}", *self.options]  # fmt: skip

    def checkpoint(self, output: Path) -> Path:
        """Where the trained policy is: the last checkpoint, and the only one."""
        return output / "checkpoints" / "last" / "pretrained_model"

    def digest(self, output: Path) -> str:
        checkpoint = Checkpoint("trained", self.checkpoint(output))
        # The same weights may act otherwise by another config. Not train_config.json, which holds the folder of the output.
        config = {key: value for key, value in checkpoint.read_config().items() if key not in ELSEWHERE}
        return digest_json([digest_files([checkpoint.weights, *checkpoint.processors]), config])


def _calibration() -> str:
    """What makes steps of minutes."""
    return source_software("benchmark/calibrate.py")["hdril"]


def _in_memory_software() -> dict[str, str]:
    """What makes batches of frames in memory."""
    package = find_spec("lerobot_policy_hdril")
    assert package is not None
    assert package.origin is not None
    versions = {name: distribution_version(name) for name in ("datasets", "pyarrow")}
    return {"source": digest_file(Path(package.origin).with_name("in_memory.py"))} | versions


def training_software(policy_type: str) -> dict[str, str]:
    """What decides the training of a type of policies: the versions of the libraries, and the sources of the policy."""
    software = {name: distribution_version(name) for name in ("lerobot", "torch", "numpy")}
    if policy_type in ("hdril", "nearest"):
        return software | package_software("lerobot_policy_hdril")
    lerobot = find_spec("lerobot")
    places = list(lerobot.submodule_search_locations or []) if lerobot else []
    if any((Path(place) / "policies" / policy_type).is_dir() for place in places):
        return software
    # A plugin's: LeRobot must be imported to find it, which takes seconds.
    from lerobot.policies.factory import get_policy_class
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    return software | policy_software(get_policy_class(policy_type))


@dataclass(frozen=True)
class Calibrate(Step):
    """How fast a training is, on this machine and beside what else runs on it. Measured once for all budgets and seeds."""

    training: Train
    """Goes on until it is stopped."""
    warm_up: float = 30.0
    """s after the first step that are not taken for its speed: a policy may solve a part of itself in its first steps."""
    measured: float = 60.0
    """s after that of which the speed is the mean."""

    kind = "calibrate"
    resumes = False

    @property
    def title(self) -> str:
        return f"speed of {self.training.name} on {self.training.data.episodes} of {self.training.data.task}"

    @property
    def inputs(self) -> Mapping[str, Step]:
        return self.training.inputs

    def settings(self) -> dict[str, Any]:
        measured = {"calibration": _calibration(), "warm_up": self.warm_up, "measured": self.measured}
        return self.training.settings() | measured

    def command(self, output: Path, inputs: Folders) -> list[str]:
        return ["python", "-m", "hdril.benchmark.calibrate", f"--output={output}", f"--warm_up={self.warm_up:g}",
                f"--measured={self.measured:g}", "--", *self.training.command(output / "train", inputs),
                "--save_checkpoint=false", "--log_freq=1"]  # fmt: skip

    def digest(self, output: Path) -> str:
        return digest_json(vars(Speed.read(output / SPEED)))


@dataclass(frozen=True)
class Evaluate(Step):
    """``hdril-eval`` of a trained policy on seeds that its training did not see."""

    name: str
    """Of the evaluation, for people; it decides nothing."""
    policy: Train
    task: str
    episodes: int
    first_seed: int
    options: tuple[str, ...] = ()

    kind = "evaluate"

    @property
    def title(self) -> str:
        return f"{self.policy.title}: {self.name}"

    @property
    def effort(self) -> tuple[str, float]:
        return f"episodes of {base_name(self.task)}", self.episodes

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)

    @property
    def inputs(self) -> Mapping[str, Step]:
        return {"policy": self.policy}

    def settings(self) -> dict[str, Any]:
        trials = {"task": self.task, "episodes": self.episodes, "first_seed": self.first_seed}
        software = evaluation_software(base_name(self.task)) | training_software(self.policy.policy_type)
        software |= {"hdril-eval": source_software(*_EVALUATED)["hdril"]}
        return trials | {"options": list(self.options), "software": software}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        return ["hdril-eval", f"--policy.path={self.policy.checkpoint(inputs['policy'])}", f"--task={self.task}",
                f"--num_episodes={self.episodes}", f"--seed={self.first_seed}", "--rerun=none", "--workers=1",
                *self.options, f"--output_dir={output}"]  # fmt: skip

    def digest(self, output: Path) -> str:
        results = read_json(output / RESULTS)
        if results["held_out"] is not True:
            raise ValueError(f"its seeds are not known to be held out: {results['held_out_basis'] or 'nobody checked'}")
        played_by = results["identity"]["trials"]["software"] | results["identity"]["policy"]["software"]
        asked = self.settings()["software"]
        if other := [name for name, version in played_by.items() if asked.get(name, version) != version]:
            raise ValueError(f"{', '.join(other)} changed while it was played: start it again")
        return digest_file(output / RESULTS)


@dataclass(frozen=True)
class Play(Step):
    """One seed of an evaluation, frame by frame, to be drawn."""

    evaluation: Evaluate
    seed: int

    kind = "play"
    resumes = False

    @property
    def title(self) -> str:
        return f"{self.evaluation.title}, seed {self.seed}"

    @property
    def inputs(self) -> Mapping[str, Step]:
        return self.evaluation.inputs

    def settings(self) -> dict[str, Any]:
        drawn = {"seed": self.seed, "episode": source_software("benchmark/episode.py")["hdril"]}
        return self.evaluation.settings() | drawn

    def command(self, output: Path, inputs: Folders) -> list[str]:
        checkpoint = self.evaluation.policy.checkpoint(inputs["policy"])
        options = [
            option
            for option in self.evaluation.options
            if option.startswith(("--policy.", "--max_frames=", "--mishap="))
        ]
        return ["python", "-m", "hdril.benchmark.episode", f"--policy={checkpoint}", f"--task={self.evaluation.task}",
                f"--seed={self.seed}", f"--output={output}", *options]  # fmt: skip

    def digest(self, output: Path) -> str:
        return digest_json(read_json(output / EPISODE))
