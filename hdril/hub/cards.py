"""Cards for the Hub: of a dataset that we recorded, and the evaluation in a model's card."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from huggingface_hub import EvalResult, ModelCard
from lerobot_policy_hdril.card import CITATION, EVALUATION

from hdril.demonstrations.provenance import RECIPE_PATH, read_provenance
from hdril.demonstrations.schema import features
from hdril.digest import SHORT
from hdril.evaluation.checkpoint import Checkpoint
from hdril.evaluation.held_out import find_training_data
from hdril.evaluation.results import headline
from hdril.markdown import table
from hdril.tasks import base_name, get_task

PAPER = "https://arxiv.org/abs/2010.05134"
TAGS = ["hdril", "robotics", "bimanual", "imitation-learning", "simulation", "pybullet", "baxter"]


def dataset_card(repo_id: str, root: Path) -> str:
    """The card of a dataset that ``hdril-record`` made: every field of LeRobot's template, recipe, labels, and commands.

    Raises:
        ValueError: hdril did not record it.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.utils import create_lerobot_dataset_card

    provenance = read_provenance(root)
    if provenance is None:
        raise ValueError(f"{root} was not recorded by hdril: it has no {RECIPE_PATH}")
    metadata = LeRobotDatasetMetadata(repo_id, root=root)
    task, recipe = get_task(provenance.recipe.task), provenance.recipe
    noise = " ".join(f"--noise.{name}={value}" for name, value in asdict(recipe.noise).items())
    noise += f" --perturb={recipe.perturb:g}" if recipe.perturb else ""
    noise += f" --stray={recipe.stray:g}" if recipe.stray else ""
    dropped = len(provenance.dropped)
    description = f"""Scripted demonstrations of the task `{recipe.task}` ({task.description}) with two arms of a simulated
{recipe.robot.capitalize()}: {metadata.total_episodes} episodes, {metadata.total_frames} frames at {metadata.fps} Hz, each
frame labelled with its movement primitive. All episodes succeed; {dropped} of
{metadata.total_episodes + dropped} that were tried failed and were dropped."""
    card = create_lerobot_dataset_card(
        tags=[*TAGS, base_name(recipe.task)],
        dataset_info=metadata.info,
        repo_id=repo_id,
        license="apache-2.0",
        url=f"https://huggingface.co/datasets/{repo_id}",
        paper=PAPER,
        citation_bibtex=CITATION,
        dataset_description=description,
    )
    own = f"""
## Features

{
        table(
            ("feature", "shape", "numbers"),
            [
                (f"`{key}`", tuple(feature["shape"]), ", ".join(feature["names"] or []))
                for key, feature in features(recipe).items()
            ],
        )
    }

Poses are m and unit quaternions (xyzw) in the world frame: x forward from the robot, y to its left, z up, bench top z = 0.
Grippers go from 0 (closed) to 1 (open).

## Labels

`subtask_index` of each frame; names in `meta/subtasks.parquet`.

{
        table(
            ("label", "primitive", "frames, if it is not broken off"),
            [
                (label, name, sum(primitive.frames for primitive in task.primitives if primitive.name == name))
                for label, name in enumerate(task.labels)
            ],
        )
    }

## Recipe

Each episode can be made again from its seed ({min(provenance.seeds)} to {max(provenance.seeds)}; the column `seed` of
`meta/episodes`) and this recipe, which is also `{RECIPE_PATH}`.

```json
{json.dumps(provenance.recipe_values, indent=2)}
```

## Use

```
hdril-record --task={recipe.task} --repo_id={repo_id} \\
  --num_episodes={metadata.total_episodes} --seed={min(provenance.seeds)} {noise}
lerobot-train --policy.type=hdril --policy.push_to_hub=false --dataset.repo_id={repo_id}
lerobot-dataset-viz --repo-id={repo_id} --episode-index=0
```
"""
    return f"{str(card).rstrip()}\n{own}"


def evaluation_section(summary: dict[str, Any], repo_id: str) -> str:
    """The results of an evaluation as text: rate, interval, errors, what made them, and the commands that give them."""
    task = summary["task"]
    low, high = summary["pc_success_ci95"]
    row = (
        f"`{task}`",
        f"{summary['n_success']} of {summary['n_episodes']}",
        f"{summary['pc_success']:.1f} %",
        f"{low:.1f} to {high:.1f} %",
        _mean(summary["position_error_cm"], 2, "cm"),
        _mean(summary["angle_error_rad"], 4, "rad"),
        _mean(summary["dtw_cm"], 2, "cm"),
    )
    heads = ("task", "succeeded", "rate", "95 % interval", "position error", "angle error", "DTW")
    return f"""{headline(summary)}. {_held_out(summary)} Errors are against the noise-free expert on the same seed.

{table(heads, [row])}

{_made_by(summary["identity"])}

```
{_commands(summary, repo_id)}
```

Seed by seed: `{folder_of(summary)}/results.json`.
"""


def _mean(spread: dict[str, float] | None, digits: int, unit: str) -> str:
    """Empty where there is nothing to compare with: the expert solved none of the seeds."""
    return "" if spread is None else f"{spread['mean']:.{digits}f} {unit}"


def _held_out(summary: dict[str, Any]) -> str:
    known = "The seeds are held out" if summary["held_out"] else "Whether the seeds are held out is not known"
    return f"{known}: {summary['held_out_basis']}."


def _made_by(identity: dict[str, Any]) -> str:
    """Weights and software, in one sentence."""
    policy, trials = identity["policy"], identity["trials"]
    software = ", ".join(f"{name} {version}" for name, version in (policy["software"] | trials["software"]).items())
    return (
        f"Evaluated: weights with the SHA-256 `{policy['weights'][:SHORT]}…`, on {policy['device']}, with {software}."
    )


def _commands(summary: dict[str, Any], repo_id: str) -> str:
    """The same evaluation with hdril's command and with LeRobot's."""
    task, count, seed = summary["task"], summary["n_episodes"], summary["first_seed"]
    options = "".join(f" --policy.{option.removeprefix('--')}" for option in summary["overrides"])
    frames = summary["max_frames"]
    ours, theirs = (f" --max_frames={frames}", f" --env.episode_length={frames}") if frames else ("", "")
    return "\n".join(
        (
            f"hdril-eval --policy.path={repo_id} --task={task} --num_episodes={count} --seed={seed}{ours}{options}",
            f"lerobot-eval --policy.path={repo_id} --env.type=hdril --env.task={task} --eval.n_episodes={count} "
            f"--eval.batch_size=1 --seed={seed}{theirs}{options}",
        )
    )


def folder_of(summary: dict[str, Any]) -> str:
    """Where the results of an evaluation lie in a model's repository."""
    name = re.sub(r"[^\w.=-]", "_", summary["task"])  # with its parameters, if it has any
    return f"eval/{name}_{summary['first_seed']}"


def with_evaluation(card: ModelCard, summary: dict[str, Any], repo_id: str) -> ModelCard:
    """A model's card with the section "Evaluation" filled, and the rate where the Hub's search looks for it.

    The section ends at the next heading of its level; a card without one gets it at its end.
    """
    before, heading, rest = card.text.partition(f"\n{EVALUATION}\n")
    cut = rest.find("\n## ")
    after = rest[cut:] if heading and cut >= 0 else "\n"
    text = f"{before.rstrip()}\n\n{EVALUATION}\n\n{evaluation_section(summary, repo_id)}{after}"
    result = EvalResult(
        task_type="robotics", dataset_type="hdril", dataset_name=summary["task"],
        dataset_config=summary["task"], metric_type="success_rate",
        metric_name="success rate, %", metric_value=round(summary["pc_success"], 2),
    )  # fmt: skip
    data: Any = card.data  # its fields are those of a model's card
    data.model_name = data.model_name or repo_id.split("/")[-1]
    others = [r for r in data.eval_results or [] if r.dataset_config != summary["task"]]
    data.eval_results = [*others, result]
    return ModelCard(f"---\n{data.to_yaml()}\n---\n{text}")


def checkpoint_card(checkpoint: Checkpoint, repo_id: str) -> str:
    """The card that LeRobot would have published with this checkpoint, for its repository ``repo_id``.

    The training data are described only if they are still what the checkpoint was trained on.
    """
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.factory import get_policy_class
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    training = TrainPipelineConfig.from_pretrained(checkpoint.folder)
    dataset, root = training.dataset, find_training_data(checkpoint)
    metadata = LeRobotDatasetMetadata(dataset.repo_id, root=root) if root is not None else None
    config = PreTrainedConfig.from_pretrained(checkpoint.folder)
    config.repo_id = repo_id
    policy = get_policy_class(config.type).from_pretrained(checkpoint.folder, config=config)
    card = policy.generate_model_card(
        dataset.repo_id, config.type, config.license, config.tags, cfg=training, dataset_meta=metadata
    )
    return str(card)
