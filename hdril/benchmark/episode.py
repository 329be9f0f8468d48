"""One held-out episode: what a policy commands, beside where the expert's hands are, and what its graph attends to.

``python -m hdril.benchmark.episode --policy=CHECKPOINT --task=… --seed=… --output=FOLDER [--policy.OPTION=VALUE …]``
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.evaluation.evaluate import Worker, make_job
from hdril.files import write_atomically
from hdril.simulation.actions import hand_poses
from hdril.simulation.robots.spec import SIDES

EPISODE = "episode.json"


def places(rows: NDArray[np.floating]) -> dict[str, list[list[float]]]:
    """Where each hand is in states or actions (T, 16), by side: x, y, z in m, to the millimetre, for each frame."""
    found = hand_poses(rows)[..., :3]
    return {side: found[:, i].round(3).tolist() for i, side in enumerate(SIDES)}


def play(
    policy: str, task: str, seed: int, overrides: Sequence[str], max_frames: int | None = None, mishap: str = ""
) -> dict[str, Any]:
    """An episode of a policy as plain data: the ``predicted`` places of the hands, which are its commands, and the ``true`` ones,
    which are the noise-free expert's on the same seed; frame by frame, as long as each of the two takes. And the ``attention``
    of the policy's graph at the first frame, see :func:`first_attention`.

    Args:
        policy: a checkpoint's folder.
        overrides: changes of the policy's config, as ``--name=value``.
        max_frames: frames after which the episode is cut; the task's budget unless given.
        mishap: name of what changes the policy's first actions; nothing unless given.
    """
    job = make_job(task, policy, seed, 1, overrides=tuple(overrides), max_frames=max_frames, mishap=mishap)
    worker = Worker(job)
    episode = worker.play(seed)
    # A command of a frame leads to the state after it.
    return {
        "seed": seed,
        "success": episode.outcome.success,
        "predicted": places(episode.trace.action),
        "true": places(episode.reference.state[1:]),
        "attention": first_attention(worker, seed),
    }


def first_attention(worker: Worker, seed: int) -> dict[str, Any] | None:
    """What the nodes of a policy's graph attend to at the first frame: ``nodes``, names; ``primitive``, which begins; ``of``, the
    part of the policy, dynamics or planner; ``weights`` (N, N) of the model of that primitive, or of the planner where the
    dynamics have no graph: row u says how much node u takes from each, and sums to 1.

    None for a policy that does not explain itself as :class:`lerobot_policy_hdril.HDRILPolicy` does, and for one whose nodes
    attend to themselves alone.
    """
    actor = worker.actor
    if not (hasattr(actor.policy, "explain") and hasattr(actor.policy, "attention")):
        return None
    observation, _ = worker.env.reset(seed=seed)
    actor.reset(seed)
    actor.act(observation)
    told = actor.policy.attention()
    part = "planner" if actor.policy.config.decoder == "linear" else "dynamics"
    weights = getattr(told, part)[0].numpy(force=True).astype(float).round(3)
    if (weights == np.eye(len(weights))).all():
        return None
    return {"nodes": told.nodes, "primitive": told.primitives[0], "of": part, "weights": weights.tolist()}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--policy", required=True)
    parser.add_argument("--task", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--max_frames", type=int)
    parser.add_argument("--mishap", default="")
    told, options = parser.parse_known_args()
    overrides = [option.replace("--policy.", "--", 1) for option in options]
    episode = play(told.policy, told.task, told.seed, overrides, told.max_frames, told.mishap)
    write_atomically(told.output / EPISODE, lambda file: file.write(json.dumps(episode).encode()))


if __name__ == "__main__":
    main()
