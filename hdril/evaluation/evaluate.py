"""Any LeRobot policy on paired, held-out seeds: the scene of a seed is the same for every policy and for the expert."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace

from hdril.env import BimanualEnv
from hdril.evaluation.checkpoint import Checkpoint, find_checkpoint, identify, resolve_config
from hdril.evaluation.identity import Identity, identify_trials
from hdril.evaluation.lerobot_actor import LeRobotActor, foreign_primitives
from hdril.evaluation.mishap import MishapActor, first_grasp_ends
from hdril.evaluation.reference import Reference, ReferenceCache
from hdril.evaluation.score import Outcome, score_episode
from hdril.trace import Trace, trace_episode
from hdril.workers import worker_pool


@dataclass(frozen=True)
class EvaluatedEpisode:
    """An episode of a policy: how it went, all of it, and the expert's on the same seed. ``env`` holds its last frame."""

    env: BimanualEnv
    outcome: Outcome
    trace: Trace
    reference: Reference
    identity: Identity | None = None
    """What played it; None where that is not a checkpoint."""


EpisodeSink = Callable[[EvaluatedEpisode], object]
"""Takes each episode in the process that played it; it must be picklable."""


@dataclass(frozen=True)
class Job:
    """What to evaluate: a checkpoint on a task, and what both were when the evaluation began."""

    task: str
    """The task's name, as it was given."""
    checkpoint: Checkpoint
    identity: Identity
    overrides: tuple[str, ...] = ()

    @property
    def seeds(self) -> list[int]:
        trials = self.identity.trials
        return list(range(trials.first_seed, trials.first_seed + trials.num_episodes))


def make_job(
    task: str,
    policy: str | Checkpoint,
    first_seed: int,
    num_episodes: int,
    *,
    overrides: tuple[str, ...] = (),
    device: str = "cpu",
    max_frames: int | None = None,
    mishap: str = "",
) -> Job:
    """Find and check all that an evaluation needs; nothing is written.

    Args:
        task: its name, with parameters if there are any.
        policy: a checkpoint's folder, or a repository of the Hub.
        first_seed: of ``num_episodes`` seeds in a row.
        overrides: changes of the policy's config, as ``--name=value``.
        device: of the policy.
        max_frames: frames after which an episode is cut; the task's budget unless given.
        mishap: name of what changes the policy's first actions; nothing unless given.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        ValueError: something is invalid or damaged; says what, and the valid choices.
    """
    checkpoint = find_checkpoint(policy) if isinstance(policy, str) else policy
    trials = identify_trials(task, first_seed, num_episodes, max_frames, mishap)
    identity = Identity(identify(checkpoint, resolve_config(checkpoint, overrides, device)), trials)
    return Job(task, checkpoint, identity, overrides)


@dataclass
class Worker:
    """One process: an environment, the expert, and the policy.

    Raises:
        ValueError: the checkpoint is not what it was when the evaluation began.
    """

    job: Job
    env: BimanualEnv = field(init=False)

    def __post_init__(self) -> None:
        identity = self.job.identity
        self.env = BimanualEnv(self.job.task, max_episode_steps=identity.trials.max_frames)
        self._references = ReferenceCache(self.job.task)
        self.actor = LeRobotActor(
            self.job.checkpoint, self.env.task_spec, self.job.overrides, identity.policy.device, identity.policy
        )
        self._foreign = foreign_primitives(self.job.checkpoint, self.env.task_spec)

    def play(self, seed: int) -> EvaluatedEpisode:
        """Expert and policy on the scene of ``seed``."""
        reference = self._references.get(seed)
        mishap = self.job.identity.trials.mishap
        actor = MishapActor(self.actor, mishap, first_grasp_ends(reference)) if mishap else self.actor
        trace, ending = trace_episode(self.env, actor, seed, reference.scripted)
        outcome = score_episode(self.env.task_spec, seed, trace, reference, ending)
        if self._foreign:
            outcome = _without_planner(outcome)
        return EvaluatedEpisode(self.env, outcome, trace, reference, self.job.identity)


def _without_planner(outcome: Outcome) -> Outcome:
    """The planner chose among primitives that the expert does not know: neither its order nor its hits can be told."""
    return replace(outcome, primitives=(), planner_confusion=[], planner_boundary_hits=[])


_workers: dict[str, Worker] = {}


def _work(job: Job, seed: int, sink: EpisodeSink | None) -> Outcome:
    # Built by the first call and not by the pool's initializer, whose errors reach nobody.
    key = repr(job)
    if key not in _workers:
        for worker in _workers.values():  # of another job in the same pool, which is over
            worker.env.close()
        _workers.clear()
        _workers[key] = Worker(job)
    return _finish(_workers[key].play(seed), sink)


def _finish(episode: EvaluatedEpisode, sink: EpisodeSink | None) -> Outcome:
    if sink is not None:
        sink(episode)
    return episode.outcome


def evaluate(
    job: Job,
    seeds: list[int],
    workers: int = 1,
    sink: EpisodeSink | None = None,
    pool: Executor | None = None,
) -> Generator[Outcome]:
    """Outcomes in the order of ``seeds``, the same for any number of workers: each plays one episode at a time.

    ``sink`` is given every episode, in the process that played it. ``pool`` is used if it is given, for one job after the
    other; otherwise ``workers`` processes are started for this job.
    """
    if workers == 1 and pool is None:
        worker = Worker(job)
        with closing(worker.env):
            yield from (_finish(worker.play(seed), sink) for seed in seeds)
        return
    with worker_pool(workers) if pool is None else nullcontext(pool) as processes:
        futures: list[Future[Outcome]] = [processes.submit(_work, job, seed, sink) for seed in seeds]
        for future in futures:
            yield future.result()
