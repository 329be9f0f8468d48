"""What ``hdril-view`` shows: recordings of a run, two policies on one seed side by side, an episode of a dataset."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hdril.actor import ReplayActor
from hdril.demonstrations.provenance import Provenance, read_provenance
from hdril.demonstrations.read import StoredEpisode, read_episode
from hdril.env import BimanualEnv
from hdril.evaluation.evaluate import EvaluatedEpisode, Job, Worker
from hdril.evaluation.reference import ReferenceCache
from hdril.evaluation.score import score_episode
from hdril.trace import trace_episode
from hdril.viewer.log import TIMELINE, log_lane
from hdril.viewer.recordings import APPLICATION, recording_name, write_episodes

RESULTS = "results.json"


@dataclass(frozen=True)
class Evaluation:
    """An evaluation on disk: the folder that ``hdril-eval`` wrote.

    Raises:
        FileNotFoundError: there is none.
    """

    folder: Path

    def __post_init__(self) -> None:
        if not (self.folder / RESULTS).exists():
            raise FileNotFoundError(f"{self.folder} holds no {RESULTS}: give the output_dir of a finished hdril-eval")

    @property
    def results(self) -> dict[str, Any]:
        return json.loads((self.folder / RESULTS).read_text())

    def recordings(self, seed: int | None = None) -> list[Path]:
        """Its recordings, in the order of seeds; of one seed if that is given."""
        pattern = "seed_*.rrd" if seed is None else f"seed_{seed:07d}_*.rrd"
        return sorted((self.folder / "rerun").glob(pattern))

    def worker(self) -> Worker:
        """Ready to play any seed as it was played then."""
        values = self.results
        return Worker(Job(values["task"], values["policy"], tuple(values["overrides"])))


def replay(evaluation: Evaluation, seed: int, path: Path) -> Path:
    """Play a seed again, which gives the same episode, and write its recording to ``path``."""
    worker = evaluation.worker()
    with closing(worker.env):
        episode = worker.play(seed)
        return write_episodes(path, recording_name(episode.outcome), {"": episode})


def compare(first: Evaluation, second: Evaluation, seed: int, path: Path) -> Path:
    """Play a seed with the policies of two evaluations, and write both episodes into one recording, side by side.

    Raises:
        ValueError: the evaluations are of different tasks.
    """
    tasks = [evaluation.results["task"] for evaluation in (first, second)]
    if tasks[0] != tasks[1]:
        raise ValueError(f"{first.folder} is of the task {tasks[0]!r}, {second.folder} of {tasks[1]!r}")
    with ExitStack() as worlds:
        episodes: dict[str, EvaluatedEpisode] = {}
        for evaluation, name in zip((first, second), _names(first.folder, second.folder), strict=True):
            worker = evaluation.worker()
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
    seed = provenance.seeds[episode]
    actions = ReplayActor(stored.action)
    env = provenance.recipe.make_env()
    with closing(env):
        reference = ReferenceCache(BimanualEnv(provenance.recipe.task)).get(seed)
        trace, ending = trace_episode(env, actions, seed, stored.label)
        outcome = score_episode(env.task_spec, seed, trace, reference, ending)
        name = f"episode_{episode:06d}_{recording_name(outcome)}"
        write_episodes(path, name, {"": EvaluatedEpisode(env, outcome, trace, reference)})
    apart = np.abs(trace.state[:-1] - stored.state).max()
    return path, f"seed {seed}, played again: its states are {apart:.2g} m or less from the recorded ones"


def _foreign(stored: StoredEpisode, path: Path) -> Path:
    at = [rr.TimeColumn(TIMELINE, duration=stored.time)]
    path.parent.mkdir(parents=True, exist_ok=True)
    views: list[Any] = [rrb.Spatial3DView(origin="world", name="Poses")]
    with rr.RecordingStream(APPLICATION) as stream:
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
