"""How often the scripted expert succeeds, for every task: nominal, each factor, varied, each event and hard.

python scripts/experts.py                               plays what is missing, then writes docs/experts.md and .json
python scripts/experts.py --tasks handover --episodes 50 --document outputs/experts

Rows that are in the JSON are kept if the same sources made them: after Ctrl-C the same command plays
the rest. The expert has the noise that demonstrations have.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hdril.actor import Actor
from hdril.demonstrations.provenance import Recipe
from hdril.env import BimanualEnv
from hdril.evaluation.software import episode_software
from hdril.evaluation.statistics import wilson_interval
from hdril.evaluation.suite import Cell, factor_cells
from hdril.files import write_atomically
from hdril.markdown import table
from hdril.rollout import Ending, run_episode
from hdril.tasks import TASKS
from hdril.tasks.factors import DELAY, POSITION_NOISE, ROTATION_NOISE
from hdril.workers import worker_pool

TARGETS = {"event": 95.0, "hard": 95.0}
"""Success that the expert should have, %; 99 in the other cells."""


@cache
def _stage(task: str) -> tuple[BimanualEnv, Actor]:
    recipe = Recipe(task)
    return recipe.make_env(), recipe.make_expert()


def play(task: str, seed: int) -> Ending:
    """The expert's episode of a seed."""
    return run_episode(*_stage(task), seed)


def cells(task: str) -> Iterator[Cell]:
    """What the expert is tried in: the rows of the factor table, without those in which only what is seen changes."""
    unseen = {POSITION_NOISE.name, ROTATION_NOISE.name, DELAY.name}
    unseen |= {event.name for event in TASKS[task].events if event.kind in ("freeze", "repeat")}
    return (cell for cell in factor_cells(task, detailed=True) if cell.kind != "control" and cell.name not in unseen)


def row(task: str, cell: Cell, seeds: range, pool: Any) -> dict[str, Any]:
    """One row of the table, played now."""
    endings = list(tqdm(pool.map(play, [cell.task] * len(seeds), seeds), desc=f"{task}, {cell.name}", total=len(seeds)))
    failed = {seed: ending.unmet for seed, ending in zip(seeds, endings, strict=True) if not ending.success}
    return {
        "kind": cell.kind,
        "task": cell.task,
        "software": episode_software(task),
        "first_seed": seeds[0],
        "episodes": len(seeds),
        "successes": len(seeds) - len(failed),
        "mean_frames": sum(ending.frames for ending in endings) / len(seeds),
        "failed": failed,
    }


def _sources(version: str) -> str:
    """The digest in "0.1.0 (8136cab8cde6)"."""
    return version.partition("(")[2].rstrip(")")


def markdown(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The tables."""
    blocks = [
        "# The scripted experts",
        "How often the expert of each task succeeds: on nominal scenes, where one factor varies over its range, where all do "
        "(`varied`), where one event happens to a nominal scene, and where all factors vary and something happens (`hard`). "
        "Made by `python scripts/experts.py`. The expert has the noise of demonstrations. It sees exact poses and sizes: noise "
        "and delay of the observation, and events that blind the sensor, change nothing of what it does (a test compares the "
        "bits), and have no row. It does not know masses and friction. Intervals are Wilson's, 95 %. The seeds were used for "
        "nothing else, but for four rows on whose failures the expert was mended: peg_in_hole nominal, and stop_motor but for "
        "handover. The last column is a digest of the sources that decide an episode: rows of another digest than the others "
        "were not played again since those sources changed.",
    ]
    for task, known in rows.items():
        lines = [
            [
                name,
                f"{entry['successes']} of {entry['episodes']}",
                "{:.1f} to {:.1f} %".format(*(100 * x for x in wilson_interval(entry["successes"], entry["episodes"]))),
                f"{TARGETS.get(entry['kind'], 99.0):g} %",
                f"{entry['mean_frames']:.0f}",
                _sources(entry["software"]["hdril"]),
            ]
            for name, entry in known.items()
        ]
        first = next(iter(known.values()))["first_seed"]
        blocks += [f"## {task}", f"Seeds from {first} on.",
                   table(["scenes", "success", "95 % interval", "target", "mean frames", "sources"], lines)]  # fmt: skip
    return "\n\n".join(blocks) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS), metavar="TASK")
    parser.add_argument("--cells", nargs="+", default=[], metavar="CELL", help="rows to play; all unless given")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=8_200_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--document", type=Path, default=Path("docs/experts"), help="where the tables go")
    options = parser.parse_args()
    data, seeds = options.document.with_suffix(".json"), range(options.seed, options.seed + options.episodes)
    rows: dict[str, dict[str, Any]] = json.loads(data.read_text()) if data.exists() else {}
    for task in options.tasks:
        wanted = [cell for cell in cells(task) if not options.cells or cell.name in options.cells]
        if not wanted:
            parser.error(f"{task} has no such cell; its cells: {', '.join(cell.name for cell in cells(task))}")
        with worker_pool(options.workers) as pool:
            for cell in wanted:
                known = rows.get(task, {}).get(cell.name)
                same = {"software": episode_software(task), "first_seed": seeds[0], "episodes": len(seeds)}
                if known and same.items() <= known.items():
                    continue
                rows.setdefault(task, {})[cell.name] = row(task, cell, seeds, pool)
                ordered = {c.name: rows[task][c.name] for c in cells(task) if c.name in rows[task]}
                rows[task] = ordered
                write_atomically(data, lambda file: file.write(json.dumps(rows, indent=1).encode()))
                write_atomically(options.document.with_suffix(".md"), lambda file: file.write(markdown(rows).encode()))
    print(markdown(rows))


if __name__ == "__main__":
    main()
