"""hdril-bench: speeds as ratios within one run, because an absolute time says more of the machine than of the code."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hdril.cli.common import run
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.record import play, record
from hdril.env import BimanualEnv
from hdril.errors import UserError
from hdril.rollout import run_episode
from hdril.simulation.sensor import Sensor
from hdril.simulation.world import World
from hdril.tasks import Task, base_name
from hdril.tasks.expert import ScriptedExpert


@dataclass
class BenchConfig:
    """Measure recording against the bare simulator, several processes against one, what scenes that vary cost, the loader against
    a training step, one action, Rerun recordings against the evaluation, training against LeRobot's ACT, and HDR-IL's models
    called as one or one by one."""

    task: str = "table_lift"
    """Name of the task, with its parameters if it has any (peg_in_hole:clearance=0.004); an unknown one is answered with
    those there are."""
    episodes: int = 12
    """Episodes that are recorded, and that several processes play."""
    train_steps: int = 60
    """Training steps that are timed, after ten to warm up."""


@dataclass(frozen=True)
class Figure:
    """A measured number, and the limit that it should keep."""

    name: str
    value: float
    limit: float
    at_least: bool
    unit: str

    def __str__(self) -> str:
        ok = self.value >= self.limit if self.at_least else self.value <= self.limit
        bound = "at least" if self.at_least else "at most"
        return f"{'ok  ' if ok else 'MISS'}  {self.name}: {self.value:.2f} {self.unit} ({bound} {self.limit:g})"


def _seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def bench_recording(task: str, episodes: int, root: Path) -> Figure:
    """Share of recording, files included, that is spent in the simulator's own timesteps; one core."""
    import lerobot.datasets.dataset_metadata  # noqa: F401  # its import is a start-up cost, not recording's

    bare, step = 0.0, World.step

    def timed_step(world: World, count: int = 1) -> None:
        nonlocal bare
        bare += _seconds(lambda: step(world, count))

    with patch.object(World, "step", timed_step):
        whole = _seconds(lambda: record(Recipe(task), episodes, 0, root))
    return Figure("recording, share of the bare simulator's rate", 100.0 * bare / whole, 70.0, True, "%")


def bench_ranks(task: str, episodes: int) -> list[Figure]:
    """Episodes a second that 2, 4 and 8 processes play, against one, without the start of the processes.

    ``episodes`` is rounded up to a multiple of 8: eight processes finish at about the same time.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    recipe, rates, timed = Recipe(task), {}, -(-episodes // 8) * 8
    for ranks in (1, 2, 4, 8):
        with closing(play(recipe, itertools.count(), ranks)) as played:
            for _ in range(2 * ranks):  # by then most processes have played their first
                next(played)
            rates[ranks] = timed / _seconds(lambda: [next(played) for _ in range(timed)])
    return [
        Figure(
            f"playing with {ranks} processes against one, {cores} cores",
            rate / rates[1],
            0.7 * min(ranks, cores),
            True,
            "times",
        )
        for ranks, rate in rates.items()
        if ranks > 1
    ]


def bench_scenes(task: str, episodes: int) -> Figure:
    """Share of the expert's episodes at the level ``hard`` that sampling, the sensor and the events take; one core."""
    parts = [
        (Task, "sample"), (Task, "at"), (Sensor, "__init__"), (Sensor, "observe"), (World, "_disturb"),
        (BimanualEnv, "_begin_events"), (BimanualEnv, "_start_arms"),
    ]  # fmt: skip
    env = BimanualEnv(f"{base_name(task)}:level=hard")
    expert, seconds = ScriptedExpert(env.task_spec), 0.0

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal seconds
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds += time.perf_counter() - start

        return call

    with ExitStack() as stack, closing(env):
        run_episode(env, expert, 0)
        for owner, name in parts:
            stack.enter_context(patch.object(owner, name, timed(getattr(owner, name))))
        whole = _seconds(lambda: [run_episode(env, expert, seed) for seed in range(1, episodes)])
    return Figure("scenes that vary and events, share of an episode", 100.0 * seconds / whole, 2.0, False, "%")


def bench_training(task: str, root: Path, steps: int, output: Path) -> Figure:
    """Share of a step of stock ``lerobot-train`` that waits for the loader."""
    import re
    import subprocess
    import sys

    warmup = 10
    command = [
        str(Path(sys.executable).with_name("lerobot-train")),
        f"--config_path={_training_config(task)}",
        f"--dataset.root={root}",
        f"--output_dir={output}",
        f"--steps={warmup + steps}",
        "--log_freq=10",
        "--save_checkpoint=false",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"HF_HUB_OFFLINE": "1"}, check=False
    )
    times = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", done.stderr + done.stdout)
    if len(times) < 2:
        raise UserError(f"lerobot-train failed: {done.stderr.strip().splitlines()[-1:]}")
    update = sum(float(u) for u, _ in times[1:])
    data = sum(float(d) for _, d in times[1:])
    return Figure("loader, share of a training step", 100.0 * data / (update + data), 30.0, False, "%")


def _training_config(task: str) -> Path:
    """The config file of a task's training: its own, or that of demonstrations in which something goes wrong."""
    own = Path("configs/train") / f"{base_name(task)}.yaml"
    return own if own.exists() else own.with_name("hard.yaml")


def bench_action(root: Path) -> list[Figure]:
    """One ``select_action`` of the default policy on one core, averaged over an episode and the slowest of one.

    It is shown a demonstration, after enough training for its planner to follow. A policy makes a plan whenever a primitive
    begins, and an untrained planner begins them as often as it may.
    """
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import make_policy
    from lerobot_policy_hdril import HDRILConfig

    torch.set_num_threads(1)
    dataset = LeRobotDataset("hdril/bench", root=root)
    policy = make_policy(HDRILConfig(device="cpu", push_to_hub=False), ds_meta=dataset.meta)
    _samples_per_second(policy, {"index": torch.arange(0, dataset.meta.total_frames, 5)}, 60)
    policy.eval()
    assert dataset.meta.episodes is not None
    items: list[Any] = [dataset[i] for i in range(dataset.meta.episodes[0]["length"])]
    seen = [{key: value[None] for key, value in item.items() if "observation" in key} for item in items]

    def play() -> list[float]:
        policy.reset()
        return [_seconds(lambda batch=batch: policy.select_action(batch)) for batch in seen]

    with torch.inference_mode():  # as LeRobot calls it
        play()
        played = [play() for _ in range(5)]
    # What else runs on the machine makes single actions slow: the best of five episodes is the policy's own.
    mean, slowest = min(sum(seconds) for seconds in played) / len(seen), min(max(seconds) for seconds in played)
    return [
        Figure("one action, amortised over an episode", 1e3 * mean, 2.0, False, "ms"),
        Figure("the slowest action of an episode", 1e3 * slowest, 10.0, False, "ms"),
    ]


def _samples_per_second(policy, batch: dict, steps: int, mixed: bool = False) -> float:
    """Frames that training steps (forward, backward, optimiser) take in a second, after one step to warm up. ``mixed``:
    matrix products in bfloat16, as ``accelerate launch --mixed_precision=bf16`` has them."""
    import torch

    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    step()
    best = min(_seconds(step) for _ in range(steps))
    return len(batch["index"]) / best


def bench_policies(root: Path) -> list[Figure]:
    """HDR-IL's training against ACT's, both at LeRobot's defaults, and what the choices for its networks (called one by one,
    float32) gain or cost; one core."""
    import torch
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.factory import make_policy
    from lerobot_policy_hdril import HDRILConfig

    torch.set_num_threads(1)
    metadata = LeRobotDatasetMetadata("hdril/bench", root=root)
    generator = torch.Generator().manual_seed(0)

    def frames(count: int) -> dict[str, torch.Tensor]:
        return {"index": torch.randint(metadata.total_frames, (count,), generator=generator)}

    def hdril(mixed: bool = False, **values: Any) -> float:
        config = HDRILConfig(device="cpu", push_to_hub=False, **values)
        return _samples_per_second(make_policy(config, ds_meta=metadata), frames(64), 5, mixed)

    ours, separate = hdril(), hdril(decoder="gru", experts="separate")
    stacked, mixed = hdril(decoder="gru", experts="stacked"), hdril(mixed=True, decoder="gru", experts="separate")
    act_config = ACTConfig(device="cpu", push_to_hub=False)
    act = make_policy(act_config, ds_meta=metadata)
    batch = frames(8)
    for key, feature in (act_config.input_features or {}).items():
        batch[key] = torch.randn(8, *feature.shape, generator=generator)
    batch["action"] = torch.randn(8, act_config.chunk_size, *metadata.features["action"]["shape"], generator=generator)
    batch["action_is_pad"] = torch.zeros(8, act_config.chunk_size, dtype=torch.bool)
    theirs = _samples_per_second(act, batch, 3)
    return [
        Figure("training, samples per second against ACT's", ours / theirs, 30.0, True, "times"),
        Figure("the models one by one against stacked", separate / stacked, 0.9, True, "times"),
        Figure("training in float32 against mixed precision", separate / mixed, 0.9, True, "times"),
    ]


def bench_rerun(task: str, folder: Path) -> Figure:
    """Share of an evaluation, the expert's episode included, that its Rerun recording takes; one core. The policy's own time
    is left out: the share with one is less."""
    from hdril.evaluation.evaluate import EvaluatedEpisode
    from hdril.evaluation.reference import Reference
    from hdril.evaluation.score import score_episode
    from hdril.tasks.primitives import Noise
    from hdril.trace import trace_episode
    from hdril.viewer.recordings import write_recording

    env = BimanualEnv(task)
    expert, seconds = ScriptedExpert(env.task_spec, Noise(0.0)), {"episodes": 0.0, "recording": 0.0}
    for seed in range(5):
        start = time.perf_counter()
        (trace, ending), (again, _) = (trace_episode(env, expert, seed) for _ in range(2))
        reference = Reference.of(env.task_spec, again, ending)
        outcome = score_episode(env.task_spec, seed, trace, reference, ending)
        middle = time.perf_counter()
        write_recording(folder, EvaluatedEpisode(env, outcome, trace, reference))
        if seed:  # the first one starts Rerun
            seconds["episodes"] += middle - start
            seconds["recording"] += time.perf_counter() - middle
    env.close()
    share = 100.0 * seconds["recording"] / sum(seconds.values())
    return Figure("Rerun recordings, share of an evaluation", share, 10.0, False, "%")


def bench_command(config: BenchConfig) -> None:
    Recipe(config.task)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        print(bench_recording(config.task, config.episodes, root), flush=True)
        for figure in bench_ranks(config.task, config.episodes):
            print(figure, flush=True)
        print(bench_scenes(config.task, config.episodes), flush=True)
        print(bench_training(config.task, root, config.train_steps, Path(folder) / "train"), flush=True)
        for figure in bench_action(root):
            print(figure, flush=True)
        print(bench_rerun(config.task, Path(folder) / "rerun"), flush=True)
        for figure in bench_policies(root):
            print(figure, flush=True)


def main() -> None:
    """Entry point."""
    run("hdril-bench", BenchConfig, bench_command)


if __name__ == "__main__":
    main()
