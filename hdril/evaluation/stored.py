"""Evaluations on disk, and whether they are of what is asked for now."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hdril.evaluation.checkpoint import find_again, read_json
from hdril.evaluation.evaluate import Job, make_job
from hdril.evaluation.identity import Identity, TrialsIdentity, differences, require_same

RESULTS = "results.json"
AGAIN = "evaluate again or choose another output_dir"


@dataclass(frozen=True)
class StoredEvaluation:
    """A folder that ``hdril-eval`` wrote, and the data of its ``results.json``."""

    folder: Path
    results: dict[str, Any]

    @property
    def identity(self) -> dict[str, Any]:
        """What made the results; empty for those of an older hdril."""
        return self.results.get("identity") or {}

    def require(self, identity: Identity) -> None:
        """Raises ValueError unless these are the results of ``identity``; names what differs."""
        require_same(str(self.folder), self.identity, identity.as_dict(), AGAIN)

    def require_trials(self, trials: TrialsIdentity) -> None:
        """Raises ValueError unless these results are of the same trials, so that policies can be compared; names what
        differs."""
        remedy = "compare evaluations of the same task and seeds, by the same software"
        require_same(str(self.folder), self.identity.get("trials"), asdict(trials), remedy)

    def require_seed(self, seed: int) -> None:
        """Raises ValueError unless ``seed`` is one of those of the evaluation."""
        first, last = self.results["first_seed"], self.results["first_seed"] + self.results["n_episodes"] - 1
        if not first <= seed <= last:
            raise ValueError(f"seed must be one of those of {self.folder}, {first} to {last}, got {seed}")

    def require_comparison(self, other: StoredEvaluation) -> None:
        """Raises ValueError unless these results are compared with those of ``other``; names what differs."""
        comparison = self.results.get("comparison")
        if not comparison:
            raise ValueError(f"{self.folder} compares with no other evaluation; evaluate again with --against")
        what = f"the comparison in {self.folder}"
        require_same(what, comparison.get("against_identity"), other.identity.get("policy") or {}, AGAIN)

    def job(self) -> Job:
        """To play any seed again, as it was played then.

        Raises:
            FileNotFoundError: the checkpoint is not there any more.
            ValueError: the checkpoint that lies there now is another one.
        """
        stored = self.identity
        if not stored:
            raise ValueError(f"{self.folder} has no record of which weights made its results; evaluate again")
        trials, policy = stored["trials"], stored["policy"]
        checkpoint = find_again(self.results["policy"], self.results.get("policy_folder", ""))
        job = make_job(
            self.results["task"], checkpoint, trials["first_seed"], trials["num_episodes"],
            overrides=tuple(self.results["overrides"]), device=policy["device"], max_frames=trials["max_frames"],
            mishap=trials.get("mishap", ""),
        )  # fmt: skip
        require_same(
            str(self.folder), _without_software(policy), _without_software(asdict(job.identity.policy)),
            f"the checkpoint {self.results['policy']} is no longer the one that was evaluated",
        )  # fmt: skip
        return job

    def changed_software(self, job: Job) -> list[str]:
        """What of the software that made the results is another one now: an episode that is played again may differ."""
        now = job.identity.as_dict()
        return [
            difference
            for part in ("policy", "trials")
            for difference in differences(self.identity[part]["software"], now[part]["software"])
        ]


def _without_software(policy: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in policy.items() if name != "software"}


def read_evaluation(folder: Path) -> StoredEvaluation:
    """A finished evaluation.

    Raises:
        FileNotFoundError: the folder holds none.
        ValueError: its results are damaged.
    """
    if not (folder / RESULTS).exists():
        raise FileNotFoundError(f"{folder} holds no {RESULTS}: give the output_dir of a finished hdril-eval")
    return StoredEvaluation(folder, read_json(folder / RESULTS))
