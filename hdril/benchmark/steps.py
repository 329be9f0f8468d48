"""The steps of a benchmark: demonstrations, a training, an evaluation. Each is a command and all that decides its result."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hdril.demonstrations.provenance import read_provenance
from hdril.digest import digest_file, digest_files
from hdril.evaluation.checkpoint import Checkpoint
from hdril.evaluation.software import (
    distribution_version,
    episode_software,
    evaluation_software,
    package_software,
)
from hdril.evaluation.stored import RESULTS
from hdril.tasks import base_name

Folders = Mapping[str, Path]
"""Results of a step's inputs, by the names of the inputs."""


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
    events: str = ""
    perturb: float = 0.0

    kind = "record"

    @property
    def title(self) -> str:
        return f"{self.episodes} demonstrations of {self.task}"

    def settings(self) -> dict[str, Any]:
        return dict(vars(self)) | {"software": episode_software(base_name(self.task))}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        options = [f"--events={self.events}"] if self.events else []
        options += [f"--perturb={self.perturb:g}"] if self.perturb else []
        return ["hdril-record", f"--task={self.task}", f"--num_episodes={self.episodes}", f"--seed={self.first_seed}",
                *options, "--workers=1", f"--root={output}"]  # fmt: skip

    def digest(self, output: Path) -> str:
        provenance = read_provenance(output)
        if provenance is None or not provenance.digest:
            raise ValueError(f"{output} is no dataset of hdril with a digest")
        return provenance.digest


@dataclass(frozen=True)
class Train(Step):
    """Stock ``lerobot-train`` with a config file, on the first ``episodes`` demonstrations."""

    name: str
    """Of the policy, for people; it decides nothing."""
    data: Record
    episodes: int
    config: Path
    options: tuple[str, ...]
    steps: int
    seed: int
    """Of weights and batches."""

    kind = "train"
    resumes = False  # lerobot-train refuses the folder that it left

    @property
    def title(self) -> str:
        return f"{self.name} on {self.episodes} of {self.data.task}, seed {self.seed}"

    @property
    def inputs(self) -> Mapping[str, Step]:
        return {"data": self.data}

    @property
    def policy_type(self) -> str:
        """The type of the policy, as LeRobot names it."""
        given = [option.partition("=")[2] for option in self.options if option.startswith("--policy.type=")]
        return given[-1] if given else yaml.safe_load(self.config.read_text())["policy"]["type"]

    def settings(self) -> dict[str, Any]:
        config = {"config": digest_file(self.config), "options": list(self.options), "steps": self.steps}
        software = {name: distribution_version(name) for name in ("lerobot", "torch", "numpy")}
        if self.policy_type in ("hdril", "nearest"):
            software |= package_software("lerobot_policy_hdril")
        return config | {"episodes": self.episodes, "seed": self.seed, "software": software}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        subset = [] if self.episodes == self.data.episodes else [f"--dataset.episodes={list(range(self.episodes))}"]
        return ["lerobot-train", f"--config_path={self.config}", "--dataset.repo_id=local/benchmark",
                f"--dataset.root={inputs['data']}", *subset, f"--output_dir={output}", f"--steps={self.steps}",
                f"--save_freq={self.steps}", f"--seed={self.seed}", *self.options]  # fmt: skip

    def checkpoint(self, output: Path) -> Path:
        """Where the trained policy is."""
        return output / "checkpoints" / f"{self.steps:06d}" / "pretrained_model"

    def digest(self, output: Path) -> str:
        checkpoint = Checkpoint("trained", self.checkpoint(output))
        # Not train_config.json, which holds the folder of the output.
        return digest_files([checkpoint.weights, *checkpoint.processors])


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
    def inputs(self) -> Mapping[str, Step]:
        return {"policy": self.policy}

    def settings(self) -> dict[str, Any]:
        trials = {"task": self.task, "episodes": self.episodes, "first_seed": self.first_seed}
        software = evaluation_software(base_name(self.task)) | self.policy.settings()["software"]
        return trials | {"options": list(self.options), "software": software}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        return ["hdril-eval", f"--policy.path={self.policy.checkpoint(inputs['policy'])}", f"--task={self.task}",
                f"--num_episodes={self.episodes}", f"--seed={self.first_seed}", "--rerun=none", "--workers=1",
                *self.options, f"--output_dir={output}"]  # fmt: skip

    def digest(self, output: Path) -> str:
        json.loads((output / RESULTS).read_text())
        return digest_file(output / RESULTS)
