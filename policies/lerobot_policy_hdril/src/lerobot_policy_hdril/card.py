"""The model card of a policy on the Hub."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from huggingface_hub import ModelCard, ModelCardData
from tabulate import tabulate

from lerobot_policy_hdril.configuration_hdril import HDRILConfig
from lerobot_policy_hdril.provenance import from_runs, read_told

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

TAGS = ("bimanual", "hdril", "imitation-learning", "lerobot", "robotics")
EVALUATION = "## Evaluation"
"""Heading of the section that ``hdril-eval --push`` fills; it ends at the next heading of its level."""
NOT_EVALUATED = "_Not evaluated yet: `hdril-eval … --push` writes the results here._"
CITATION = """@inproceedings{xie2020deep,
  title = {Deep Imitation Learning for Bimanual Robotic Manipulation},
  author = {Xie, Fan and Chowdhury, Alexander and De Paolis Kaluza, M. Clara and Zhao, Linfeng and Wong, Lawson L. S.
    and Yu, Rose},
  booktitle = {Advances in Neural Information Processing Systems},
  year = {2020}
}"""
_CHOICES = ("preset", "interaction", "skip", "state_skip", "per_primitive", "decoder", "coordinates", "latent", "termination",
            "filter_frames", "long_filter_frames", "robust", "hand_noise", "fourier_features", "split_forms", "planner_balance",
            "planner_dropout", "planner_late", "planner_scale", "least_survival", "repeat_discount", "rollout", "replan_every",
            "plan_overlap", "hidden_dim")  # fmt: skip


def simulated_task(config: HDRILConfig, dataset_meta: LeRobotDatasetMetadata | None) -> str | None:
    """The task of ``--env.type=hdril`` that a policy learned; None if hdril did not record its dataset.

    The checkpoint's own record decides. The dataset is asked only about a policy without one.
    """
    if config.training_data and config.training_data[-1].digest:
        return config.training_data[-1].task
    recipe = None if dataset_meta is None else read_told(Path(dataset_meta.root))[0]
    return None if recipe is None else recipe.get("task")


def _predicts(config: HDRILConfig) -> str:
    which = "of each primitive" if config.per_primitive else "of all primitives"
    if config.coordinates == "fused":
        maps = "linear maps in the frames of all objects, fused by their precision, predict its trajectory"
        return maps if config.decoder == "linear" else f"{maps}, a graph-recurrent model {which} what they leave"
    if config.decoder == "linear":
        return "linear maps predict its trajectory"
    return f"a graph-recurrent dynamics model {which} predicts its trajectory"


def _looks(config: HDRILConfig) -> str:
    every = config.replan_every
    if config.rollout == "open_loop":
        return "goes on from its own predictions, without looking again"
    plans = {0: "when a primitive begins", 1: "at every frame"}.get(every, f"every {every} frames")
    if config.termination == "learned":
        return f"decides at every frame which one plays, and plans {plans}"
    return f"looks {plans}" if every else "looks again when the primitive is over"


def model_card(
    config: HDRILConfig,
    dataset_repo_id: str,
    license: str | None,
    tags: list[str] | None,
    training: TrainPipelineConfig | None,
    dataset_meta: LeRobotDatasetMetadata | None,
) -> ModelCard:
    """What the policy is, what it takes and gives, what it learned from, how to run it, and room for its evaluation."""
    license, repo_id = license or "apache-2.0", config.repo_id or "<user>/<policy>"
    data = ModelCardData(
        license=license, library_name="lerobot", pipeline_tag="robotics", model_name="hdril", datasets=dataset_repo_id,
        tags=sorted({*TAGS, *(tags or [])}),
    )  # fmt: skip
    task = simulated_task(config, dataset_meta)
    command = (
        f"lerobot-eval --policy.path={repo_id} --env.type=hdril --env.task={task or '<task>'} --eval.n_episodes=100"
    )
    text = f"""---
{data.to_yaml()}
---

# HDR-IL: {task or dataset_repo_id}

Hierarchical deep relational imitation learning ([Xie et al., NeurIPS 2020](https://arxiv.org/abs/2010.05134)) as a
LeRobot policy: a planner picks the next primitive, {_predicts(config)}, and the policy {_looks(config)}.

Weights are safetensors; the policy's code comes with the Python package `lerobot_policy_hdril`, and no remote code is run.

## Use

```
{command} --eval.batch_size=1 --seed=200000
hdril-eval --policy.path={repo_id} --task={task or "<task>"} --num_episodes=100
```

## Inputs and outputs

{_features(config)}

{_primitives(config)}

## Training

{_training(config, dataset_repo_id, training, dataset_meta)}

{_table(("option", "value"), [(f"`{name}`", f"`{getattr(config, name)}`") for name in _CHOICES])}

{EVALUATION}

{NOT_EVALUATED}

## Citation

```bibtex
{CITATION}
```

License: {license}
"""
    return ModelCard(text)


def _table(headers: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    return tabulate(rows, headers, tablefmt="github", disable_numparse=True)


def _features(config: HDRILConfig) -> str:
    features = {**(config.input_features or {}), **(config.output_features or {})}
    names = (config.state_names, config.environment_names, config.action_names)
    rows: list[tuple[object, ...]] = [
        (f"`{key}`", tuple(feature.shape), ", ".join(numbers))
        for (key, feature), numbers in zip(features.items(), names, strict=False)
    ]
    return _table(("feature", "shape", "numbers"), rows)


def _names(config: HDRILConfig) -> list[str]:
    """Of the forms: that of the primitive, and beside it which numbers begin in the upper half where it has several."""
    told = [config.action_names[column] for column in config.halved]
    names = config.form_names

    def beside(form: list[int]) -> str:
        upper = [name for name, high in zip(told, form[1:], strict=True) if high]
        return f" (begins with {', '.join(upper) or 'no number'} in the upper half)"

    return [
        name + (beside(form) if names.count(name) > 1 else "") for name, form in zip(names, config.forms, strict=True)
    ]


def _primitives(config: HDRILConfig) -> str:
    def length(low: int, high: int) -> str:
        return f"{low}" if low == high else f"{low} to {high}"

    lengths = [length(*run) if run[1] else "not learned" for run in config.primitive_lengths]
    return _table(("primitive", "frames"), list(zip(_names(config), lengths, strict=False)))


def _training(
    config: HDRILConfig,
    dataset_repo_id: str,
    training: TrainPipelineConfig | None,
    dataset_meta: LeRobotDatasetMetadata | None,
) -> str:
    rows: list[tuple[object, ...]] = [
        ("dataset", f"[{dataset_repo_id}](https://huggingface.co/datasets/{dataset_repo_id})")
    ]
    if config.training_data:
        rows.append(("episodes learned from", len(from_runs(config.training_data[-1].episodes))))
    if dataset_meta is not None:
        rows += [
            ("episodes", dataset_meta.total_episodes), ("frames", dataset_meta.total_frames),
            ("frames per second", dataset_meta.fps), ("robot", dataset_meta.robot_type or "not named"),
        ]  # fmt: skip
    if training is not None:
        rows += [("steps", training.steps), ("batch size", training.batch_size), ("seed", training.seed)]
    return _table(("", ""), rows)
