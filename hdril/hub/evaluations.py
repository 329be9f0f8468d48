"""Publishing of an evaluation: results, the card, and the checkpoint, if they belong together."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard

from hdril.evaluation.checkpoint import CONFIG, PROCESSORS, WEIGHTS, Checkpoint, identify, resolve_config
from hdril.evaluation.evaluate import Job, make_job
from hdril.evaluation.identity import PolicyIdentity, differences
from hdril.evaluation.results import headline
from hdril.evaluation.stored import RESULTS, StoredEvaluation
from hdril.hub.cards import checkpoint_card, folder_of, with_evaluation
from hdril.hub.publish import Head, download, publish, read_head, read_text

PAGES = ("report.md", "report.png")
"""What goes up beside ``results.json``."""
CHECKPOINT_SUFFIXES = (".safetensors", ".json", ".yaml")
"""What LeRobot publishes of a checkpoint: no pickles."""


def publish_evaluation(repo_id: str, job: Job, evaluation: StoredEvaluation, private: bool) -> str:
    """Put results, report and card into a model's repository, and the checkpoint if it lies here, in one commit.

    If the repository holds another policy, its card is made anew, and the results of the other policy are removed.

    Args:
        repo_id: user/name.
        job: what was evaluated.
        evaluation: its results.
        private: whether a new repository is private.

    Returns:
        The address of the repository.

    Raises:
        ValueError: the checkpoint is no longer the one that was evaluated; or it does not lie here, and the repository holds
            another policy, or none.
        HubError: the Hub cannot be reached, refuses, or somebody else changed the repository meanwhile.
    """
    _check_unchanged(job, evaluation)
    head, summary = read_head(repo_id), evaluation.results
    found = None if head is None else _policy_of(repo_id, head, job)
    files: dict[str, Path | bytes] = {f"{folder_of(summary)}/{name}": evaluation.folder / name for name in PAGES}
    files[f"{folder_of(summary)}/{RESULTS}"] = _portable(summary)
    same = found == job.identity.policy
    text = read_text(repo_id, "README.md", "model", head.revision) if head is not None and same else None
    if Path(job.checkpoint.name).is_dir():
        content = sorted(job.checkpoint.folder.iterdir())
        files |= {path.name: path for path in content if path.suffix in CHECKPOINT_SUFFIXES}
        text = text or checkpoint_card(job.checkpoint, repo_id)
    else:
        _check_holds(repo_id, found, job)
    card = with_evaluation(ModelCard(text or f"# {repo_id}\n"), summary, repo_id)
    files["README.md"] = str(card).encode()
    outdated = [] if same else _results_in(head)
    if outdated:
        print(f"Note: {repo_id} held another policy; its results go: {', '.join(outdated)}")
    remove = [path for path in outdated if path not in files]
    return publish(repo_id, "model", files, headline(summary), private, head=head, remove=remove)


def _results_in(head: Head | None) -> list[str]:
    return [] if head is None else [path for path in head.files if path.startswith("eval/")]


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


def _policy_of(repo_id: str, head: Head, job: Job) -> PolicyIdentity | None:
    """The policy in a repository, used as ``job`` used its own; None if it holds none that can be."""
    paths = {name: download(repo_id, name, "model", head.revision) for name in (CONFIG, WEIGHTS, *PROCESSORS)}
    config = paths[CONFIG]
    if config is None or None in paths.values():
        return None
    checkpoint = Checkpoint(repo_id, config.parent)
    try:
        for path in checkpoint.processors:
            if download(repo_id, path.name, "model", head.revision) is None:
                return None
        return identify(checkpoint, resolve_config(checkpoint, job.overrides, job.identity.policy.device))
    except ValueError:  # of a type that is not installed, or damaged
        return None


def _check_holds(repo_id: str, found: PolicyIdentity | None, job: Job) -> None:
    """Results of a policy on the Hub must not go into the card of another."""
    if found is None:
        raise ValueError(
            f"{repo_id} holds no policy that could have these results: they can go to {job.checkpoint.name}, which was "
            "evaluated, or to a copy of it"
        )
    if changed := differences(asdict(found), asdict(job.identity.policy)):
        raise ValueError(
            f"{repo_id} holds another policy, with other {', '.join(changed)}: its card cannot show results of "
            f"{job.checkpoint.name}; choose another repository"
        )
