"""Any LeRobot policy on paired, held-out seeds: the scene of a seed is the same for every policy and for the expert."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.control import ACTION_NAMES
from hdril.demonstrator import Demonstrator, Observation
from hdril.env import BimanualEnv
from hdril.files import cache_folder, write_atomically
from hdril.metrics import hand_poses, trajectory_error
from hdril.primitives import Noise
from hdril.recording import Provenance, read_provenance
from hdril.tasks import Task, base_name
from hdril.trace import Belief, Move, Trace, demonstrate_trace, run_episode

DEPARTURE = 0.02
"""m from the expert's path at which an episode counts as having left it: none of 100 successes of `make demo` did."""


@dataclass(frozen=True)
class Outcome:
    """How one episode went. Errors are against the noise-free expert on the same seed: cm, rad, cm."""

    seed: int
    success: bool
    unmet: str
    frames: int
    ik_failures: int
    position_error_cm: float
    angle_error_rad: float
    dtw_cm: float
    position_error_cm_by_primitive: dict[str, float]
    start: tuple[float, ...]
    """x and y of every observed object at the start, m."""
    primitives: tuple[str, ...] = ()
    """What the policy played, in order; empty if it has no primitives."""
    stage: str = ""
    """The last of the task's stages that was reached; empty if none was."""
    measures: dict[str, float] = field(default_factory=dict)
    """The task's measures at the end."""
    planner_confusion: list[list[int]] = field(default_factory=list)
    """Frames of the expert's primitive (row) at which the planner preferred each (column); empty without a planner."""
    planner_boundary_hits: list[bool] = field(default_factory=list)
    """For each primitive of the expert, whether the planner preferred it at its first frame."""
    departed_frame: int = -1
    """First frame at whose end a hand or an object is more than :data:`DEPARTURE` from where the expert has it; -1: none."""
    departed_in: str = ""
    """The primitive that was played then (the expert's, if the policy has none)."""


@dataclass(frozen=True)
class Reference:
    """What an episode is compared with: the noise-free expert's episode on the same seed."""

    state: NDArray[np.float32]  # (T + 1, 16)
    environment_state: NDArray[np.float32]  # (T + 1, 7 per object)
    scripted: NDArray[np.int64]  # (T,), labels

    @staticmethod
    def of(trace: Trace) -> Reference:
        return Reference(trace.state, trace.environment_state, trace.scripted)


class LeRobotActor:
    """A LeRobot checkpoint, with its processors, acting on one environment.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        ValueError: the checkpoint does not fit the environment.
    """

    def __init__(self, path: str, task: Task, overrides: tuple[str, ...] = (), device: str = "cpu") -> None:
        import torch
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        # Registers the policy types of lerobot_policy_* distributions.
        from lerobot.utils.import_utils import register_third_party_plugins

        register_third_party_plugins()
        torch.set_num_threads(1)
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[*overrides, f"--device={device}"])
        self.policy = get_policy_class(config.type).from_pretrained(path, config=config)
        self._before, self._after = make_pre_post_processors(
            config, pretrained_path=path, preprocessor_overrides={"device_processor": {"device": device}}
        )
        self._torch = torch
        self._description = task.description
        # Columns of the policy's primitives among the task's labels.
        primitives = getattr(config, "primitives", None) or []
        self._labels = np.array([task.labels.index(name) if name in task.labels else -1 for name in primitives])
        self._count = len(task.labels)
        self._believes = bool(primitives) and hasattr(self.policy, "attention")

    def reset(self, seed: int) -> None:
        """Begin an episode; a policy that samples draws the same numbers for the same seed."""
        self._torch.manual_seed(seed)
        self.policy.reset()

    def act(self, observation: Observation) -> Move:
        """The action for an observation, and what the policy thinks if it has primitives."""
        from lerobot.envs.utils import preprocess_observation

        batch: dict[str, Any] = preprocess_observation(dict(observation))
        batch["task"] = [self._description]
        with self._torch.inference_mode():
            action = self._after(self.policy.select_action(self._before(batch)))
            return Move(action[0].numpy().astype(np.float32), self._belief())

    def _belief(self) -> Belief | None:
        rollout: Any = getattr(self.policy, "rollout", None)
        if not self._believes or rollout is None:
            return None
        probabilities = np.zeros(self._count, np.float32)
        known = self._labels >= 0
        probabilities[self._labels[known]] = rollout.probabilities[0].cpu().numpy()[known]
        plan = rollout.plan[0, :, : len(ACTION_NAMES)].cpu().numpy().copy() if bool(rollout.replanned[0]) else None
        if plan is not None:
            # The plan ends with the longest recorded form of this primitive.
            plan = plan[: max(1, int(self.policy.longest_length[rollout.primitive[0]] - rollout.plan_start[0]))]  # pyright: ignore
        received = self.policy.attention().received()  # pyright: ignore
        attention = {name: float(share[0]) for name, share in received.items()}
        return Belief(int(self._labels[int(rollout.primitive[0])]), probabilities, plan, attention)


class ReferenceCache:
    """The expert's episodes on disk, by seed: several policies on the same seeds need each of them once.

    They lie in ``$XDG_CACHE_HOME/hdril/expert`` (``~/.cache`` unless set), under a digest of the task and of this
    package's source: another version of the code plays them anew.
    """

    def __init__(self, env: BimanualEnv) -> None:
        self._env, self._expert = env, Demonstrator(env.task_spec, Noise(0.0))
        digest = hashlib.sha256(env.task.encode())
        for file in sorted(Path(__file__).parent.rglob("*.py")):
            digest.update(file.read_bytes())
        self._folder = cache_folder() / "expert" / digest.hexdigest()[:16]

    def get(self, seed: int) -> Reference:
        """The expert's episode of this seed, played now unless it is there."""
        path = self._folder / f"{seed}.npz"
        if path.exists():
            with np.load(path) as data:
                return Reference(**data)
        reference = Reference.of(demonstrate_trace(self._env, self._expert, seed))
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **vars(reference)))
        return reference


def judge(task: Task, seed: int, trace: Trace, reference: Reference, success: bool, unmet: str) -> Outcome:
    """Compare an episode with the expert's."""
    error = trajectory_error(trace.state, reference.state)
    names = np.array(task.labels)
    # Row i + 1 is where the action of frame i led.
    labels = reference.scripted[: len(error.position) - 1]
    by_primitive = {
        str(name): 100.0 * float(error.position[1:][labels == k].mean())
        for k, name in enumerate(names)
        if (labels == k).any()
    }
    executed = trace.executed
    changes = np.flatnonzero(np.diff(executed, prepend=-2))
    played = tuple(str(names[executed[i]]) for i in changes if 0 <= executed[i] < len(names))
    start = trace.environment_state[0].reshape(-1, 7)[:, :2]
    confusion, hits = _planner_scores(trace, len(names))
    departed = _departure(trace, reference)
    doing = -1 if departed < 0 else executed[departed] if executed[departed] >= 0 else trace.scripted[departed]
    return Outcome(
        seed=seed,
        success=success,
        unmet=unmet,
        frames=len(trace.action),
        ik_failures=sum(bool(failure) for failure in trace.ik_failures),
        position_error_cm=100.0 * float(error.position.mean()),
        angle_error_rad=float(error.angle.mean()),
        dtw_cm=100.0 * error.dtw,
        position_error_cm_by_primitive=by_primitive,
        start=tuple(round(float(v), 4) for v in start.ravel()),
        primitives=played,
        stage=("", *(stage.name for stage in task.stages), "success")[trace.stage[-1]],
        planner_confusion=confusion,
        planner_boundary_hits=hits,
        departed_frame=departed,
        departed_in=str(names[doing]) if doing >= 0 else "",
        measures={m.name: round(float(v), 5) for m, v in zip(task.measures, trace.measures[-1], strict=True)},
    )


def _departure(trace: Trace, reference: Reference) -> int:
    """The frame whose end is the first with a hand or an object too far from the expert's; -1 if there is none."""

    def positions(episode: Trace | Reference) -> NDArray[np.float64]:
        objects = episode.environment_state.reshape(len(episode.state), -1, 7)
        return np.concatenate([hand_poses(episode.state), objects], axis=1)[..., :3]

    ours, theirs = positions(trace), positions(reference)
    frames = min(len(ours), len(theirs))
    away = np.linalg.norm(ours[:frames] - theirs[:frames], axis=-1).max(1) > DEPARTURE
    return max(int(away.argmax()) - 1, 0) if away.any() else -1


def _planner_scores(trace: Trace, count: int) -> tuple[list[list[int]], list[bool]]:
    """Confusion matrix (K, K) over frames, and hits at the first frames of the expert's primitives."""
    if any(belief is None for belief in trace.beliefs):
        return [], []
    preferred = trace.predicted
    confusion = np.zeros((count, count), np.int64)
    scripted = trace.scripted
    np.add.at(confusion, (scripted[scripted >= 0], preferred[scripted >= 0]), 1)
    first = np.flatnonzero(np.diff(scripted, prepend=-1))
    return confusion.tolist(), [bool(preferred[i] == scripted[i]) for i in first if scripted[i] >= 0]


def check_keep(option: str, keep: str) -> None:
    """Raises ValueError unless ``keep`` says which episodes to keep as recordings; ``option`` is what a user typed."""
    if keep not in ("failures", "all", "none") and not keep.isdigit():
        raise ValueError(f"{option} must be failures, all, none or a number, got {keep!r}")


def keeps(keep: str, number: int, success: bool) -> bool:
    """Whether to keep the episode of this number, counted from 0."""
    if keep.isdigit():
        return number < int(keep)
    return keep == "all" or (keep == "failures" and not success)


@dataclass(frozen=True)
class Job:
    """What a worker needs. ``recordings`` is the folder for Rerun files; ``keep`` says which episodes get one."""

    task: str
    policy: str
    overrides: tuple[str, ...] = ()
    device: str = "cpu"
    recordings: Path | None = None
    keep: str = "none"
    """``none``, ``failures``, ``all``, or the number of episodes to keep from ``first_seed`` on."""
    first_seed: int = 0


@dataclass
class Worker:
    """One process: an environment, the expert, and the policy."""

    job: Job
    env: BimanualEnv = field(init=False)

    def __post_init__(self) -> None:
        self.env = BimanualEnv(self.job.task)
        self._references = ReferenceCache(self.env)
        self._actor = LeRobotActor(self.job.policy, self.env.task_spec, self.job.overrides, self.job.device)

    def play(self, seed: int) -> tuple[Outcome, Trace, Reference]:
        """Expert and policy on the scene of ``seed``."""
        reference = self._references.get(seed)
        self._actor.reset(seed)
        trace, success, unmet = run_episode(self.env, self._actor.act, seed, reference.scripted)
        return judge(self.env.task_spec, seed, trace, reference, success, unmet), trace, reference

    def run(self, seed: int) -> Outcome:
        """Play the scene of ``seed``; writes the Rerun file if the episode is to be kept."""
        outcome, trace, reference = self.play(seed)
        number = seed - self.job.first_seed
        if self.job.recordings is not None and keeps(self.job.keep, number, outcome.success):
            from hdril.rerun_log import write_recording

            write_recording(self.job.recordings, self.env, outcome, trace, reference)
        return outcome


_workers: dict[Job, Worker] = {}


def _work(job: Job, seed: int) -> Outcome:
    # Built by the first call and not by the pool's initializer, whose errors reach nobody.
    if job not in _workers:
        _workers[job] = Worker(job)
    return _workers[job].run(seed)


def evaluate(job: Job, seeds: list[int], workers: int = 1) -> Generator[Outcome]:
    """Outcomes in the order of ``seeds``, the same for any number of workers: each plays one episode at a time."""
    if workers == 1:
        worker = Worker(job)
        with closing(worker.env):
            yield from map(worker.run, seeds)
        return
    pool = ProcessPoolExecutor(workers, get_context("forkserver"))
    try:
        futures: list[Future[Outcome]] = [pool.submit(_work, job, seed) for seed in seeds]
        for future in futures:
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def training_provenance(policy: str) -> Provenance | None:
    """How the data were made that a checkpoint was trained on; None if that cannot be told from here."""
    path = Path(policy) / "train_config.json"
    if not path.exists():
        return None
    dataset = json.loads(path.read_text()).get("dataset") or {}
    root = dataset.get("root")
    if root is None and dataset.get("repo_id"):
        from lerobot.utils.constants import HF_LEROBOT_HOME

        root = HF_LEROBOT_HOME / dataset["repo_id"]
    return read_provenance(Path(root)) if root else None


def check_held_out(provenance: Provenance | None, task: str, seeds: list[int]) -> bool:
    """Whether the seeds are known to be held out: False if there is no telling.

    Raises:
        ValueError: the policy was trained on some of the seeds, or on another task.
    """
    if provenance is None:
        return False
    if base_name(provenance.recipe.task) != base_name(task):
        raise ValueError(f"the policy was trained on the task {provenance.recipe.task!r}, not on {task!r}")
    if shared := set(seeds) & set(provenance.seeds):
        raise ValueError(
            f"{len(shared)} of {len(seeds)} seeds ({min(shared)} to {max(shared)}) were in the training data, which are seeds "
            f"{min(provenance.seeds)} to {max(provenance.seeds)}; choose a seed above {max(provenance.seeds)}"
        )
    return True
