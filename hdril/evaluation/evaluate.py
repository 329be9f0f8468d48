"""Any LeRobot policy on paired, held-out seeds: the scene of a seed is the same for every policy and for the expert."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from multiprocessing import get_context

from hdril.env import BimanualEnv
from hdril.evaluation.lerobot_actor import LeRobotActor
from hdril.evaluation.reference import Reference, ReferenceCache
from hdril.evaluation.score import Outcome, score_episode
from hdril.trace import Trace, trace_episode


@dataclass(frozen=True)
class EvaluatedEpisode:
    """An episode of a policy: how it went, all of it, and the expert's on the same seed. ``env`` holds its last frame."""

    env: BimanualEnv
    outcome: Outcome
    trace: Trace
    reference: Reference


EpisodeSink = Callable[[EvaluatedEpisode], object]
"""Takes each episode in the process that played it; it must be picklable."""


@dataclass(frozen=True)
class Job:
    """What to evaluate: a policy on a task."""

    task: str
    policy: str
    overrides: tuple[str, ...] = ()
    device: str = "cpu"


@dataclass
class Worker:
    """One process: an environment, the expert, and the policy."""

    job: Job
    env: BimanualEnv = field(init=False)

    def __post_init__(self) -> None:
        self.env = BimanualEnv(self.job.task)
        self._references = ReferenceCache(self.env)
        self._actor = LeRobotActor(self.job.policy, self.env.task_spec, self.job.overrides, self.job.device)

    def play(self, seed: int) -> EvaluatedEpisode:
        """Expert and policy on the scene of ``seed``."""
        reference = self._references.get(seed)
        trace, ending = trace_episode(self.env, self._actor, seed, reference.scripted)
        outcome = score_episode(self.env.task_spec, seed, trace, reference, ending)
        return EvaluatedEpisode(self.env, outcome, trace, reference)


_workers: dict[Job, Worker] = {}


def _work(job: Job, seed: int, sink: EpisodeSink | None) -> Outcome:
    # Built by the first call and not by the pool's initializer, whose errors reach nobody.
    if job not in _workers:
        _workers[job] = Worker(job)
    return _finish(_workers[job].play(seed), sink)


def _finish(episode: EvaluatedEpisode, sink: EpisodeSink | None) -> Outcome:
    if sink is not None:
        sink(episode)
    return episode.outcome


def evaluate(job: Job, seeds: list[int], workers: int = 1, sink: EpisodeSink | None = None) -> Generator[Outcome]:
    """Outcomes in the order of ``seeds``, the same for any number of workers: each plays one episode at a time.

    ``sink`` is given every episode, in the process that played it.
    """
    if workers == 1:
        worker = Worker(job)
        with closing(worker.env):
            yield from (_finish(worker.play(seed), sink) for seed in seeds)
        return
    pool = ProcessPoolExecutor(workers, get_context("forkserver"))
    try:
        futures: list[Future[Outcome]] = [pool.submit(_work, job, seed, sink) for seed in seeds]
        for future in futures:
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
