"""A picture of a task: the last frame of every primitive, as the scripted expert plays it.

python scripts/filmstrip.py --task=table_lift --seed=6 --output=docs/table_lift.jpg
"""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from hdril.env import BimanualEnv
from hdril.rollout import transitions
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise


def ends(env: BimanualEnv, expert: ScriptedExpert, seed: int) -> dict[int, str]:
    """Names of the primitives that the expert plays, by their last frame."""
    names, starts = [], []
    for frame, transition in enumerate(transitions(env, expert, seed)):
        explanation = transition.decision.explanation
        assert explanation is not None
        if explanation.starts:
            starts.append(frame)
        names.append(env.task_spec.labels[explanation.primitive])
    return {end - 1: names[end - 1] for end in (*starts[1:], len(names))}


def frames(task: str, seed: int) -> list[tuple[str, np.ndarray]]:
    """(name, picture) at the end of each primitive."""
    env = BimanualEnv(task, meshes=True)
    expert = ScriptedExpert(env.task_spec, Noise(0.0))
    camera = replace(env.task_spec.camera, width=480, height=400)
    pictures = []
    with closing(env):
        last = ends(env, expert, seed)
        for frame, _ in enumerate(transitions(env, expert, seed)):
            if frame in last:
                pictures.append((last[frame], env.world.render(camera)))
    return pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="table_lift")
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--columns", type=int, default=3)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    pictures = frames(options.task, options.seed)
    rows = -(-len(pictures) // options.columns)
    figure, axes = plt.subplots(
        rows, options.columns, figsize=(3.4 * options.columns, 2.95 * rows), layout="constrained", squeeze=False
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for number, (axis, (name, picture)) in enumerate(zip(axes.flat, pictures, strict=False), start=1):
        axis.imshow(picture)
        axis.set_title(f"{number}. {name}", fontsize=10)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output, dpi=100, pil_kwargs={"quality": 85} if options.output.suffix == ".jpg" else None)


if __name__ == "__main__":
    main()
