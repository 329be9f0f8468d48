"""Publishing of an evaluation: results, the card, and the checkpoint, if they belong together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard

from hdril.digest import SHORT, digest_file
from hdril.evaluation.checkpoint import WEIGHTS
from hdril.evaluation.evaluate import Job, make_job
from hdril.evaluation.results import headline
from hdril.evaluation.stored import RESULTS, StoredEvaluation
from hdril.hub.cards import checkpoint_card, folder_of, with_evaluation
from hdril.hub.publish import download, publish, read_text

PAGES = ("report.md", "report.png")
"""What goes up beside ``results.json``."""
CHECKPOINT_SUFFIXES = (".safetensors", ".json", ".yaml")
"""What LeRobot publishes of a checkpoint: no pickles."""


def publish_evaluation(repo_id: str, job: Job, evaluation: StoredEvaluation, private: bool) -> str:
    """Put results, report and card into a model's repository, and the checkpoint if it lies here, in one commit.

    Args:
        repo_id: user/name.
        job: what was evaluated.
        evaluation: its results.
        private: whether a new repository is private.

    Returns:
        The address of the repository.

    Raises:
        ValueError: the checkpoint is no longer the one that was evaluated, or the repository holds other weights.
        HubError: the Hub cannot be reached, or refuses.
    """
    _check_unchanged(job, evaluation)
    summary = evaluation.results
    files: dict[str, Path | bytes] = {f"{folder_of(summary)}/{name}": evaluation.folder / name for name in PAGES}
    files[f"{folder_of(summary)}/{RESULTS}"] = _portable(summary)
    text = read_text(repo_id, "README.md", "model")
    if Path(job.checkpoint.name).is_dir():
        content = sorted(job.checkpoint.folder.iterdir())
        files |= {path.name: path for path in content if path.suffix in CHECKPOINT_SUFFIXES}
        text = text or checkpoint_card(job.checkpoint.folder, repo_id)
    else:
        _check_remote_weights(repo_id, job)
    card = with_evaluation(ModelCard(text or f"# {repo_id}\n"), summary, repo_id)
    files["README.md"] = str(card).encode()
    return publish(repo_id, "model", files, headline(summary), private)


def _portable(summary: dict[str, Any]) -> bytes:
    """``results.json`` without what is of this machine alone: where the checkpoint lies."""
    return json.dumps(summary | {"policy_folder": ""}, indent=2).encode()


def _check_unchanged(job: Job, evaluation: StoredEvaluation) -> None:
    """The files that the job began with are still those that were evaluated: training may have written over them."""
    trials, policy = job.identity.trials, job.identity.policy
    now = make_job(
        job.task, job.checkpoint, trials.first_seed, trials.num_episodes, overrides=job.overrides, device=policy.device,
        max_frames=trials.max_frames,
    )  # fmt: skip
    evaluation.require(now.identity)


def _check_remote_weights(repo_id: str, job: Job) -> None:
    """Results of a policy on the Hub must not go into the card of another."""
    path, evaluated = download(repo_id, WEIGHTS, "model"), job.identity.policy.weights
    if path is not None and (found := digest_file(path)) != evaluated:
        raise ValueError(
            f"{repo_id} holds other weights ({found[:SHORT]} there, {evaluated[:SHORT]} evaluated): its card cannot show "
            f"results of {job.checkpoint.name}; choose another repository"
        )
