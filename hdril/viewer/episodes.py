"""What ``hdril-view`` shows: recordings of a run, two policies on one seed side by side, an episode of a dataset."""

from __future__ import annotations

import re
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hdril.actor import ReplayActor
from hdril.demonstrations.provenance import Provenance, read_provenance
from hdril.demonstrations.read import StoredEpisode, read_episode
from hdril.evaluation.evaluate import EvaluatedEpisode, Worker
from hdril.evaluation.identity import require_same
from hdril.evaluation.reference import ReferenceCache
from hdril.evaluation.score import score_episode
from hdril.evaluation.stored import StoredEvaluation
from hdril.trace import trace_episode
from hdril.viewer.log import TIMELINE, log_lane
from hdril.viewer.recordings import APPLICATION, recording_name, write_episodes, written


def find_recordings(folder: Path, seed: int | None = None) -> list[Path]:
    """The recordings of an evaluation, in the order of seeds; of one seed if that is given."""
    pattern = "seed_*.rrd" if seed is None else f"seed_{seed:07d}_*.rrd"
    return sorted((folder / "rerun").glob(pattern))


def replay(evaluation: StoredEvaluation, seed: int, path: Path) -> tuple[Path, list[str]]:
    """Play a seed again, and write its recording to ``path``.

    Returns:
        The path, and the software that is another one than then: unless that is empty, the episode may be another one, too.

    Raises:
        ValueError: the checkpoint is no longer the one that was evaluated.
    """
    job = evaluation.job()
    worker = Worker(job)
    with closing(worker.env):
        episode = worker.play(seed)
        write_episodes(path, recording_name(episode.outcome), {"": episode})
    return path, evaluation.changed_software(job)


def compare(first: StoredEvaluation, second: StoredEvaluation, seed: int, path: Path) -> Path:
    """Play a seed with the policies of two evaluations, and write both episodes into one recording, side by side.

    Raises:
        ValueError: the evaluations are of different trials, or a checkpoint is no longer the one that was evaluated.
    """
    jobs = [evaluation.job() for evaluation in (first, second)]
    # Both are played with the software of now, on this seed: what is left to differ is the task and the budget.
    one, other = (
        {name: getattr(job.identity.trials, name) for name in ("task", "parameters", "max_frames", "mishap")}
        for job in jobs
    )
    require_same(str(second.folder), other, one, f"compare evaluations of what {first.folder} is of")
    with ExitStack() as worlds:
        episodes: dict[str, EvaluatedEpisode] = {}
        for job, name in zip(jobs, _names(first.folder, second.folder), strict=True):
            worker = Worker(job)
            worlds.enter_context(closing(worker.env))
            episodes[name] = worker.play(seed)
        return write_episodes(path, f"seed_{seed:07d}", episodes)


def _names(first: Path, second: Path) -> tuple[str, str]:
    """Names of two folders that tell them apart."""
    one, two = first.resolve().parts, second.resolve().parts
    for a, b in zip(reversed(one), reversed(two), strict=False):
        # They become part of entity paths.
        a, b = (re.sub(r"[^\w.-]", "_", name) for name in (a, b))
        if a != b:
            return a, b
    return "first", "second"


def show_dataset(root: Path, episode: int, path: Path) -> tuple[Path, str]:
    """Write a recording of an episode of a LeRobot dataset with primitive labels; returns also a line about it.

    An episode that ``hdril-record`` made is played again from its seed and recorded actions, which brings back robot,
    forces and contacts. Of any other dataset, poses, numbers and labels are shown.

    Raises:
        FileNotFoundError: there is no dataset.
        ValueError: it has no such episode.
    """
    stored = read_episode(root, episode)
    provenance = read_provenance(root)
    if provenance is None:
        return _foreign(stored, path), "not recorded by hdril: poses, numbers and labels only"
    return _own(provenance, episode, stored, path)


def _own(provenance: Provenance, episode: int, stored: StoredEpisode, path: Path) -> tuple[Path, str]:
    seed, recipe = provenance.seeds[episode], provenance.recipe
    # A robot that was disturbed was not told the actions that are recorded: the expert plays again, with the same noise.
    actor = recipe.make_expert() if recipe.perturbed else ReplayActor(stored.action)
    env = recipe.make_env()
    with closing(env):
        reference = ReferenceCache(recipe.task).get(seed)
        trace, ending = trace_episode(env, actor, seed, stored.label)
        outcome = score_episode(env.task_spec, seed, trace, reference, ending)
        name = f"episode_{episode:06d}_{recording_name(outcome)}"
        write_episodes(path, name, {"": EvaluatedEpisode(env, outcome, trace, reference)})
    apart = np.abs(trace.state[:-1] - stored.state).max()
    return path, f"seed {seed}, played again: its states are {apart:.2g} m or less from the recorded ones"


def _foreign(stored: StoredEpisode, path: Path) -> Path:
    at = [rr.TimeColumn(TIMELINE, duration=stored.time)]
    path.parent.mkdir(parents=True, exist_ok=True)
    views: list[Any] = [rrb.Spatial3DView(origin="world", name="Poses")]
    with written(path), rr.RecordingStream(APPLICATION) as stream:
        stream.save(path)
        for key, signal in stored.signals.items():
            for name, values in zip(signal.names, signal.values.T, strict=True):
                stream.send_columns(f"{key}/{name}", at, rr.Scalars.columns(scalars=values))
            for name, positions in signal.positions().items():
                entity = f"world/{key}/{name}"
                columns = rr.Points3D.columns(positions=positions).partition([1] * len(positions))
                stream.send_columns(entity, at, columns)
                stream.log(f"{entity}_path", rr.LineStrips3D([positions]), static=True)
            views.append(rrb.TimeSeriesView(origin=key, name=key))
        if stored.label is not None:
            log_lane(stream, "primitive/scripted", stored.label, stored.primitives, stored.time)
            views.insert(1, rrb.StateTimelineView(origin="primitive", name="Primitives"))
        stream.send_blueprint(rrb.Blueprint(rrb.Vertical(*views), collapse_panels=True))
    return path
