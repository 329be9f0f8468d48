"""The matrix: its steps, its checks, what was found in it, and the report. Nothing is trained."""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
from lerobot.configs.train import TrainPipelineConfig
from PIL import Image

from hdril.benchmark import results
from hdril.benchmark import steps as steps_module
from hdril.benchmark.calibrate import Speed
from hdril.benchmark.check import check, check_held_out
from hdril.benchmark.engine import in_order
from hdril.benchmark.figures import COLOURS, figures
from hdril.benchmark.matrix import Matrix, all_steps, drawn_data, rows, steps
from hdril.benchmark.page import read_numbers, write_numbers, write_report
from hdril.benchmark.perform import Assignment
from hdril.benchmark.report import markdown
from hdril.benchmark.results import collect
from hdril.benchmark.steps import Calibrate, Evaluate, Play, Record, Step, Train
from hdril.benchmark.store import Store
from hdril.cli.benchmark import BenchmarkConfig, benchmark_command
from hdril.demonstrations.read import read_episode
from hdril.digest import digest_json
from hdril.errors import UserError
from hdril.evaluation.results import Run, summarise
from hdril.execution import SlurmConfig
from hdril.files import exclusively
from tests.evaluation.checkpoints import save_hdril
from tests.evaluation.synthetic import outcome
from tests.fake_slurm import FakeSlurm

ROOT = Path(__file__).parents[2]
SEED, COUNT = 600_000, 8
VALUES: dict[str, Any] = {
    "name": "test",
    "data": {
        "nominal": {"task": "table_lift", "episodes": 50},
        "varied": {"task": "table_lift:level=varied", "episodes": 50},
    },
    "policies": {
        "linear": {"steps": 10, "options": ["--policy.preset=linear"]},
        "act": {"steps": 30, "options": ["--policy.type=act"]},
        "hdril": {"steps": 20},
    },
    "evaluations": {
        "nominal": {"task": "table_lift", "episodes": COUNT, "seed": SEED},
        "varied": {"task": "table_lift:level=varied", "episodes": COUNT, "seed": SEED},
    },
    "tables": [
        {
            "title": "Lift", "data": ["nominal", "varied"], "policies": ["linear", "act", "hdril"],
            "evaluations": ["nominal", "varied"], "training_seeds": [1, 2], "demonstrations": [10, 50], "against": "hdril",
            "note": "A note.",
        }
    ],
}  # fmt: skip


@pytest.fixture(autouse=True)
def in_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Config files are named from there."""
    monkeypatch.chdir(ROOT)


def changed(change: Callable[[dict[str, Any]], object] = lambda values: None) -> Matrix:
    values = copy.deepcopy(VALUES)
    change(values)
    return draccus.decode(Matrix, values)


def test_each_step_is_there_once() -> None:
    matrix = changed()
    kinds = [step.kind for step in in_order(steps(matrix))]
    assert {kind: kinds.count(kind) for kind in kinds} == {"record": 4, "train": 24, "evaluate": 48}, (
        "sets of 10 and 50"
    )
    (table,) = matrix.tables
    assert [(row.data, row.demonstrations, row.policy) for row in rows(matrix, table)][:4] == [
        ("nominal", 10, "linear"), ("nominal", 10, "act"), ("nominal", 10, "hdril"), ("nominal", 50, "linear"),
    ]  # fmt: skip
    again = changed(lambda values: values["tables"].append(values["tables"][0] | {"title": "Again"}))
    assert len(in_order(steps(again))) == len(kinds), "two tables share what is the same"


def test_commands_say_what_is_done() -> None:
    evaluate = next(step for step in steps(changed()) if step.policy.name == "linear" and step.name == "varied")
    train, out = evaluate.policy, Path("out")
    assert train.command(out, {"data": Path("set")}) == [
        "lerobot-train", "--config_path=configs/train/table_lift.yaml", "--dataset.repo_id=local/benchmark", "--dataset.root=set",
        "--output_dir=out", "--steps=10", "--save_freq=10", "--seed=1", "--policy.preset=linear",
    ]  # fmt: skip
    assert train.data.command(out, {}) == [
        "hdril-record", "--task=table_lift", "--num_episodes=10", "--seed=0", "--workers=1", "--root=out",
    ]  # fmt: skip
    assert evaluate.command(out, {"policy": Path("run")}) == [
        "hdril-eval", "--policy.path=run/checkpoints/last/pretrained_model", "--task=table_lift:level=varied",
        f"--num_episodes={COUNT}", f"--seed={SEED}", "--rerun=none", "--workers=1", "--output_dir=out",
    ]  # fmt: skip


def test_what_decides_a_result_is_in_its_settings_and_nothing_else(tmp_path: Path) -> None:
    evaluate = steps(changed())[0]
    train, record = evaluate.policy, evaluate.policy.data

    def same(step: Step, **changes: Any) -> bool:
        return digest_json(replace(step, **changes).settings()) == digest_json(step.settings())  # pyright: ignore[reportArgumentType]

    assert same(train, name="another name")
    assert same(evaluate, name="another name")
    for changes in (
        {"steps": 11}, {"seed": 3}, {"data": replace(record, episodes=11)}, {"options": ("--policy.preset=hdril",)},
    ):  # fmt: skip
        assert not same(train, **changes), changes
    for changes in (
        {"options": ("--policy.rollout=open_loop",)}, {"episodes": 9}, {"first_seed": SEED + 1}, {"task": "table_lift:push=1"},
    ):  # fmt: skip
        assert not same(evaluate, **changes), changes
    speed, play = Calibrate(train), Play(evaluate, SEED)
    for step, changes in (
        (speed, {"warm_up": 9.0}), (speed, {"measured": 9.0}), (speed, {"training": replace(train, seed=3)}),
        (play, {"seed": SEED + 1}), (play, {"evaluation": replace(evaluate, task="table_lift:push=1")}),
    ):  # fmt: skip
        assert not same(step, **changes), changes
    assert not same(record, perturb=0.001)
    assert not same(record, stray=0.001)
    assert "--stray=0.03" in Record("table_lift", 3, stray=0.03).command(tmp_path, {})
    assert not same(record, task="table_lift:push=1")
    config = tmp_path / "train.yaml"
    config.write_text(train.config.read_text())
    assert same(train, config=config), "a config file counts by its content"
    config.write_text(config.read_text().replace("batch_size: 64", "batch_size: 32"))
    assert not same(train, config=config)


def test_a_change_of_hdril_does_not_touch_what_it_does_not_make(monkeypatch: pytest.MonkeyPatch) -> None:
    """ACT is trained again for a change of LeRobot, not for one of HDR-IL."""
    by_name = {step.policy.name: step.policy for step in steps(changed())}
    before = {name: digest_json(step.settings()) for name, step in by_name.items()}
    monkeypatch.setattr("hdril.benchmark.steps.package_software", lambda package: {package: "another source"})
    after = {name: digest_json(step.settings()) for name, step in by_name.items()}
    assert {name for name in before if before[name] != after[name]} == {"linear", "hdril"}


def test_what_software_decides_is_in_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of hdril, of the policy, of the libraries and of hdril-eval itself: another version of any makes another result."""
    evaluate = next(step for step in steps(changed()) if step.policy.name == "hdril")
    record, train, play = evaluate.policy.data, evaluate.policy, Play(evaluate, SEED)

    def different(target: str, fake: Callable[..., Any]) -> set[str]:
        before = {step.kind: digest_json(step.settings()) for step in (record, train, evaluate, play)}
        with monkeypatch.context() as patch:
            patch.setattr(f"hdril.benchmark.steps.{target}", fake)
            after = {step.kind: digest_json(step.settings()) for step in (record, train, evaluate, play)}
        return {kind for kind in before if before[kind] != after[kind]}

    assert different("recording_software", lambda task: {"hdril": "another"}) == {"record"}
    assert different("evaluation_software", lambda task: {"hdril": "another"}) == {"evaluate", "play"}
    assert different("distribution_version", lambda name: "another") == {"train", "evaluate", "play"}
    assert different("package_software", lambda name: {name: "another"}) == {"train", "evaluate", "play"}
    source = steps_module.source_software
    for part, touched in (("cli/eval.py", {"evaluate", "play"}), ("benchmark/episode.py", {"play"})):

        def edited(*parts: str, part: str = part) -> dict[str, str]:
            return {"hdril": "another"} if part in parts else source(*parts)

        assert different("source_software", edited) == touched, part


def test_a_policy_on_another_device_is_another_training(tmp_path: Path) -> None:
    train = steps(changed())[0].policy
    assert train.settings()["device"] == "cpu"
    other = replace(train, options=(*train.options, "--policy.device=cuda"))
    assert other.settings()["device"] == "cuda"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v: v["tables"][0].update(policies=["gru"]), "policies has no 'gru'; choose from: linear, act, hdril"),
        (lambda v: v["tables"][0].update(beside=["speed"]), "beside has no 'speed'; choose from: position_error_cm"),
        (lambda v: v["tables"][0].update(published={"gru": "1 %"}), "published has no 'gru'; choose from: linear, act, hdril"),
        (lambda v: v["tables"][0].update(against="gru"), "against has no 'gru'; choose from: linear, act, hdril"),
        (lambda v: v["tables"][0].update(evaluations=[]), "names no evaluations; choose from: nominal, varied"),
        (lambda v: v["tables"][0].update(training_seeds=[]), "names no training_seeds"),
        (lambda v: v["tables"][0].update(phases={"all": ["grasp"]}), "phases and published_by_primitive need by_primitive"),
        (
            lambda v: v["tables"][0].update(published_by_primitive={"act": {"grasp": 1.0}}),
            "phases and published_by_primitive need by_primitive=true",
        ),
        (
            lambda v: v["tables"][0].update(by_primitive=True, published_by_primitive={"acts": {}}),
            "published_by_primitive has no 'acts'; choose from: linear",
        ),
        (
            lambda v: v["tables"][0].update(by_primitive=True, published_by_primitive={"act": {"grab": 1.0}}),
            "published_by_primitive of act has 'grab'; choose from: grasp",
        ),
        (
            lambda v: v["tables"][0].update(by_primitive=True, phases={"all": ["grab"]}),
            "all has no 'grab'; choose from: grasp, move",
        ),
        (lambda v: v["tables"][0].update(by_primitive=True, phases={"all": []}), "all names no primitive; choose from: grasp"),
        (lambda v: v["tables"][0].update(by_primitive=True, phases={"all": ["grasp", "grasp"]}), "all has 'grasp' twice"),
        (lambda v: v["tables"][0].update(demonstrations=[51]), "data nominal has 1 to 50 demonstrations, got 51"),
        (lambda v: v["tables"][0].update(episode=SEED + COUNT), "episode must be a seed of nominal, 600000 to 600007"),
        (lambda v: v["tables"][0].update(trajectories=51), "trajectories must be from 0 to 50, got 51"),
        (lambda v: v["tables"][0].update(trajectories=11, demonstrations=[10]), "trajectories must be from 0 to 10, got 11"),
        (lambda v: v["tables"][0].update(margin=5), "a margin is for evaluations that have a control, and there are"),
        (lambda v: v["tables"][0].update(margin=-5), "table 'Lift': margin must be from 0 to 100 points, got -5"),
        (lambda v: v["tables"][0].update(title="Lift [1]"), r"a title must be without brackets, got 'Lift \[1\]'"),
        (lambda v: v["tables"][0].update(title="Ü"), "a title names files: it needs 1 to 80 letters and digits, got 'Ü'"),
        (lambda v: v["tables"][0].update(training_seeds=[1, 1]), "training_seeds has 1 twice"),
        (lambda v: v["tables"][0].update(demonstrations=[50, 50]), "demonstrations has 50 twice"),
        (lambda v: v["tables"][0].update(policies=["hdril", "hdril"]), "policies has 'hdril' twice"),
        (lambda v: v["data"]["nominal"].update(perturb=-0.1), "data nominal: perturb must be from 0 to 0.03 m, got -0.1"),
        (lambda v: v["data"]["nominal"].update(stray=0.2), "data nominal: stray must be from 0 to 0.1 m, got 0.2"),
        (lambda v: v.update(name="two words"), "name must be of letters, digits, .* got 'two words'"),
        (lambda v: v["policies"]["act"].update(steps=0), "policy act: give steps, at least 1, or else minutes; got 0 steps"),
        (lambda v: v["policies"]["act"].update(steps=-1, minutes=[5]), "policy act: give steps, at least 1, or else minutes"),
        (lambda v: v["policies"]["act"].update(minutes=[5]), r"or else minutes; got 30 steps and \[5\.0\] minutes"),
        (lambda v: v["policies"]["act"].update(steps=0, minutes=[0]), "policy act: minutes must be above 0 and differ, got 0"),
        (lambda v: v["policies"]["act"].update(steps=0, minutes=[5, 5]), "act: minutes must be above 0 and differ, got 5"),
        (lambda v: v.update(tuning=True), "table 'Lift': the matrix is for tuning, and so must be nominal"),
        (lambda v: v["data"]["nominal"].update(task="juggle"), "juggle"),
        (lambda v: v["evaluations"]["nominal"].update(episodes=0), "evaluation nominal: episodes must be at least 1, got 0"),
        (lambda v: v["evaluations"]["nominal"].update(seed=2**31), "evaluation nominal: seed must be from 0 to"),
        (lambda v: v["evaluations"]["nominal"].update(task="peg_in_hole"), "evaluation nominal is not of table_lift"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(change: Callable[[dict[str, Any]], object], words: str) -> None:
    check(changed())
    with pytest.raises(ValueError, match=words) as error:
        check(changed(change))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "name", "option"),
    [
        ("policies", "act", "--steps=5"), ("policies", "act", "--dataset.root=elsewhere"), ("policies", "act", "--seed=3"),
        ("policies", "act", "--policy.path=somewhere"), ("policies", "act", "--policy={path: somewhere}"),
        ("policies", "act", "--dataset={root: elsewhere}"), ("policies", "act", "--dataset.eval_split=0.5"),
        ("policies", "act", "--dataset.episodes=[1]"), ("policies", "act", "--policy.pretrained_path=somewhere"),
        ("evaluations", "varied", "--policy={path: elsewhere}"), ("evaluations", "varied", "--training_data=elsewhere"),
        ("evaluations", "varied", "--seed=5"),
        ("evaluations", "varied", "--num-episodes=5"), ("evaluations", "varied", "--task=peg_in_hole"),
    ],
)  # fmt: skip
def test_options_do_not_undo_what_the_matrix_says(kind: str, name: str, option: str) -> None:
    wanted = option.removeprefix("--").partition("=")[0].replace("-", "_")
    with pytest.raises(ValueError, match=rf"{name}: --{wanted} cannot be among its options"):
        check(changed(lambda values: values[kind][name].setdefault("options", []).append(option)))


def test_a_policy_says_its_type_and_its_device(tmp_path: Path) -> None:
    config = tmp_path / "train.yaml"
    for text, words in (("batch_size: 8", "type"), ("policy: {type: hdril}", "device")):
        config.write_text(text)
        with pytest.raises(
            ValueError, match=rf"policy hdril: neither its options nor .*train\.yaml say --policy\.{words}"
        ):
            check(changed(lambda values: values["policies"]["hdril"].update(config=str(config))))
    config.write_text("policy: {type: hdril, device: cpu}")
    check(changed(lambda values: values["policies"]["hdril"].update(config=str(config))))


@pytest.mark.parametrize(
    ("text", "option"),
    [
        ("policy: {type: hdril, device: cpu, pretrained_path: somewhere}", "policy.pretrained_path"),
        ("policy: {path: somewhere}", "policy.path"),
        ("dataset: {episodes: [7]}\npolicy: {type: hdril, device: cpu}", "dataset.episodes"),
        ("dataset: {eval_split: 0.5}\npolicy: {type: hdril, device: cpu}", "dataset.eval_split"),
        ("resume: true\npolicy: {type: hdril, device: cpu}", "resume"),
    ],
)
def test_a_config_file_does_not_say_what_else_is_learned_from(tmp_path: Path, text: str, option: str) -> None:
    config = tmp_path / "train.yaml"
    config.write_text(text)
    with pytest.raises(ValueError, match=rf"^policy hdril: .*train\.yaml must not say {option}$"):
        check(changed(lambda values: values["policies"]["hdril"].update(config=str(config))))


def test_seeds_of_former_choices_are_not_reported(tmp_path: Path) -> None:
    used = tmp_path / "used.yaml"

    def name(values: dict[str, Any]) -> None:
        values["used_seeds"] = str(used)

    with pytest.raises(FileNotFoundError):
        check(changed(name))
    used.write_text("- {task: peg_in_hole, first: 0, last: 2000000, why: another task}")
    check(changed(name))
    for task in ("table_lift", "all"):
        used.write_text(f"- {{task: {task}, first: {SEED + COUNT - 1}, last: {SEED + 99}, why: a choice}}")
        last = SEED + COUNT - 1
        with pytest.raises(
            ValueError, match=rf"nominal is not held out: .*\(a choice\) has its seeds {last} to {last} of"
        ):
            check(changed(name))
        used.write_text(f"- {{task: {task}, first: {SEED + COUNT}, last: {SEED + 99}, why: a choice}}")
        check(changed(name))
    used.write_text(f"- {{task: all, first: {SEED}, last: {SEED}, why: a choice}}")

    def tune(values: dict[str, Any]) -> None:
        name(values)
        values["tuning"] = True
        for evaluation in values["evaluations"].values():
            evaluation["tuning"] = True

    check(changed(tune))  # what is for tuning may have them
    used.write_text(f"- {{task: 'table_lift:level=varied', first: {SEED}, last: {SEED}, why: a choice}}")
    with pytest.raises(ValueError, match=rf"nominal is not held out: .*\(a choice\) has its seeds {SEED} to {SEED} of"):
        check(changed(name))
    whole = "must be a list of entries with task, first, last and why"
    for text, words in (
        ("seeds: 5", whole),
        ("- {task: all}", whole),
        ("- 5", whole),
        ("- {task: [", whole),
        ("[]", "must name at least one seed"),
        ("- {task: all, first: 5, last: 4, why: a choice}", "first and last must be seeds in this order, got 5 and 4"),
        ("- {task: all, first: a, last: 4, why: a choice}", "first and last must be seeds in this order, got a and 4"),
        ("- {task: tabel_lift, first: 3, last: 4, why: a choice}", "tabel_lift"),
    ):
        used.write_text(text)
        with pytest.raises(ValueError, match=words):
            check(changed(name))


def test_seeds_of_dropped_demonstrations_are_guarded() -> None:
    """Half of the seeds may fail, and others take their place: 50 demonstrations take 120 seeds at most."""
    with pytest.raises(ValueError, match=r"evaluation varied is not held out: data nominal has its seeds 119 to 119"):
        check(changed(lambda values: values["evaluations"]["varied"].update(seed=119)))
    check(changed(lambda values: values["evaluations"]["varied"].update(seed=120)))


def test_seeds_that_were_trained_or_tuned_on_are_refused() -> None:
    """The scenes of a seed are alike at every level, so that other parameters of the task do not make it another seed."""
    with pytest.raises(ValueError, match=r"evaluation varied is not held out: data nominal has its seeds 60 to 67"):
        check(changed(lambda values: values["evaluations"]["varied"].update(seed=60)))
    tuning = {"task": "table_lift", "episodes": 10, "seed": SEED + 7, "tuning": True}
    with pytest.raises(
        ValueError, match=rf"evaluation nominal is not held out: tuning on choice has its seeds {SEED + 7} to"
    ):
        check(changed(lambda values: values["evaluations"].update(choice=tuning)))

    with pytest.raises(ValueError, match=r"evaluation choice is not held out: data nominal has its seeds 0 to 9"):
        check(changed(lambda values: values["evaluations"].update(choice=tuning | {"seed": 0})))

    def report(values: dict[str, Any]) -> None:
        values["evaluations"]["choice"] = tuning | {"seed": SEED + 100}
        values["tables"][0]["evaluations"] = ["choice"]

    with pytest.raises(ValueError, match="choice is for tuning, and so must be the matrix"):
        check(changed(report))
    check(changed(lambda values: (report(values), values.update(tuning=True))))
    peg = {"task": "peg_in_hole", "episodes": 50, "seed": SEED}
    check(changed(lambda values: values["data"].update(peg=peg)))  # seeds of another task


def test_there_must_be_a_config_file() -> None:
    with pytest.raises(FileNotFoundError, match=r"policy act: there is no config file nowhere\.yaml"):
        check(changed(lambda values: values["policies"]["act"].update(config="nowhere.yaml")))


FILES = sorted((ROOT / "configs/benchmark").glob("*.yaml"))


def read(file: Path) -> BenchmarkConfig:
    return draccus.parse(BenchmarkConfig, args=[f"--config_path={file}"])


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_benchmarks_of_this_repository_can_be(file: Path) -> None:
    config = read(file)
    check(config)
    assert config.name == file.stem
    assert steps(config)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_policies_of_a_file_are_trained_in_ways_that_lerobot_knows_and_that_differ(file: Path) -> None:
    """A config file may decide what an option seems to: a rung of a ladder must not be another one under a new name."""
    found: dict[str, str] = {}
    for name, policy in read(file).policies.items():
        known = draccus.parse(TrainPipelineConfig, policy.config, args=policy.options)
        assert known.policy is not None, name
        assert known.policy.device == "cpu", name
        ways = [
            decided(known.policy),
            known.batch_size,
            known.num_workers,
            policy.steps,
            policy.minutes,
            policy.in_memory,
        ]
        assert found.setdefault(repr(ways), name) == name


def decided(policy: Any) -> dict[str, Any]:
    """The options of a policy, however they were given."""
    return {field.name: getattr(policy, field.name) for field in fields(policy) if field.name != "preset"}


def test_a_policy_with_one_part_less_differs_in_that_alone() -> None:
    policies = read(ROOT / "configs/benchmark/suite.yaml").policies

    def options(name: str) -> dict[str, Any]:
        known = draccus.parse(TrainPipelineConfig, policies[name].config, args=policies[name].options).policy
        return decided(known)

    whole = options("hdril_reactive")
    less = [name for name in policies if name.startswith("no_")]
    assert len(less) == 8
    for name in less:
        named = {option.split("=")[0].removeprefix("--policy.") for option in policies[name].options} - {
            "preset",
            "--batch_size",
        }
        assert {key for key, value in options(name).items() if value != whole[key]} == named


def test_no_benchmark_reports_seeds_that_another_one_tunes_on() -> None:
    matrices = [read(file) for file in FILES]
    assert {matrix.used_seeds for matrix in matrices} == {Path("configs/used_seeds.yaml")}
    tuned = {
        name: entry
        for matrix in matrices
        for name, entry in matrix.evaluations.items()
        if matrix.tuning and entry.tuning
    }
    assert tuned
    for matrix in matrices:
        if not matrix.tuning:
            theirs = {f"{name}, tuned": entry for name, entry in tuned.items()}
            check_held_out(replace(matrix, evaluations=matrix.evaluations | theirs))


# ---------------------------------------------------------------- what was found


def pretend(store: Store, matrix: Matrix, failed: Callable[[Evaluate], set[int]]) -> None:
    """Fill a store as if all had been done: ``failed`` seeds by evaluation."""
    for step in in_order(all_steps(matrix)):
        place = store.place(step)
        assert place is not None
        pretend_step(step, place, step.command(place / "result", store.input_folders(step)), failed)


def pretend_step(
    step: Step, place: Path, command: list[str], failed: Callable[[Evaluate], set[int]], machine: str = ""
) -> None:
    """Fill a place as if its step had been done. A machine decides digests of results."""
    (place / "result").mkdir(parents=True)
    done = {
        "digest": digest_json([step.title, machine]),
        "seconds": 90.0,
        "command": " ".join(command),
        "machine": "a machine",
    }
    (place / "step.json").write_text(json.dumps(done))
    if isinstance(step, Evaluate):
        seeds = range(step.first_seed, step.first_seed + step.episodes)
        moved = {"motion": {"jerk_m_s3": 2.5}, "expert_jerk_m_s3": 2.0}
        outcomes = [outcome(seed, success=seed not in failed(step), **moved) for seed in seeds]
        run = Run(step.task, "policy", (), step.first_seed, step.episodes, True, "compared")
        results = summarise(run, outcomes) | {"identity": {"policy": {"weights": digest_json(step.policy.title)}}}
        (place / "result/results.json").write_text(json.dumps(results))
    if isinstance(step, Play):
        (place / "result/episode.json").write_text(json.dumps(EPISODE))
    if isinstance(step, Calibrate):
        (place / "result/speed.json").write_text(json.dumps(vars(SPEEDS[step.training.name])))


EPISODE = {
    "seed": SEED,
    "success": False,
    "predicted": {"left": [[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]], "right": [[0.1, -0.2, 0.3], [0.2, -0.2, 0.3]]},
    "true": {"left": [[0.1, 0.2, 0.4]], "right": [[0.1, -0.2, 0.5]]},
    "attention": {
        "nodes": ["left", "right"],
        "primitive": "grasp",
        "of": "planner",
        "weights": [[0.25, 0.75], [1.0, 0.0]],
    },
}


SPEEDS = {"act": Speed(100, 60.0, 0.25), "hdril": Speed(200, 50.0, 0.5)}
"""ACT is ready in 35 s and does 4 steps a second, HDR-IL 2."""


def fails(step: Evaluate) -> set[int]:
    """The linear maps fail on all seeds of one training and on two of the other, ACT on one, HDR-IL on none."""
    if step.policy.name == "linear":
        return set(range(SEED, SEED + (COUNT if step.policy.seed == 1 else 2)))
    return {SEED} if step.policy.name == "act" else set()


def test_seeds_that_were_not_asked_for_are_no_result(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    path = store.get(steps(matrix)[0]).output / "results.json"
    path.write_text(path.read_text().replace(f'"seed": {SEED},', '"seed": 5,'))
    with pytest.raises(ValueError, match="holds other seeds than linear on 50"):
        collect(matrix, store)


@pytest.mark.parametrize("told", [None, False])
def test_seeds_that_nobody_checked_are_no_result(tmp_path: Path, told: bool | None) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    path = store.get(steps(matrix)[0]).output / "results.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"held_out": told, "held_out_basis": "no data set"}))
    with pytest.raises(ValueError, match="is no evaluation on held-out seeds: no data set"):
        collect(matrix, store)


def test_intervals_are_of_counts_and_not_of_what_a_file_says(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    for step in steps(matrix):
        path = store.get(step).output / "results.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"pc_success_ci95": [1.0, 2.0]}))
    (table,) = collect(matrix, store)["tables"]
    low, high = table["rows"][0]["cells"]["varied"][1]["pc_success_ci95"]  # 6 of 8
    assert (low, high) == pytest.approx((40.93, 92.85), abs=0.01)


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    path = store.get(steps(matrix)[0].policy.data).output.parent / "step.json"
    path.write_text("")
    with pytest.raises(ValueError, match=r"step\.json is not valid JSON"):
        Store(store.folder).find(steps(matrix)[0])


def test_trainings_that_differ_in_opposite_directions_show_no_difference(tmp_path: Path) -> None:
    """Each pair of trainings is significant; the methods are not told apart."""

    def opposite(step: Evaluate) -> set[int]:
        loser = "linear" if step.policy.seed < 3 else "hdril"
        return set(range(SEED, SEED + 20)) if step.policy.name == loser else set()

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        values["evaluations"]["varied"]["episodes"] = 40
        values["tables"][0]["training_seeds"] = [1, 2, 3, 4]

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, opposite)
    (table,) = collect(matrix, store)["tables"]
    linear = next(test for test in table["tests"] if test["policy"] == "linear")
    assert max(linear["p_values_holm"]) < 0.001
    assert linear["pc_differences"] == [-50.0, -50.0, 50.0, 50.0]
    assert not linear["differs"]
    line = next(line for line in markdown(collect(matrix, store)).splitlines() if "+0.0 (" in line and "linear" in line)
    assert [cell.strip() for cell in line.strip("|").split("|")][-2:] == [
        "< 0.001, < 0.001, < 0.001, < 0.001",
        "not shown",
    ]


@pytest.mark.parametrize("seeds", [[1], [1, 2], [1, 2, 3]])
def test_a_difference_that_is_shown_is_told_so(tmp_path: Path, seeds: list[int]) -> None:
    def more(values: dict[str, Any]) -> None:
        one_row(values)
        values["evaluations"]["varied"]["episodes"] = 40
        values["tables"][0]["training_seeds"] = seeds

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, lambda step: set(range(SEED, SEED + 20)) if step.policy.name == "linear" else set())
    results = collect(matrix, store)
    (table,) = results["tables"]
    assert {test["policy"]: test["differs"] for test in table["tests"]} == {"linear": True, "act": False}
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown(results).splitlines()]
    told = {row[0]: row[-1] for row in cells if row[-1] in ("yes", "not shown")}
    assert told == {"`linear`": "yes", "`act`": "not shown"}


def test_policies_are_compared_on_the_same_demonstrations(tmp_path: Path) -> None:
    """The one that the others are compared with is another policy for each data and each number of demonstrations."""

    def by_demonstrations(step: Evaluate) -> set[int]:
        if step.policy.name != "hdril":
            return set()
        many = {10: 6, 50: 4}[step.policy.data.episodes] - (1 if "varied" in step.policy.data.task else 0)
        return set(range(SEED, SEED + many))

    matrix, store = changed(), Store(tmp_path / "store")
    pretend(store, matrix, by_demonstrations)
    (table,) = collect(matrix, store)["tables"]
    found = {
        (test["data"], test["demonstrations"], test["pc_difference"])
        for test in table["tests"]
        if test["policy"] == "act"
    }
    assert found == {("nominal", 10, 75.0), ("nominal", 50, 50.0), ("varied", 10, 62.5), ("varied", 50, 37.5)}


def test_what_loses_comes_first(tmp_path: Path) -> None:
    """Before all tables, the worst first: a policy that is better, an event that costs more than it may, what may be chance."""
    failing = {"hdril": 30, "linear": 0, "act": 29}

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        with_a_control(values)
        for name in ("varied", "calm", "push"):
            values["evaluations"][name]["episodes"] = 400 if name != "varied" else 40
        first = values["tables"][0] | {"training_seeds": [1]}
        lift = first | {"evaluations": ["varied"], "against": "hdril"}
        values["tables"] = [first | {"title": "Events", "margin": 5}, lift]

    def lost(step: Evaluate) -> set[int]:
        if step.name == "varied":
            return set(range(SEED, SEED + failing[step.policy.name]))
        fallen = {"act": 200, "hdril": 0, "linear": 20}[step.policy.name] if step.name == "push" else 0
        return set(range(SEED, SEED + fallen))

    matrix, store = changed(more), Store(tmp_path / "store")
    check(matrix)
    pretend(store, matrix, lost)
    told = losses(collect(matrix, store))
    assert [line.split(" (")[0] for line in told] == [
        "- Lift: `linear` is better than `hdril` on varied",
        "- Events: `act` on push",
        "- Lift: `act` is ahead of `hdril` on varied",
        "- Events: `linear` on push",
    ]
    assert told[1].endswith("(trained on 50 of varied): success falls by more than 5 points: -50.0 (-54.9 to -45.0).")
    assert "(trained on 50 of varied): +75.0 (" in told[0]
    assert told[2].endswith("points; this may be chance.")
    assert "it is not shown that success falls by at most 5 points: -5.0 (" in told[3]

    def without_margin(values: dict[str, Any]) -> None:
        more(values)
        values["tables"][0]["margin"] = 0
        values["tables"].pop()

    told = losses(collect(changed(without_margin), store))
    assert [line.split(" (")[0] for line in told] == ["- Events: `linear` on push", "- Events: `act` on push"]
    assert "): success falls: -50.0 (" in told[1]


def test_where_nothing_loses_the_report_says_so(tmp_path: Path) -> None:
    def plain(values: dict[str, Any]) -> None:
        one_row(values)
        values["tables"][0]["against"] = ""

    def event(values: dict[str, Any]) -> None:
        with_a_control(values)
        values["tables"][0]["margin"] = 5
        for name in ("calm", "push"):
            values["evaluations"][name]["episodes"] = 400

    for number, (change, told) in enumerate(
        (
            (one_row, ["- No policy is ahead of the one that it is compared with."]),
            (event, ["- No event costs more than it may."]),
            (plain, []),
        )
    ):
        matrix, store = changed(change), Store(tmp_path / str(number))
        pretend(store, matrix, lambda step: set())
        assert losses(collect(matrix, store)) == told


def test_who_is_ahead_after_other_minutes_is_told_with_them(tmp_path: Path) -> None:
    def more(values: dict[str, Any]) -> None:
        by_minutes(values)
        values["policies"]["hdril"]["minutes"] = [10]
        values["tables"][0]["training_seeds"] = [1]

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, lambda step: {SEED} if step.policy.name == "hdril" else set())
    told = losses(collect(matrix, store))
    assert any("`act`" in line and "(trained for 10 minutes on 50 of varied)" in line for line in told)
    assert any("(trained for 60 minutes on 50 of varied, the other for 10 minutes)" in line for line in told)


def losses(results: dict[str, Any]) -> list[str]:
    """The lines before the tables."""
    before = markdown(results).split("## ")[1:2]
    return [
        line for part in before if part.startswith("Who is ahead") for line in part.splitlines() if line[:2] == "- "
    ]


def test_what_was_noticed_stands_beside_success(tmp_path: Path) -> None:
    """Two of eight episodes, one of which succeeds; none in another policy, and one that has no primitives says nothing."""

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        values["tables"][0].update(beside=["pc_noticed", "pc_success_noticed"], training_seeds=[1])

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, lambda step: {SEED})
    (step,) = (step for step in steps(matrix) if step.policy.name == "hdril")
    path = store.get(step).output / "results.json"
    told = json.loads(path.read_text())
    for episode in told["per_episode"][:2]:
        episode["noticed"] = [[14, "grasp tried again"]]
    path.write_text(json.dumps(told))
    (step,) = (step for step in steps(matrix) if step.policy.name == "act")
    path = store.get(step).output / "results.json"
    told = json.loads(path.read_text())
    for episode in told["per_episode"]:
        episode["primitives"] = []
    path.write_text(json.dumps(told))
    cells = cells_of(markdown(collect(matrix, store)), "varied: success where it did, %")
    assert [(row[0], *row[-2:]) for row in cells[1:]] == [
        ("`linear`", "0", ""),
        ("`act`", "", ""),
        ("`hdril`", "25", "50"),
    ]


def test_failed_seeds_are_listed_with_a_way_to_see_them(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    text = markdown(results)
    folded = text[text.index("<details><summary>Failed seeds") :].split("</details>")[0].splitlines()
    listed = [line for line in folded if line.startswith("- ")]
    assert len(listed) == sum(
        bool(run["failed_seeds"]) for row in results["tables"][0]["rows"] for run in row["cells"]["varied"]
    )
    first = ", ".join(str(SEED + number) for number in range(5))
    folder = store.relative(str(store.get(steps(matrix)[0]).output.parent))
    assert listed[0] == (
        f"- `linear` (trained on 50 of varied, training seed 1) on varied, `{folder}`: {first} and {COUNT - 5} more"
    )
    assert "`--seed=SEED --num_episodes=1 --rerun=failures --output_dir=FOLDER`" in text
    store = Store(tmp_path / "five")
    matrix = changed(by_minutes)
    pretend(store, matrix, lambda step: set(range(SEED, SEED + 5)) if step.policy.name == "act" else set())
    text = markdown(collect(matrix, store))
    assert "- `act` (trained for 60 minutes on 50 of varied, training seed 2) on varied, `STORE/" in text
    assert f", {SEED + 4}\n" in text
    assert "more\n" not in text
    store, matrix = Store(tmp_path / "another"), changed(one_row)
    pretend(store, matrix, lambda step: set())
    assert "Failed seeds" not in markdown(collect(matrix, store))


def test_all_commands_stand_below_their_table(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    text = markdown(collect(matrix, store))
    folded = text[text.index("<details>") : text.index("</details>")].splitlines()
    commands = [line for line in folded if line.startswith(("hdril-", "lerobot-"))]
    record = store.relative(store.get(steps(matrix)[0].policy.data).command)
    assert commands[0] == record
    assert record.startswith(
        "hdril-record --task=table_lift:level=varied --num_episodes=50 --seed=0 --workers=1 --root=STORE/"
    )
    programs = [command.split()[0] for command in commands]
    assert {name: programs.count(name) for name in programs} == {"hdril-record": 1, "lerobot-train": 6, "hdril-eval": 6}


def test_the_commits_that_made_a_table_are_told(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    for step, commit in zip(steps(matrix), ("abc1234", "abc1234+"), strict=False):
        path = store.get(step).output.parent / "step.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"commit": commit}))
    assert "on a machine, commit abc1234 and abc1234+. A step" in markdown(collect(matrix, Store(store.folder)))


def test_one_training_has_the_interval_of_one_training(tmp_path: Path) -> None:
    """100 of 100 against 100 of 100 is not a difference of exactly 0: the bootstrap would say so."""
    matrix = changed(lambda values: (one_row(values), values["tables"][0].update(training_seeds=[2])))
    store = Store(tmp_path / "store")
    pretend(store, matrix, lambda step: set())
    results = collect(matrix, store)
    low, high = results["tables"][0]["tests"][0]["pc_difference_ci95"]
    assert low < -10.0 < 10.0 < high
    text = markdown(results)
    assert "(Newcombe, over seeds)" in text
    assert "One training tells about a trained policy, not about a method." in text


def test_several_trainings_that_never_fail_leave_a_difference_open(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, lambda step: set())
    results = collect(matrix, store)
    low, high = results["tables"][0]["tests"][0]["pc_difference_ci95"]
    assert low < -10.0 < 10.0 < high
    text = markdown(results)
    assert "the two-level bootstrap's over trainings and seeds, Student's over trainings, and Newcombe's" in text
    assert "Few trainings show little" in text


def test_pairs_of_trainings_that_all_show_it_are_not_enough_without_the_interval(tmp_path: Path) -> None:
    """Three trainings lose 15, 15 and 90 points: each loss is beyond chance, and yet where the mean is, is open."""
    lost = {1: 40, 2: 40, 3: 180}

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        values["evaluations"]["varied"]["episodes"] = 200
        values["tables"][0]["training_seeds"] = [1, 2, 3]

    def differ(step: Evaluate) -> set[int]:
        if step.policy.name == "linear":
            return set(range(SEED, SEED + lost[step.policy.seed]))
        return set(range(SEED, SEED + (160 if step.policy.seed == 3 else 20)))

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, differ)
    linear = next(test for test in collect(matrix, store)["tables"][0]["tests"] if test["policy"] == "linear")
    assert max(linear["p_values_holm"]) < 0.001
    assert max(linear["pc_differences"]) < 0.0
    low, high = linear["pc_difference_ci95"]
    assert low < 0.0 < high
    assert not linear["differs"]


# ---------------------------------------------------------------- digests of results


def test_what_a_training_made_is_weights_processors_and_config(dataset: Path, tmp_path: Path) -> None:
    """Two policies of the same weights may act otherwise; where one goes on the Hub does not matter."""
    train = steps(changed())[0].policy
    save_hdril(train.checkpoint(tmp_path), dataset)
    first = train.digest(tmp_path)

    def edit(**values: Any) -> str:
        path = train.checkpoint(tmp_path) / "config.json"
        before = path.read_text()
        path.write_text(json.dumps(json.loads(before) | values))
        digest = train.digest(tmp_path)
        path.write_text(before)
        return digest

    assert edit() == first
    assert edit(repo_id="user/name") == first
    assert edit(rollout="open_loop") != first
    weights = train.checkpoint(tmp_path) / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    second = train.digest(tmp_path)
    assert second != first
    processor = train.checkpoint(tmp_path) / "policy_preprocessor.json"
    processor.write_text(processor.read_text() + "\n")
    assert train.digest(tmp_path) not in (first, second)
    processor.unlink()
    with pytest.raises(FileNotFoundError):
        train.digest(tmp_path)


def test_what_a_recording_made_is_episodes_and_statistics(dataset: Path, tmp_path: Path) -> None:
    record = steps(changed())[0].policy.data
    copied = Path(shutil.copytree(dataset, tmp_path / "set"))
    first = record.digest(copied)
    assert first == record.digest(dataset)
    statistics = copied / "meta/stats.json"
    values = json.loads(statistics.read_text())
    statistics.write_text(json.dumps(dict(reversed(values.items()))))
    assert record.digest(copied) == first, "the order of columns means nothing"
    values["action"]["mean"][0] += 1.0
    statistics.write_text(json.dumps(values))
    assert record.digest(copied) != first
    (copied / "meta/hdril.json").unlink()
    with pytest.raises(ValueError, match="is no dataset of hdril with a digest"):
        record.digest(copied)


def one_row(values: dict[str, Any]) -> None:
    values["tables"][0].update(data=["varied"], demonstrations=[], evaluations=["varied"])


def test_numbers_and_tests_of_a_table(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    with pytest.raises(KeyError):
        collect(matrix, store)
    pretend(store, matrix, fails)
    (table,) = collect(matrix, store)["tables"]
    by_name = {row["policy"]: row for row in table["rows"]}
    assert [run["n_success"] for run in by_name["linear"]["cells"]["varied"]] == [0, 6]
    assert [run["training_seed"] for run in by_name["linear"]["cells"]["varied"]] == [1, 2]
    assert by_name["act"]["training_minutes"] == [1.5, 1.5]
    linear, act = table["tests"]
    assert (linear["policy"], linear["evaluation"], act["policy"]) == ("linear", "varied", "act")
    assert linear["pc_difference"] == pytest.approx(-62.5)
    assert linear["p_values"] == pytest.approx([2 * 0.5**8, 0.5])
    assert act["p_values"] == [1.0, 1.0]
    assert linear["p_values_holm"] == pytest.approx([4 * 2 * 0.5**8, 1.0])
    low, high = linear["pc_difference_ci95"]
    # Student's of two trainings that differ by 37.5 points, with two degrees of freedom, is nearly as wide as can be.
    assert (low, high) == pytest.approx((-100.0, -62.5 + 161.3), abs=0.1)
    assert str(tmp_path) not in json.dumps(table), "no path of this machine"


def with_a_control(values: dict[str, Any]) -> None:
    one_row(values)
    frames = "--max_frames=210"
    values["evaluations"] |= {
        "calm": {"task": "table_lift:detailed=1", "episodes": COUNT, "seed": SEED, "options": [frames]},
        "push": {"task": "table_lift:push=1", "episodes": COUNT, "seed": SEED, "control": "calm"},
    }
    values["tables"][0].update(evaluations=["calm", "push"], against="")


def test_what_an_event_does_is_told_against_its_control(tmp_path: Path) -> None:
    matrix, store = changed(with_a_control), Store(tmp_path / "store")
    check(matrix)
    pretend(store, matrix, lambda step: fails(step) if step.name == "push" else {SEED})
    results = collect(matrix, store)
    falls = {fall["policy"]: fall for fall in results["tables"][0]["falls"]}
    assert {(fall["evaluation"], fall["control"]) for fall in falls.values()} == {("push", "calm")}
    assert falls["linear"]["pc_difference"] == pytest.approx(-50.0)
    assert falls["linear"]["p_values"] == pytest.approx([2 * 0.5**7, 1.0])
    assert falls["act"]["p_values_holm"] == [1.0, 1.0]
    assert falls["hdril"]["pc_difference"] == pytest.approx(12.5)
    text = markdown(results)
    assert "same, bit for bit, until then. The columns tell the difference in points" in text
    assert "adjusted by Holm's method for these 6 tests" in text
    (line,) = (line for line in text.splitlines() if line.startswith("| `linear`") and " calm " in line)
    assert [cell.strip() for cell in line.strip("|").split("|")][3:6] == ["push", "calm", "-50.0 (-100.0 to +100.0)"]


def test_a_fall_is_held_against_its_margin(tmp_path: Path) -> None:
    """200 seeds: a fall of 1 point is within 5, one of 4 may be, one of 20 is not."""
    lost = {"linear": 40, "act": 8, "hdril": 2}

    def more(values: dict[str, Any]) -> None:
        with_a_control(values)
        for name in ("calm", "push"):
            values["evaluations"][name]["episodes"] = 200
        values["tables"][0].update(margin=5, training_seeds=[1])

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(
        store, matrix, lambda step: set(range(SEED, SEED + lost[step.policy.name])) if step.name == "push" else set()
    )
    results = collect(matrix, store)
    falls = {fall["policy"]: fall["within"] for fall in results["tables"][0]["falls"]}
    assert falls == {"linear": "no", "act": "not shown", "hdril": "yes"}
    text = markdown(results)
    assert re.search(r"\| falls by at most 5 points +\|", text)
    assert (
        "Falls by at most 5 points: yes, the whole interval is at or above -5; no, the whole interval is below" in text
    )
    adjusted = [fall["p_values_holm"][0] / fall["p_values"][0] for fall in results["tables"][0]["falls"][:2]]
    assert adjusted == pytest.approx([3.0, 2.0]), "Holm over the three"


def test_what_a_training_does_in_both_arms_is_no_fall(tmp_path: Path) -> None:
    """Trainings that differ by 75 points lose one seed of forty each: training luck is in both arms and cancels."""
    failing = {1: 0, 2: 30}

    def more(values: dict[str, Any]) -> None:
        with_a_control(values)
        for name in ("calm", "push"):
            values["evaluations"][name]["episodes"] = 40

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(
        store,
        matrix,
        lambda step: set(range(SEED, SEED + failing[step.policy.seed] + (1 if step.name == "push" else 0))),
    )
    (table,) = collect(matrix, store)["tables"]
    for fall in table["falls"]:
        assert fall["pc_difference"] == pytest.approx(-2.5)
        low, high = fall["pc_difference_ci95"]
        assert -20.0 < low < -2.5 < high < 20.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda e: e["push"].update(control="quiet"),
            "^evaluation push: control has no 'quiet'; choose from: nominal, ",
        ),
        (lambda e: e["calm"].update(seed=SEED + 1), "^evaluation push: its control calm is not of the same scenes$"),
        (
            lambda e: e["push"].update(task="table_lift:push=1,yaw=5"),
            "^evaluation push: its control calm is not of the same",
        ),
        (
            lambda e: e["push"].update(task="table_lift:detailed=1"),
            "^evaluation push: something must happen in it, and nothing",
        ),
        (
            lambda e: e["calm"].update(task="table_lift:push=0.5"),
            "^evaluation push: something must happen in it, and nothing",
        ),
        (
            lambda e: e["calm"].update(options=[]),
            "^evaluation push is cut after 210 frames, its control calm after 70: give",
        ),
        (
            lambda e: e["calm"].update(options=["--max_frames=many"]),
            "^evaluation calm: max_frames must be a whole number of frames, got 'many'$",
        ),
        (
            lambda e: e["calm"].update(options=["--max_frames=9"]),
            "^evaluation calm: max_frames must be at least 70, .*; got 9",
        ),
        (
            lambda e: e["push"].update(options=["--policy.samples=2"]),
            "^evaluation push: its control calm has other options$",
        ),
        (
            lambda e: e["calm"].update(task="table_lift"),
            "^evaluation push: its control calm observes other numbers: set detailed=1 in it$",
        ),
        (
            lambda e: e["calm"].update(options=["--max-frames=210", "--mishap=hands_stay"]),
            "^evaluation push: something must happen in it, and nothing",
        ),
        (
            lambda e: e["push"].update(task="table_lift:detailed=1", options=["--mishap=earthquake"]),
            "^evaluation push: mishap must be hands_stay, fingers_open, hands_high, got 'earthquake'$",
        ),
        (
            lambda e: (
                e["push"].update(task="table_lift:detailed=1", options=["--mishap=hands_stay"]),
                e["calm"].update(options=[]),
            ),
            "^evaluation push is cut after 210 frames, its control calm after 70: give",
        ),
    ],
)
def test_a_control_is_of_the_same_scenes_and_as_long(change: Callable[[dict[str, Any]], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check(changed(lambda values: (with_a_control(values), change(values["evaluations"]))))


def test_a_mishap_has_a_control_as_an_event_has() -> None:
    def spoil(values: dict[str, Any]) -> None:
        with_a_control(values)
        values["evaluations"]["push"].update(task="table_lift:detailed=1", options=["--mishap=hands_stay"])

    check(changed(spoil))


def test_a_table_with_an_event_has_its_control() -> None:
    with pytest.raises(ValueError, match=r"^table 'Lift': push needs its control calm among the evaluations$"):
        check(changed(lambda values: (with_a_control(values), values["tables"][0].update(evaluations=["push"]))))


def test_the_report_says_what_was_found(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    text = markdown(collect(matrix, store))
    assert "## Lift\n\nA note." in text
    assert (
        "| `linear` | varied       | 50               | 10      | 1.5 to 1.5            | 2 × 8: 37.5 % (0.0 to 75.0, SD 53.0)"
        in text
    )
    assert (
        "`varied`: `table_lift:level=varied`, 8 seeds from 600000 on (the expert succeeds on 8). Training seeds: 1, 2."
        in text
    )
    assert "adjusted by Holm's method for these 4 tests" in text
    assert "not shown" in text
    assert "published" not in text
    assert "hdril-eval --policy.path=STORE/train/" in text
    single = changed(lambda values: (one_row(values), values["tables"][0].update(training_seeds=[2], against="")))
    text = markdown(collect(single, store))
    assert "| 6 of 8: 75.0 (40.9 to 92.9) " in text
    assert "Against" not in text


def test_other_numbers_stand_beside_success(tmp_path: Path) -> None:
    """Means over episodes and plain numbers. One training of the linear maps never succeeds: its jerk is not compared."""

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        beside = ["position_error_cm", "pc_expert_choice", "jerk_to_expert"]
        values["tables"][0].update(beside=beside, published={"linear": "13 %"}, published_by="paper")

    matrix, store = changed(more), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    text = markdown(collect(matrix, store))
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:4]]
    heads = ["position, cm", "first primitive the expert's, %", "jerk, times the expert's"]
    assert cells[0][-5:] == ["varied", *(f"varied: {head}" for head in heads), "paper"]
    assert [row[-4:] for row in cells[1:]] == [
        ["0.2 (0.2 to 0.2)", "100 (100 to 100)", "1.25", "13 %"],
        ["0.2 (0.2 to 0.2)", "100 (100 to 100)", "1.25 (1.25 to 1.25)", ""],
        ["0.2 (0.2 to 0.2)", "100 (100 to 100)", "1.25 (1.25 to 1.25)", ""],
    ]


def cells_of(text: str, head: str) -> list[list[str]]:
    """The rows of the one table that has ``head`` among its headings, without the line below them."""
    (told,) = (
        part
        for part in text.split("\n\n")
        if part.startswith("| ") and head in re.split(r" *\| *", part.splitlines()[0])
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in told.splitlines()]
    return [rows[0], *rows[2:]]


def reached(**errors: float) -> dict[str, dict[str, float]]:
    return {name: {"mean": error, "std": 0.1} for name, error in errors.items()}


def test_errors_by_primitive_have_a_table_of_their_own(tmp_path: Path) -> None:
    """In the task's order, whatever the first training reached; what a training never reached does not count, and is told."""

    def more(values: dict[str, Any]) -> None:
        one_row(values)
        published = {"linear": {"grasp": 7.0, "extend": 14.2}}
        values["tables"][0].update(
            by_primitive=True, published_by_primitive=published, evaluations=["varied", "nominal"]
        )

    matrix, store = changed(more), Store(tmp_path / "store")
    check(matrix)
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    runs = results["tables"][0]["rows"][0]["cells"]["varied"]
    runs[0]["position_error_cm_by_primitive"] = reached(grasp=0.5, lift=2.0)
    runs[1]["position_error_cm_by_primitive"] = reached(grasp=1.5, move=0.3)
    text = markdown(results)
    assert "Several trainings: their mean and, in brackets, range.\n" in text
    cells = cells_of(text, "grasp")
    assert cells[0] == [
        "policy", "trained on", "demonstrations", "evaluation", "grasp", "move", "lift", "extend", "place", "retract",
    ]  # fmt: skip
    one = "1 of 2 trainings"
    assert cells[1] == [
        "`linear`", "varied", "50", "varied", "1 (0.5 to 1.5)", f"0.3, {one}", f"2, {one}", "", "", "",
    ]  # fmt: skip
    assert [row[0::3] for row in cells[2:4]] == [
        ["`linear`", "nominal", "0.2 (0.2 to 0.2)", "0.2 (0.2 to 0.2)"],
        ["`act`", "varied", "0.2 (0.2 to 0.2)", "0.2 (0.2 to 0.2)"],
    ]
    assert cells[-1] == ["`linear`", "", "", "published", "7", "", "", "14.2", "", ""]
    assert "by the expert's primitive" not in markdown(collect(changed(one_row), store)), "none unless asked for"


def test_primitives_of_a_phase_are_told_together(tmp_path: Path) -> None:
    def more(values: dict[str, Any]) -> None:
        one_row(values)
        by_minutes(values)
        phases = {"first": ["grasp", "move"], "second": ["retract"]}
        values["tables"][0].update(
            by_primitive=True, phases=phases, published_by_primitive={"act": {"second": 1.5}}, training_seeds=[1]
        )

    matrix, store = changed(more), Store(tmp_path / "store")
    check(matrix)
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    for row in results["tables"][0]["rows"]:
        errors = reached(grasp=1.0) if row["policy"] == "hdril" else reached(grasp=1.0, move=2.0)
        row["cells"]["varied"][0]["position_error_cm_by_primitive"] = errors
    text = markdown(results)
    assert "Primitives of a phase count alike: first: grasp, move; second: retract." in text
    cells = cells_of(text, "second")
    assert cells[0][3:] == ["minutes given", "evaluation", "first", "second"]
    minutes = {(row[0], row[3]): row[5:] for row in cells[1:-1]}
    assert minutes["`act`", "60"] == minutes["`linear`", ""] == ["1.5", ""]
    assert minutes["`hdril`", "10"] == ["", ""], "who did not reach all of a phase has no number"
    assert cells[-1] == ["`act`", "", "", "", "published", "", "1.5"]


def by_minutes(values: dict[str, Any]) -> None:
    """ACT and HDR-IL for 10 and 60 minutes, the linear maps for 10 steps."""
    one_row(values)
    for name in SPEEDS:
        values["policies"][name].pop("steps")
        values["policies"][name]["minutes"] = [10, 60]


def test_speed_is_measured_once_for_all_budgets_and_seeds_and_decides_the_steps(tmp_path: Path) -> None:
    matrix, store = changed(by_minutes), Store(tmp_path / "store")
    ordered = in_order(steps(matrix))
    kinds = [step.kind for step in ordered]
    assert {kind: kinds.count(kind) for kind in kinds} == {"record": 1, "calibrate": 2, "train": 10, "evaluate": 10}
    act = next(step for step in steps(matrix) if step.policy.name == "act" and step.policy.minutes == 60)
    assert store.place(act.policy) is None, "its speed is not known"
    pretend(store, matrix, fails)
    command = act.policy.command(Path("out"), store.input_folders(act.policy))
    assert f"--steps={100 + (3600 - 60) * 4}" in command
    assert f"--save_freq={100 + (3600 - 60) * 4}" in command
    speed = act.policy.inputs["speed"]
    told = speed.command(Path("out"), store.input_folders(speed))
    assert told[:6] == ["python", "-m", "hdril.benchmark.calibrate", "--output=out", "--warm_up=30", "--measured=60"]
    training = told[told.index("--") + 1 :]
    same = {"--steps", "--save_freq", "--output_dir", "--seed", "--save_checkpoint", "--log_freq"}
    assert [o for o in training if o.partition("=")[0] not in same] == [
        o for o in command if o.partition("=")[0] not in same
    ]


def test_another_speed_is_another_training(tmp_path: Path) -> None:
    matrix, store = changed(by_minutes), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    trained = {step.policy: store.place(step.policy) for step in steps(matrix)}
    speed = next(step for step in in_order(steps(matrix)) if isinstance(step, Calibrate))
    path = store.get(speed).output.parent / "step.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"digest": "another"}))
    again = Store(store.folder)
    assert {step.name for step, place in trained.items() if again.place(step) != place} == {speed.training.name}
    assert again.find(speed), "what was measured is not measured again"


def test_frames_in_memory_are_another_training_by_what_holds_them(tmp_path: Path) -> None:
    def held(values: dict[str, Any]) -> None:
        by_minutes(values)
        values["policies"]["act"]["in_memory"] = True

    stock, memory = (
        next(step.policy for step in steps(changed(change)) if step.policy.name == "act")
        for change in (by_minutes, held)
    )
    held_by = memory.settings()["in_memory"]
    assert set(held_by) == {"source", "datasets", "pyarrow"}
    assert memory.settings() == stock.settings() | {"in_memory": held_by}
    assert memory.inputs["speed"].settings()["in_memory"] == held_by
    assert {"calibration", "minutes"} < set(stock.settings())
    by_steps = replace(memory, minutes=0.0, steps=7)
    command = by_steps.command(Path("out"), {"data": Path("set")})
    assert command[:3] == ["python", "-m", "lerobot_policy_hdril.in_memory"]
    assert command[3:] == replace(by_steps, in_memory=False).command(Path("out"), {"data": Path("set")})[1:]


def test_minutes_and_steps_are_reported_and_compared_like_with_like(tmp_path: Path) -> None:
    matrix, store = changed(by_minutes), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    (table,) = results["tables"]
    told = [(row["policy"], row["minutes"], row["steps"]) for row in table["rows"]]
    assert told == [
        ("linear", None, 10), ("act", 10.0, 2260), ("act", 60.0, 14260), ("hdril", 10.0, 1300), ("hdril", 60.0, 7300),
    ]  # fmt: skip
    pairs = [(test["policy"], test["minutes"], test["against_minutes"]) for test in table["tests"]]
    assert pairs == [("linear", None, 60.0), ("act", 10.0, 10.0), ("act", 60.0, 60.0)]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown(results).splitlines()]
    heads = next(line for line in lines if line[0] == "policy")
    assert heads[3:6] == ["minutes given", "steps", "minutes of training"]
    assert next(line for line in lines if line[0] == "`act`")[2:6] == ["50", "10", "2,260", "1.5 to 1.5"]
    assert next(line for line in lines if line[0] == "`linear`")[2:5] == ["50", "", "10"]
    assert "success" in figures(table)
    panel = figures(table)["minutes"].axes[0]
    legend = panel.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "linear, 50 of varied",
        "act, 50 of varied",
        "hdril, 50 of varied",
    ]
    labels = [label.get_text() for label in figures(table)["success"].axes[0].get_yticklabels()]
    assert labels[1:3] == ["act, 10 min, 50 of varied", "act, 60 min, 50 of varied"]


def test_demonstrations_are_drawn_and_one_of_them_is_highlighted(dataset: Path, tmp_path: Path) -> None:
    matrix = changed(lambda values: (one_row(values), values["tables"][0].update(trajectories=3)))
    store = Store(tmp_path / "store")
    pretend(store, matrix, fails)
    output = store.get(steps(matrix)[0].policy.data).output
    output.rmdir()
    output.symlink_to(dataset)
    (table,) = collect(matrix, store)["tables"]
    ((name, episodes),) = table["trajectories"].items()
    assert name == "varied"
    state = read_episode(dataset, 2).state
    np.testing.assert_allclose(episodes[2]["left"], state[:, :3], atol=6e-4)
    np.testing.assert_allclose(episodes[2]["right"], state[:, 8:11], atol=6e-4)
    lines = figures(table)["trajectories"].axes[0].get_lines()
    widths = [line.get_linewidth() for line in lines]
    assert len(lines) == 3 * 2
    assert [i for i, width in enumerate(widths) if width == max(widths)] == [2, 3], "both hands of the second episode"
    plain = changed(one_row)
    assert "trajectories" not in figures(collect(plain, store)["tables"][0])
    several = changed(lambda values: values["tables"][0].update(trajectories=3, demonstrations=[2, 5]))
    assert {step.episodes for step in drawn_data(several, several.tables[0]).values()} == {5}, (
        "there are enough of them"
    )
    assert set(drawn_data(several, several.tables[0]).values()) <= set(all_steps(several))


def test_a_held_out_episode_of_the_policy_that_matters_is_drawn(tmp_path: Path) -> None:
    def draw(values: dict[str, Any]) -> None:
        by_minutes(values)
        values["tables"][0].update(episode=SEED, demonstrations=[10, 50])
        values["evaluations"]["varied"]["options"] = [
            "--policy.rollout=open_loop",
            "--max_frames=9",
            "--mishap=hands_stay",
            "--device=cpu",
        ]

    matrix, store = changed(draw), Store(tmp_path / "store")
    (play,) = [step for step in all_steps(matrix) if isinstance(step, Play)]
    trained = play.evaluation.policy
    assert (trained.name, trained.minutes, trained.data.episodes, trained.seed) == ("hdril", 60.0, 50, 1)
    assert play.command(Path("out"), {"policy": Path("run")}) == [
        "python", "-m", "hdril.benchmark.episode", "--policy=run/checkpoints/last/pretrained_model",
        "--task=table_lift:level=varied", f"--seed={SEED}", "--output=out", "--policy.rollout=open_loop", "--max_frames=9",
        "--mishap=hands_stay",
    ]  # fmt: skip
    pretend(store, matrix, fails)
    (table,) = collect(matrix, store)["tables"]
    left, right = figures(table)["episode"].axes
    assert left.get_title().startswith(f"varied, seed {SEED}: failure\nhdril on 50 of")
    drawn = {str(line.get_label()): line.get_xydata() for line in right.get_lines()}
    np.testing.assert_allclose(drawn["y, predicted"], [[0, -0.2], [1, -0.2]])
    np.testing.assert_allclose(drawn["the expert"], [[0, 0.1]])
    ours, uniform, _ = figures(table)["attention"].axes
    assert (ours.get_title(), uniform.get_title()) == ("varied\nplanner, grasp", "uniform attention")
    assert [label.get_text() for label in ours.get_yticklabels()] == ["left", "right"]
    assert [text.get_text() for text in ours.texts] == ["0.25", "0.75", "1.00", "0.00"]
    np.testing.assert_array_equal(uniform.images[0].get_array(), np.full((2, 2), 0.5))
    many = {"nodes": list("abcdefghi"), "primitive": "grasp", "weights": np.eye(9).tolist()}  # as older reports have it
    episode = table["episodes"]["varied"]
    table["episodes"] = {"few": episode, "many": episode | {"attention": many}, "none": episode | {"attention": None}}
    few, wide, uniform, _ = figures(table)["attention"].axes
    assert (len(few.texts), len(wide.texts), len(uniform.get_yticklabels())) == (4, 0, 9)
    assert wide.get_title() == "many\ndynamics, grasp"
    plain = changed(lambda values: (draw(values), values["tables"][0].update(episode=-1)))
    assert "episode" not in figures(collect(plain, store)["tables"][0])


def test_a_report_says_what_was_done_with_its_seeds(tmp_path: Path) -> None:
    def tune(values: dict[str, Any]) -> None:
        one_row(values)
        values["evaluations"]["varied"]["tuning"] = True
        values["tuning"] = True

    def guard(values: dict[str, Any]) -> None:
        one_row(values)
        values["used_seeds"] = "configs/used_seeds.yaml"

    store = Store(tmp_path / "store")
    pretend(store, changed(one_row), fails)
    held_out = "No seed of an evaluation was trained on."
    guarded = f"{held_out} None is in `configs/used_seeds.yaml`, the list of seeds by which choices were made."
    for change, words in (
        (tune, "**This is for tuning.**"),
        (one_row, f"{held_out} In the commands"),
        (guard, guarded),
    ):
        assert words in markdown(collect(changed(change), store))


def test_the_page_holds_all_that_it_shows(tmp_path: Path) -> None:
    matrix, store = changed(lambda values: values["tables"][0].update(training_seeds=[1])), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    files = write_report(tmp_path / "out/test", results)
    names = {path.name for path in files}
    pictures = {f"test_lift_{name}.{kind}" for name in ("success", "demonstrations") for kind in ("png", "svg")}
    assert names == {"test.json", "test.md", "test.html"} | pictures
    assert names == {path.name for path in (tmp_path / "out").iterdir()}
    page, text, data = ((tmp_path / f"out/test.{kind}").read_text() for kind in ("html", "md", "json"))
    assert read_numbers(tmp_path / "out/test") == approximately(json.loads(json.dumps(results)))
    table, *rest = json.loads(data)["tables"]
    assert (len(data.splitlines()), rest) == (4 + len(json.loads(data)["steps"]), []), "one table and one step a line"
    made_from = [run["made_from"] for row in table["rows"] for runs in row["cells"].values() for run in runs]
    told = list(json.loads(data)["steps"])
    assert {name for made in made_from for name in made.values()} == set(told)
    assert told == sorted(told)
    write_report(tmp_path / "none/test", results | {"tables": []})
    assert json.loads((tmp_path / "none/test.json").read_text())["tables"] == []
    assert "![Lift](test_lift_success.png)" in text
    assert page.count("<svg") == 2
    assert "<img" not in page
    assert re.search(r"<text[^>]*>success, %</text>", page), "letters in pictures are text"
    assert "<table>" in page
    for name in pictures:
        if name.endswith("png"):
            assert Image.open(tmp_path / "out" / name).mode == "P", "few colours, few bytes"
        else:
            drawn = (tmp_path / "out" / name).read_text()
            assert not re.search(r"\n\s|\d\.\d{3}[^<]*>|Bitstream Vera", drawn), "few digits, no indents, one font"
            assert re.search(r"\d\.\d{2}[^\d<]*>", drawn), "hundredths of a point"
    parts = re.findall(r' id="([^"]+)"', page)
    assert len(parts) == len(set(parts)), "names of parts are unique"
    assert set(re.findall(r'(?:xlink:href="|url\()#([^")]+)', page)) <= set(parts)
    assert str(tmp_path) not in page
    before = {path.name: path.read_bytes() for path in files}
    write_report(tmp_path / "out/test", results)
    assert {path.name: path.read_bytes() for path in files} == before, "the same numbers make the same files"
    write_report(tmp_path / "out/test", read_numbers(tmp_path / "out/test"))
    assert {path.name: path.read_bytes() for path in files} == before, "what was read again makes the same files"


def approximately(value: Any) -> Any:
    """With numbers that are equal to six digits."""
    if isinstance(value, dict):
        return {key: approximately(each) for key, each in value.items()}
    if isinstance(value, list):
        return [approximately(each) for each in value]
    return pytest.approx(value, rel=1e-5) if isinstance(value, float) else value


def test_words_in_a_figure_keep_their_digits(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    found = collect(matrix, store)
    found["tables"][0]["title"] = "Seen with 0.00525 m"
    write_report(tmp_path / "test", found)
    (picture,) = tmp_path.glob("*_success.svg")
    assert ">Seen with 0.00525 m</text>" in picture.read_text()


def test_a_table_of_one_row_has_no_figure_of_its_success(tmp_path: Path) -> None:
    def reported(name: str, policies: list[str]) -> dict[str, Any]:
        def change(values: dict[str, Any]) -> None:
            one_row(values)
            values["tables"][0].update(policies=policies, against="")

        matrix, store = changed(change), Store(tmp_path / name)
        pretend(store, matrix, fails)
        return collect(matrix, store)

    others = [tmp_path / f"test_lift_{name}.png" for name in ("lift_success", "notes", "success_2")]
    for other in others:
        other.write_bytes(b"of another report, or of a person")
    for found, drawn in ((reported("two", ["linear", "hdril"]), True), (reported("one", ["linear"]), False)):
        write_report(tmp_path / "test", found)
        for kind in ("png", "svg"):
            assert (tmp_path / f"test_lift_success.{kind}").exists() == drawn, "an older figure is removed"
        assert ("![Lift](test_lift_success.png)" in (tmp_path / "test.md").read_text()) == drawn
    assert all(other.exists() for other in others)


def test_a_figure_has_room_and_the_colours_that_people_can_tell_apart(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    (table,) = results["tables"]
    (told,) = table["evaluations"].values()
    table["evaluations"] = {f"an evaluation with a long name, number {i}": told for i in range(4)}
    for row in table["rows"]:
        (runs,) = row["cells"].values()
        row["cells"] = dict.fromkeys(table["evaluations"], runs)
    write_report(tmp_path / "test", results)
    picture = np.asarray(Image.open(tmp_path / "test_lift_success.png").convert("RGB"), dtype=int)
    for colour in COLOURS[:4]:
        wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert np.abs(picture - wanted).max(axis=-1).min() <= 3, colour
    drawn = figures(table)["success"]
    drawn.draw_without_rendering()
    assert drawn.axes[0].get_position().width > 0.4, "names leave room for what they name"


def test_numbers_have_six_digits_and_a_line_for_each_run(tmp_path: Path) -> None:
    runs: list[dict[str, Any]] = [
        {"recipe": "one", "value": 1 / 3},
        {"recipe": "two", "values": (1 / 3, 2, True, None)},
    ]
    write_numbers(tmp_path / "test", {"name": "test", "runs": runs})
    assert (tmp_path / "test.json").read_text() == (
        '{"name":"test","tables":[],"runs":[\n{"recipe":"one","value":0.333333},\n'
        '{"recipe":"two","values":[0.333333,2,true,null]}\n],"steps":{}}'
    )
    assert runs[0]["value"] == 1 / 3


def test_runs_that_two_machines_made_from_the_same_keep_what_is_told_of_each(tmp_path: Path) -> None:
    trained: dict[str, Any] = {"recipe": "recipe", "digest": "digest", "seconds": 10.0, "machine": "fast"}
    runs: list[dict[str, Any]] = [
        {"recipe": "one", "made_from": {"train": trained}},
        {"recipe": "two", "made_from": {"train": trained}},
        {"recipe": "three", "made_from": {"train": trained | {"seconds": 20.0, "machine": "slow"}}},
    ]
    write_numbers(tmp_path / "test", {"name": "test", "runs": runs})
    found = read_numbers(tmp_path / "test")["runs"]
    assert found == runs
    assert found[0]["made_from"]["train"] is not found[1]["made_from"]["train"], "a change of one run is of that one"
    path = tmp_path / "test.json"
    assert len(json.loads(path.read_text())["steps"]) == 2
    path.write_text(re.sub(r'"steps":\{\n.*,\n', '"steps":{\n', path.read_text()))
    with pytest.raises(ValueError, match=r"test\.json is damaged: there is no step"):
        read_numbers(tmp_path / "test")


def test_reports_that_hold_each_step_in_each_run_are_read(tmp_path: Path) -> None:
    matrix, store = changed(one_row), Store(tmp_path / "store")
    pretend(store, matrix, fails)
    results = collect(matrix, store)
    (tmp_path / "test.json").write_text(json.dumps(results))
    assert read_numbers(tmp_path / "test") == json.loads(json.dumps(results))
    for runs in results["tables"][0]["rows"][0]["cells"].values():
        for run in runs:
            del run["made_from"]
    (tmp_path / "test.json").write_text(json.dumps(results))
    assert read_numbers(tmp_path / "test") == json.loads(json.dumps(results))


def test_the_command_plans_and_reports_without_doing_what_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = changed(one_row)
    config = BenchmarkConfig(**vars(matrix), store=tmp_path / "store", document=tmp_path / "report", plan=True)
    benchmark_command(config)
    told = capsys.readouterr().out
    assert "left    record    50 demonstrations of table_lift:level=varied" in told
    assert told.endswith("0 of 13 steps are done\n")
    assert not (tmp_path / "store").exists()
    store = Store(tmp_path / "store")
    pretend(store, matrix, fails)
    *_, last = steps(matrix)
    folder = store.get(last).output.parent
    shutil.rmtree(folder)
    benchmark_command(replace(config, jobs=2))
    told = capsys.readouterr().out.splitlines()
    assert told[-1] == "12 of 13 steps are done; about 1 min are left"  # 90 s like the others, by two
    assert "done    record    50 demonstrations of table_lift:level=varied (90 s)" in told
    with exclusively(folder, "a test"):
        benchmark_command(config)
    assert f"running evaluate  {last.title}" in capsys.readouterr().out
    shutil.rmtree(store.folder)
    pretend(store, matrix, fails)
    monkeypatch.setattr("hdril.benchmark.engine.start", None)  # doing a step would fail
    benchmark_command(replace(config, plan=False))
    assert json.loads((tmp_path / "report.json").read_text())["name"] == "test"
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "report.md").read_text().startswith("# Benchmark: test\n")
    for options, words in (
        ({"jobs": 0}, "jobs must be at least 1, got 0"),
        ({"shards": 4}, "--shards and --slurm.* are for --executor=slurm"),
        ({"document": tmp_path / "my report"}, "document must end with letters, digits, .* got 'my report'"),
    ):
        with pytest.raises(ValueError, match=words):
            benchmark_command(replace(config, **options))


def two_tables(values: dict[str, Any]) -> None:
    one_row(values)
    second = {"title": "Again, nominal", "evaluations": ["nominal"], "data": ["nominal"]}
    values["tables"].append(values["tables"][0] | second)


@pytest.fixture
def nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hdril.benchmark.engine.start", None)  # doing a step would fail


def do(folder: Path, title: str, store: str, change: Callable[[dict[str, Any]], object] = two_tables) -> dict[str, Any]:
    """The report after a table was done, whose steps another folder has."""
    matrix = changed(change)
    part = BenchmarkConfig(**vars(matrix), document=folder / "report", store=folder / store, only=[title])
    if not part.store.exists():
        pretend(Store(part.store), part.chosen, fails)
    benchmark_command(part)
    return read_numbers(folder / "report")


def titles(report: dict[str, Any]) -> list[str]:
    return [table["title"] for table in report["tables"]]


@pytest.mark.usefixtures("nothing_is_done")
def test_a_report_grows_table_by_table(tmp_path: Path) -> None:
    first = do(tmp_path, "Again, nominal", "one")
    assert titles(first) == ["Again, nominal"]
    both = do(tmp_path, "Lift", "two")
    assert titles(both) == ["Lift", "Again, nominal"], "in the order of the matrix"
    assert both["tables"][1] == first["tables"][0]
    # 1 recording, 6 trainings and 6 evaluations of 90 s.
    assert [table["made"]["hours"] for table in both["tables"]] == [0.33, 0.33]
    text = (tmp_path / "report.md").read_text()
    assert text.count("Its steps took 0.33 hours on a machine.") == 2
    assert "Evaluated with hdril 0." in text
    assert "Demonstrations of the scripted expert: `nominal`: 50 of `table_lift`, seeds from 0 on." in text

    def word(values: dict[str, Any]) -> None:
        two_tables(values)
        values["tables"][1] |= {"note": "A better note.", "published": {"act": "9 %"}, "published_by": "others"}

    (kept,) = do(tmp_path, "Lift", "two", word)["tables"][1:]
    assert (kept["note"], kept["published"], kept["published_by"]) == ("A better note.", {"act": "9 %"}, "others")
    with pytest.raises(ValueError, match=r"^only has no table 'Peg'; choose from: 'Lift', 'Again, nominal'$"):
        do(tmp_path, "Peg", "two")


class Doer:
    """Does steps in no time, on a machine of its own, where trainings end in other weights. Evaluations that are ``broken``
    fail, and so do trainings of the policy that is ``untrainable``."""

    def __init__(
        self, machine: str = "here", broken: Callable[[Evaluate], bool] = lambda step: False, untrainable: str = ""
    ) -> None:
        self.machine, self.broken, self.untrainable = machine, broken, untrainable
        self.begun: list[Step] = []

    def start(self, assignment: Assignment) -> Doing:
        """In place of :func:`hdril.benchmark.perform.start`."""
        step = assignment.step
        fails_here = isinstance(step, Train) and step.name == self.untrainable
        if fails_here or (isinstance(step, Evaluate) and self.broken(step)):
            return Doing(1)
        self.begun.append(step)
        command = step.command(assignment.place / "result", assignment.inputs)
        pretend_step(step, assignment.place, command, fails, self.machine)
        return Doing(0)

    def policies(self, kind: str) -> list[str]:
        """Policies of the steps of a kind that were begun."""
        return [step.policy.name if isinstance(step, Evaluate) else step.title.split()[0]
                for step in self.begun if step.kind == kind]  # fmt: skip


@dataclass
class Doing:
    """A process that is over."""

    returncode: int
    stdin: Any = field(default_factory=BytesIO)

    def poll(self) -> int:
        return self.returncode

    def communicate(self) -> tuple[None, bytes]:
        return None, b""

    def wait(self) -> int:
        return self.returncode


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """A command for a report, after which its store is lost. Returns the report."""

    def run(matrix: Matrix, document: str, doer: Doer, **options: Any) -> dict[str, Any]:
        monkeypatch.setattr("hdril.benchmark.engine.start", doer.start)
        config = BenchmarkConfig(**vars(matrix), store=tmp_path / "store", document=tmp_path / document, **options)
        try:
            benchmark_command(config)
        except UserError as error:
            assert "a step failed" in str(error)  # noqa: PT017
        finally:
            shutil.rmtree(config.store, ignore_errors=True)
        return read_numbers(tmp_path / document)

    return run


def test_an_evaluation_that_the_report_has_is_not_done_again(
    tmp_path: Path,
    session: Callable[..., dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A machine is gone before a table is whole; the next one does what is missing."""
    matrix = changed(lambda values: (one_row(values), values["tables"][0].update(episode=SEED)))
    begun = session(matrix, "parts", Doer(broken=lambda step: step.policy.name == "act"))
    assert begun["tables"] == []
    assert [run.get("n_success") for run in begun["runs"]] == [0, COUNT - 2, COUNT, COUNT, None], "and a drawn episode"
    assert not (tmp_path / "parts.md").exists(), "no table is whole"

    rest = Doer()
    parts = session(matrix, "parts", rest)
    assert (rest.policies("train"), rest.policies("evaluate")) == (["act"] * 2, ["act"] * 2)
    assert rest.policies("play") == []
    assert parts == session(matrix, "whole", Doer())
    assert parts["runs"] == [], "the table has them"

    nothing = Doer()
    assert session(matrix, "parts", nothing) == parts
    assert nothing.begun == []
    capsys.readouterr()
    session(matrix, "parts", nothing, plan=True)
    *lines, last = capsys.readouterr().out.splitlines()
    assert last == "14 of 14 steps are done"
    assert {line.split()[0] for line in lines} == {"kept"}

    again = Doer()
    with monkeypatch.context() as edited:
        edited.setattr("hdril.benchmark.steps.package_software", lambda package: {package: "another source"})
        session(matrix, "parts", again)
    assert set(again.policies("train")) == set(again.policies("evaluate")) == {"linear", "hdril"}, "not ACT's"


def test_a_row_is_of_one_trained_policy(session: Callable[..., dict[str, Any]]) -> None:
    """What is left of a training whose weights are lost is done again with new weights; if they are the same, it is used."""
    matrix = changed(
        lambda values: (
            one_row(values),
            values["tables"][0].update(data=["nominal"], evaluations=["nominal", "varied"], policies=["act", "hdril"]),
        )
    )
    broken = Doer(broken=lambda step: (step.name, step.policy.name) == ("varied", "act"))
    session(matrix, "same", broken)
    here = Doer()
    assert session(matrix, "same", here)["tables"] == session(matrix, "other", Doer())["tables"]
    assert (here.policies("train"), [step.name for step in here.begun if isinstance(step, Evaluate)]) == (
        ["act"] * 2, ["varied"] * 2,
    )  # fmt: skip
    one_left = Doer(broken=lambda step: step.name == "varied" or step.policy.name == "hdril")
    session(matrix, "blocked", one_left)
    fails_again = Doer(untrainable="act")
    session(matrix, "blocked", fails_again)
    assert fails_again.policies("evaluate") == ["hdril"] * 4, "what is not made from it is done"
    session(matrix, "report", broken)
    there = Doer("there")
    (table,) = session(matrix, "report", there)["tables"]
    assert there.policies("evaluate") == ["act"] * 4
    act, hdril = (
        [[run["made_from"]["train"]["digest"] for run in runs] for runs in row["cells"].values()]
        for row in table["rows"]
    )
    assert act[0] == act[1]
    assert hdril[0] == hdril[1]
    whole = session(matrix, "whole", Doer("there"))["tables"][0]["rows"]
    assert table["rows"][0] == whole[0]
    assert table["rows"][1] != whole[1], "those weights are of the first machine"


def test_runs_that_no_table_asks_for_leave_the_report(
    session: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def without_act(values: dict[str, Any]) -> None:
        two_tables(values)
        values["tables"][0].update(policies=["linear", "hdril"])

    both, second = changed(two_tables), {"only": ["Again, nominal"]}
    session(both, "report", Doer(broken=lambda step: step.policy.name == "hdril"), only=["Lift"])
    assert len(session(both, "report", Doer(), **second)["runs"]) == 4, "what another table is made of stays"
    assert "left the report" not in capsys.readouterr().out
    assert len(session(changed(without_act), "report", Doer(), **second)["runs"]) == 2
    assert "left the report, as no table asks for them with these options and versions: 2\n" in capsys.readouterr().out


@pytest.mark.usefixtures("nothing_is_done")
def test_a_table_that_goes_takes_its_pictures_along(tmp_path: Path) -> None:
    do(tmp_path, "Again, nominal", "one")
    do(tmp_path, "Lift", "two")
    pictures = {path.name for path in tmp_path.glob("report_*")}
    assert {"report_lift_success.png", "report_again_nominal_success.svg"} <= pictures

    def asked_anew(values: dict[str, Any]) -> None:
        two_tables(values)
        values["tables"][1]["beside"] = ["pc_noticed"]

    assert titles(do(tmp_path, "Lift", "two", asked_anew)) == ["Lift"]
    assert {path.name for path in tmp_path.glob("report_*")} == {name for name in pictures if "again" not in name}


@pytest.mark.parametrize("page", sorted((ROOT / "docs/benchmark").glob("*.json")), ids=lambda page: page.stem)
def test_the_tables_of_the_published_pages_are_what_the_matrix_asks_for(page: Path) -> None:
    """A change of the definition, or of what a report needs, would drop rows that took hours."""
    matrix = read(ROOT / f"configs/benchmark/{page.stem}.yaml")
    before = read_numbers(page.with_suffix(""))
    results.kept_runs(before)  # older ones do not say how they were made
    kept = results.keep_tables(matrix, before | {"tables": []}, before)
    assert [table["title"] for table in kept["tables"]] == [table["title"] for table in before["tables"]]
    markdown(kept)


@pytest.mark.usefixtures("nothing_is_done")
def test_a_table_that_lacks_what_the_report_needs_now_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as older:
        older.setattr(results, "_SHAPE", 3)
        do(tmp_path, "Again, nominal", "one")
    assert titles(do(tmp_path, "Lift", "two", two_tables)) == ["Lift"]


@pytest.mark.usefixtures("nothing_is_done")
def test_a_report_of_before_an_option_came_keeps_its_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it was when data had no strays."""
    whole = results.asdict

    def before(value: Any) -> dict[str, Any]:
        return {key: told for key, told in whole(value).items() if key != "stray"}

    with monkeypatch.context() as older:
        older.setattr(results, "asdict", before)
        do(tmp_path, "Again, nominal", "one")
    assert titles(do(tmp_path, "Lift", "two", two_tables)) == ["Lift", "Again, nominal"]


@pytest.mark.usefixtures("nothing_is_done")
@pytest.mark.parametrize(
    "change",
    [
        lambda values: values["policies"]["act"].update(steps=31),
        lambda values: values["data"]["nominal"].update(perturb=0.001),
        lambda values: values["data"]["nominal"].update(stray=0.001),
        lambda values: values["evaluations"]["nominal"].update(options=["--max_frames=80"]),
        lambda values: values["tables"][1].update(training_seeds=[1]),
        lambda values: values["tables"][1].update(by_primitive=True),
    ],
)
def test_a_table_that_is_asked_for_in_another_way_now_goes(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], capsys: pytest.CaptureFixture[str]
) -> None:
    do(tmp_path, "Again, nominal", "one")
    assert titles(do(tmp_path, "Lift", "two", lambda values: (two_tables(values), change(values)))) == ["Lift"]
    assert "because they are asked for in another way now: Again, nominal" in capsys.readouterr().out


@pytest.mark.usefixtures("nothing_is_done")
def test_a_report_of_before_is_read_before_anything_is_done(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    report.write_text("{")
    with pytest.raises(ValueError, match=r"report\.json is not valid JSON"):
        do(tmp_path, "Lift", "two")
    report.write_text(json.dumps({"name": "another", "tuning": False, "tables": []}))
    with pytest.raises(
        ValueError, match=r"report\.json is the report of another benchmark: {'name': 'another'}; give another"
    ):
        do(tmp_path, "Lift", "two")
    assert json.loads(report.read_text())["name"] == "another"
    old = {"title": "Again, nominal", "rows": []}  # by an hdril that did not tell what made a table
    report.write_text(json.dumps({"name": "test", "tuning": False, "hdril_version": "0", "tables": [old]}))
    assert titles(do(tmp_path, "Lift", "two")) == ["Lift"]


def test_tables_have_titles_that_name_their_files() -> None:
    with pytest.raises(
        ValueError, match=r"^tables need titles that differ in letters or digits; alike are 'Lift' and 'lift!'$"
    ):
        check(changed(lambda values: values["tables"].append(values["tables"][0] | {"title": "lift!"})))
    for title in ("…", "x" * 81):
        with pytest.raises(ValueError, match=r"^a title names files: it needs 1 to 80 letters and digits, got"):
            check(changed(lambda values, title=title: values["tables"][0].update(title=title)))


def test_on_slurm_jobs_share_the_steps_and_the_last_one_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    slurm = FakeSlurm(tmp_path / "slurm", monkeypatch)
    config = BenchmarkConfig(
        **vars(changed(two_tables)), store=tmp_path / "store", document=tmp_path / "report", executor="slurm", shards=3,
        slurm=SlurmConfig("cpu"), only=["Lift"],
    )  # fmt: skip
    benchmark_command(config)
    shards, finish = (job for job in slurm.jobs if "launch_pickled_pipeline" in job.script)
    assert shards.options["array"] == "0-2%3"
    assert "Submitted 3 jobs as job 100" in capsys.readouterr().out
    assert not (tmp_path / "report.md").exists()
    pretend(Store(tmp_path / "store"), config.chosen, fails)
    shards.run(only=2)
    assert len(json.loads((tmp_path / "report.json").read_text())["runs"]) == 6, "as soon as they are done"
    finish.run()
    assert (tmp_path / "report.md").read_text().startswith("# Benchmark: test\n")
    for options, words in (
        ({"executor": "ray"}, "executor must be local or slurm, got 'ray'"),
        ({"slurm": SlurmConfig()}, r"--executor=slurm needs --slurm\.partition"),
    ):
        with pytest.raises(ValueError, match=words):
            benchmark_command(replace(config, **options))


def test_outcomes_of_one_policy_do_not_differ_from_themselves(tmp_path: Path) -> None:
    from hdril.evaluation.statistics import bootstrap_difference

    same = np.random.default_rng(3).random((1, 50)) < 0.6
    assert bootstrap_difference(same, same) == (0.0, 0.0)
    better = np.ones((3, 200), np.bool_)
    worse = np.tile(np.arange(200) % 4 > 0, (3, 1))
    low, high = bootstrap_difference(better, worse)
    assert 0.18 < low < 0.25 < high < 0.32, "a quarter of the seeds, give or take two standard errors of 0.03"
    assert bootstrap_difference(worse, better) == pytest.approx((-high, -low), abs=0.01)
    # Trainings that differ make the interval wider than seeds alone do.
    uneven = np.concatenate([np.ones((1, 200), np.bool_), np.zeros((1, 200), np.bool_)])
    wide = bootstrap_difference(uneven, worse[:1])
    assert wide[1] - wide[0] > 0.9
    with pytest.raises(ValueError, match=r"the same seeds, got \(3, 200\) and \(1, 50\)"):
        bootstrap_difference(better, same)
