"""Datasets, checkpoints and results on a Hub in memory: what is published, read back, refused, and retried."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from huggingface_hub import DatasetCard, ModelCard, constants
from huggingface_hub.utils import _http, set_client_factory
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_pre_post_processors
from lerobot_policy_hdril import HDRILPolicy
from safetensors.torch import load_file, save_file

import hdril.hub.publish
from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.cli.record import RecordConfig, record_command
from hdril.evaluation.checkpoint import Checkpoint, find_checkpoint
from hdril.evaluation.evaluate import Worker, make_job
from hdril.evaluation.stored import read_evaluation
from hdril.hub.cards import checkpoint_card, with_evaluation
from hdril.hub.evaluations import publish_evaluation
from hdril.hub.publish import HubError, publish
from tests.evaluation.checkpoints import save_act, save_hdril
from tests.evaluation.test_identity import finish
from tests.hub.fake_hub import FakeHub

TOKEN = "hf_" + "a" * 34


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """An empty Hub, a cache of its own, and no waiting."""
    fake = FakeHub()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    fake.waits = []
    monkeypatch.setattr(hdril.hub.publish, "time", SimpleNamespace(sleep=fake.waits.append))
    monkeypatch.setattr(_http, "time", SimpleNamespace(sleep=lambda _: None, time=time.time))
    set_client_factory(fake.client)
    yield fake
    set_client_factory(_http.default_client_factory)


@pytest.fixture(scope="module")
def checkpoint(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint as LeRobot saves it, trained on nothing but what is solved."""
    return save_hdril(tmp_path_factory.mktemp("policy") / "pretrained_model", dataset)


def squeeze(text: str) -> str:
    """Text without the padding of its tables."""
    return re.sub(r" +", " ", text)


def push_dataset(dataset: Path, **options) -> None:
    record_command(RecordConfig(repo_id="user/lifts", num_episodes=6, root=dataset, workers=1, push=True, **options))


def test_dataset_is_published_whole_with_its_card(hub: FakeHub, dataset: Path) -> None:
    push_dataset(dataset)
    repository = hub.repositories["dataset", "user/lifts"]
    assert repository.private
    assert repository.commits == 1
    assert repository.tags == {"v3.0": repository.revision}
    for path in [p for p in dataset.rglob("*") if p.is_file()]:
        assert repository.files[str(path.relative_to(dataset))] == path.read_bytes()
    card = DatasetCard(repository.files["README.md"].decode())
    assert {"LeRobot", "hdril", "table_lift"} <= set(card.data.tags)
    assert card.data.task_categories == ["robotics"]
    assert card.data.configs[0]["data_files"] == "data/*/*.parquet"
    assert card.data.license == "apache-2.0"
    assert "More Information Needed" not in card.text
    for word in ("left_ee.qw", "| 0 | grasp | 10 |", '"waypoint"', "xie2020deep", "arxiv.org/abs/2010.05134", "seed"):
        assert word in squeeze(card.text), word


def test_pushing_again_moves_the_tag(hub: FakeHub, dataset: Path) -> None:
    push_dataset(dataset, private=False)
    push_dataset(dataset)
    repository = hub.repositories["dataset", "user/lifts"]
    assert not repository.private, "an existing repository stays as it is"
    assert repository.commits == 2
    assert repository.tags == {"v3.0": repository.revision}


def test_another_dataset_than_asked_for_is_not_pushed(hub: FakeHub, dataset: Path) -> None:
    with pytest.raises(FileExistsError, match="holds something else"):
        record_command(RecordConfig(repo_id="user/lifts", num_episodes=5, root=dataset, push=True))
    assert not hub.requests


@pytest.mark.portable
def test_pushed_policy_is_loaded_and_evaluated_from_the_hub(
    hub: FakeHub, checkpoint: Path, tmp_path: Path, dataset: Path
) -> None:
    """Push by LeRobot's own way, evaluate what the Hub has, publish the results, and find them in the card."""
    policy = HDRILPolicy.from_pretrained(checkpoint)
    policy.config.repo_id, policy.config.private = "user/lifter", True
    training = TrainPipelineConfig.from_pretrained(checkpoint)
    policy.push_model_to_hub(training, dataset_meta=LeRobotDatasetMetadata("hdril/test", dataset))
    for processor in make_pre_post_processors(policy.config):
        processor.push_to_hub("user/lifter")
    repository = hub.repositories["model", "user/lifter"]
    card = repository.files["README.md"].decode()
    line = "lerobot-eval --policy.path=user/lifter --env.type=hdril --env.task=table_lift"
    assert line in card
    assert "Not evaluated yet" in card
    assert "| grasp | 10 |" in squeeze(card)
    assert "More Information Needed" not in card

    local = Worker(make_job("table_lift", str(checkpoint), 700_000, 1)).play(700_000).outcome
    config = EvalConfig(
        PolicySource("user/lifter"),
        num_episodes=1,
        seed=700_000,
        workers=1,
        output_dir=tmp_path / "eval",
        push="user/lifter",
    )
    eval_command(config)
    results = json.loads(repository.files["eval/table_lift_700000/results.json"])
    assert results["per_episode"][0]["position_error_cm"] == local.position_error_cm
    assert repository.files["eval/table_lift_700000/report.png"].startswith(b"\x89PNG")
    evaluated = ModelCard(repository.files["README.md"].decode())
    assert "Not evaluated yet" not in evaluated.text
    assert f"{results['n_success']} of 1" in evaluated.text
    assert "--seed=700000" in evaluated.text
    assert "## Citation" in evaluated.text
    assert evaluated.data.eval_results[0].metric_value == results["pc_success"]
    assert not [name for name in repository.files if name.endswith((".pkl", ".pt", ".bin", ".py"))]
    eval_command(config)  # the same again: published, not played
    again = ModelCard(repository.files["README.md"].decode())
    assert squeeze(again.text).count("95 % interval |") == 1
    assert len(again.data.eval_results) == 1


def test_local_checkpoint_is_published_with_its_results(hub: FakeHub, checkpoint: Path, tmp_path: Path) -> None:
    eval_command(
        EvalConfig(PolicySource(str(checkpoint)), num_episodes=1, seed=700_001, workers=1, output_dir=tmp_path / "eval",
                   push="user/local", rerun="none")
    )  # fmt: skip
    repository = hub.repositories["model", "user/local"]
    assert repository.commits == 1
    assert repository.files["model.safetensors"] == (checkpoint / "model.safetensors").read_bytes()
    card = repository.files["README.md"].decode()
    here, published = (json.loads(text) for text in (
        (tmp_path / "eval/results.json").read_text(), repository.files["eval/table_lift_700001/results.json"],
    ))  # fmt: skip
    assert here.pop("policy_folder") == str(checkpoint.resolve())
    assert published.pop("policy_folder") == ""
    assert published == here
    assert "--policy.path=user/local" in card
    assert "The seeds are held out: compared with the seeds of the training data, recipe" in card


def test_results_of_other_weights_are_not_published(hub: FakeHub, checkpoint: Path, tmp_path: Path) -> None:
    """Training goes on after an evaluation: the new weights must not go up with the rate of the old ones."""
    last = Path(shutil.copytree(checkpoint, tmp_path / "last"))
    config = EvalConfig(PolicySource(str(last)), num_episodes=1, seed=700_002, workers=1, output_dir=tmp_path / "eval",
                        rerun="none")  # fmt: skip
    eval_command(config)
    weights = load_file(last / "model.safetensors")
    weights["output_mean"] += 1e-3
    save_file(weights, last / "model.safetensors")
    with pytest.raises(
        ValueError, match=r"eval holds results of other weights \([0-9a-f]{12} there, [0-9a-f]{12} here\)"
    ):
        eval_command(replace(config, push="user/local"))
    assert not hub.repositories


def files_of(checkpoint: Path) -> dict[str, Path | bytes]:
    """What a repository of this checkpoint holds."""
    return {path.name: path for path in checkpoint.iterdir()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model.safetensors": b"of another policy"}, r"with other weights \(\w{12} there, \w{12} here\)"),
        ({"config.json": {"rollout": "open_loop"}}, r"with other config \(\w{12} there, \w{12} here\)"),
        ({"policy_postprocessor.json": {"name": "another"}}, r"with other processors \(\w{12} there, \w{12} here\)"),
    ],
)
def test_results_do_not_go_into_the_card_of_another_policy(
    hub: FakeHub, checkpoint: Path, tmp_path: Path, change: dict, message: str
) -> None:
    """A policy of the Hub has no files here that could go along: the repository must hold the very same."""
    job = make_job("table_lift", Checkpoint("user/lifter", checkpoint), 700_003, 1)
    evaluation = read_evaluation(finish(job, tmp_path / "eval"))
    content = files_of(checkpoint)
    for name, new in change.items():
        old = json.loads((checkpoint / name).read_text()) if isinstance(new, dict) else {}
        content[name] = json.dumps(old | new).encode() if isinstance(new, dict) else new
    publish("user/other", "model", content, "message", private=True)
    before = dict(hub.repositories["model", "user/other"].files)
    with pytest.raises(ValueError, match=rf"user/other holds another policy, {message}: its card cannot show"):
        publish_evaluation("user/other", job, evaluation, private=True)
    assert hub.repositories["model", "user/other"].files == before
    publish("user/other", "model", files_of(checkpoint), "message", private=True)
    publish_evaluation("user/other", job, evaluation, private=True)
    card = hub.repositories["model", "user/other"].files["README.md"].decode()
    assert f"weights with the SHA-256 `{job.identity.policy.weights[:12]}…`" in card
    assert "pybullet" in card
    assert "Whether the seeds are held out is not known: it is a test." in card


@pytest.mark.parametrize("missing", ["", "model.safetensors", "config.json", "policy_preprocessor.json"])
def test_results_of_a_policy_do_not_go_where_there_is_none(
    hub: FakeHub, checkpoint: Path, tmp_path: Path, missing: str
) -> None:
    """No repository at all, or one whose policy is not whole."""
    job = make_job("table_lift", Checkpoint("user/lifter", checkpoint), 700_003, 1)
    evaluation = read_evaluation(finish(job, tmp_path / "eval"))
    if missing:
        content = files_of(checkpoint)
        del content[missing]
        publish("user/other", "model", content, "message", private=True)
    commits = {name: repository.commits for name, repository in hub.repositories.items()}
    with pytest.raises(ValueError, match=r"user/other holds no policy that could have these results: .* user/lifter"):
        publish_evaluation("user/other", job, evaluation, private=True)
    assert {name: repository.commits for name, repository in hub.repositories.items()} == commits


def test_what_is_pushed_meanwhile_is_not_overwritten(
    hub: FakeHub, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look at the repository and the commit, somebody pushes another policy there."""
    job = make_job("table_lift", Checkpoint("user/lifter", checkpoint), 700_003, 1)
    evaluation = read_evaluation(finish(job, tmp_path / "eval"))
    publish("user/lifter", "model", files_of(checkpoint), "message", private=True)
    repository = hub.repositories["model", "user/lifter"]
    answer = hub.answer

    def races(request: httpx.Request) -> httpx.Response:
        if "/preupload/" in request.url.path:
            repository.files["model.safetensors"] = b"of another policy"
            repository.commits = 2
        return answer(request)

    monkeypatch.setattr(hub, "answer", races)
    set_client_factory(hub.client)
    with pytest.raises(HubError, match="412, somebody else has changed it since it was read"):
        publish_evaluation("user/lifter", job, evaluation, private=True)
    assert not vars(hub)["waits"]
    assert "README.md" not in repository.files


def test_card_and_results_of_another_policy_do_not_outlive_it(hub: FakeHub, dataset: Path, tmp_path: Path) -> None:
    """A policy is published with results of two tasks; then another one goes into the same repository."""

    def push(name: str, task: str, seed: int) -> None:
        job = make_job(task, str(tmp_path / name), seed, 1)
        output = tmp_path / f"eval_{name}_{seed}"
        publish_evaluation("user/lifter", job, read_evaluation(finish(job, output)), private=True)

    save_hdril(tmp_path / "first", dataset)
    save_hdril(tmp_path / "second", dataset, episodes=(0, 1, 2))
    push("first", "table_lift", 10)
    files = hub.repositories["model", "user/lifter"].files
    push("first", "table_lift:level=varied", 20)
    files["notes.txt"] = b"kept"

    def card() -> str:
        return files["README.md"].decode()

    assert "| episodes learned from | 6 |" in squeeze(card())
    assert len(ModelCard(card()).data.to_dict()["model-index"][0]["results"]) == 2
    push("second", "table_lift", 30)
    assert "| episodes learned from | 3 |" in squeeze(card())
    assert len(ModelCard(card()).data.to_dict()["model-index"][0]["results"]) == 1
    assert {name.split("/")[1] for name in files if name.startswith("eval/")} == {"table_lift_30"}
    assert files["notes.txt"] == b"kept"
    assert files["model.safetensors"] == (tmp_path / "second/model.safetensors").read_bytes()
    push("second", "table_lift:level=varied", 20)  # of this very policy: both are kept
    assert len({name.split("/")[1] for name in files if name.startswith("eval/")}) == 2
    assert len(ModelCard(card()).data.to_dict()["model-index"][0]["results"]) == 2


def test_a_policys_card_describes_only_what_it_learned_from(hub: FakeHub, dataset: Path, tmp_path: Path) -> None:
    """Another dataset of another task is recorded at the path that training was given."""
    root = Path(shutil.copytree(dataset, tmp_path / "data"))
    policies = [
        find_checkpoint(str(save(tmp_path / name, root)))
        for name, save in (("hdril", save_hdril), ("act", lambda folder, data: save_act(folder, data, str(data))))
    ]

    def rows() -> list[str]:
        return [squeeze(checkpoint_card(policy, "user/policy")) for policy in policies]

    ours, theirs = rows()
    for line in ("# HDR-IL: table_lift", "| episodes learned from | 6 |", "| episodes | 6 |", "--task=table_lift"):
        assert line in ours
    for name, change in (
        ("info.json", {"total_episodes": 999, "robot_type": "another"}),
        ("hdril.json", {"recipe": {"task": "peg_in_hole"}}),
        ("stats.json", {"action": {"mean": [0.0] * 16, "std": [1.0] * 16}}),
    ):
        file = root / "meta" / name
        file.write_text(json.dumps(json.loads(file.read_text()) | change))
    ours, theirs = rows()
    assert "# HDR-IL: table_lift" in ours
    assert "| episodes learned from | 6 |" in ours
    for word in ("| episodes |", "999", "another", "peg_in_hole"):
        assert word not in ours
        assert word not in theirs or word == "| episodes |"


def test_card_without_a_place_for_results_gets_one() -> None:
    summary = {
        "task": "table_lift", "overrides": ["--rollout=open_loop"], "n_success": 3, "n_episodes": 4, "pc_success": 75.0,
        "pc_success_ci95": [30.0, 95.0], "first_seed": 9, "held_out": None,
        "held_out_basis": "the training data have no record of seeds", "max_frames": 0,
        "identity": {"policy": {"weights": "a" * 64, "device": "cpu", "software": {"torch": "2"}}, "trials": {"software": {}}},
        **{key: {"mean": 1.0, "std": 0.0} for key in ("position_error_cm", "angle_error_rad", "dtw_cm")},
    }  # fmt: skip
    card = with_evaluation(ModelCard("# ACT\n\nSomething.\n"), summary, "user/act")
    assert card.text.index("Something.") < card.text.index("## Evaluation") < card.text.index("3 of 4")
    assert "--policy.rollout=open_loop" in card.text
    assert "Whether the seeds are held out is not known: the training data have no record of seeds." in card.text
    assert "weights with the SHA-256 `aaaaaaaaaaaa…`, on cpu, with torch 2." in card.text


def test_card_keeps_the_rates_of_each_task_apart() -> None:
    summary = {
        "overrides": [], "n_success": 3, "n_episodes": 4, "pc_success_ci95": [30.0, 95.0], "first_seed": 9,
        "held_out": None, "held_out_basis": "the training data have no record of seeds", "max_frames": 0,
        "identity": {"policy": {"weights": "a" * 64, "device": "cpu", "software": {}}, "trials": {"software": {}}},
        **{key: {"mean": 1.0, "std": 0.0} for key in ("position_error_cm", "angle_error_rad", "dtw_cm")},
    }  # fmt: skip
    card = ModelCard("---\nmodel_name: x\n---\n# ACT\n")
    for task, rate in (
        ("peg_in_hole", 100.0),
        ("peg_in_hole:clearance=0.004", 12.0),
        ("peg_in_hole:clearance=0.004", 13.0),
    ):
        card = ModelCard(str(with_evaluation(card, summary | {"task": task, "pc_success": rate}, "user/act")))
    rates = {result.dataset_name: result.metric_value for result in card.data.eval_results}
    assert rates == {"peg_in_hole": 100.0, "peg_in_hole:clearance=0.004": 13.0}
    assert len(card.data.eval_results) == 2


# ---------------------------------------------------------------------- faults

FILES: dict[str, Path | bytes] = {"a.txt": b"one", "b/c.txt": b"two"}
DROPPED = httpx.RemoteProtocolError("Server disconnected without sending a response.")


@pytest.mark.parametrize("route", ["create", "preupload", "commit"])
@pytest.mark.parametrize("fault", [429, 500, 503, httpx.ReadTimeout("timed out"), DROPPED], ids=str)
def test_what_passes_is_tried_again(hub: FakeHub, route: str, fault: int | Exception) -> None:
    hub.faults[route] = [fault, fault]
    publish("user/x", "model", FILES, "message", private=True)
    repository = hub.repositories["model", "user/x"]
    assert repository.files == {"a.txt": b"one", "b/c.txt": b"two"}
    assert repository.commits == 1


@pytest.mark.parametrize(
    ("route", "fault", "words"),
    [
        ("create", 401, "401, not logged in: run `hf auth login`, or set HF_TOKEN. Nothing was published"),
        ("create", 403, "403, the token may not write there. Nothing was published"),
        (
            "commit",
            404,
            "404, no such repository, or the token may not see it. The repository user/x exists, without these",
        ),
        ("commit", 401, "401, not logged in"),
        ("commit", 409, "409, somebody else is writing to it. The repository user/x exists, without these files"),
        ("commit", 429, "429, too many requests. The repository user/x exists"),
        ("commit", 502, "502, an error on its side. The repository user/x exists"),
        ("commit", httpx.ReadTimeout("timed out"), "it did not answer in time. The repository user/x exists"),
        ("commit", DROPPED, "the connection failed (Server disconnected without sending a response.)"),
        (
            "tag",
            500,
            "set the tag v3.0 of user/x: the Hub says 500, an error on its side. The files are published; only",
        ),
    ],
)
def test_what_stays_is_one_clear_line(hub: FakeHub, route: str, fault: int | Exception, words: str) -> None:
    hub.faults[route] = [fault] * 99
    with pytest.raises(HubError) as caught:
        publish("user/x", "dataset", FILES, "message", private=True, tag="v3.0")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    published = hub.repositories["dataset", "user/x"].files if ("dataset", "user/x") in hub.repositories else {}
    assert bool(published) == (route == "tag"), "all files or none"


def test_a_server_that_asks_for_long_waits_is_told_of(hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = hub.answer

    def busy(request: httpx.Request) -> httpx.Response:
        if "commit" in request.url.path:
            return httpx.Response(429, headers={"Retry-After": "600"}, json={})
        return answer(request)

    monkeypatch.setattr(hub, "answer", busy)
    set_client_factory(hub.client)
    with pytest.raises(HubError, match="429, too many requests"):
        publish("user/x", "model", FILES, "message", private=True)
    assert not hub.waits


def test_broken_upload_goes_on_with_what_is_missing(hub: FakeHub, tmp_path: Path) -> None:
    """Three large files; the connection breaks for good at the second. The next call does not send the first again."""
    hub.large = 1000
    files: dict[str, Path | bytes] = {}
    for name in "abc":
        (tmp_path / name).write_bytes(name.encode() * 5000)
        files[name] = tmp_path / name
    hub.faults["blob"] = []
    keep, sent = hub._keep, []

    def breaks(oid: str, body: bytes) -> httpx.Response:
        sent.append(oid)
        if len(set(sent)) > 1 and hub.faults is not None and not getattr(hub, "mended", False):
            raise DROPPED
        return keep(oid, body)

    hub._keep = breaks
    with pytest.raises(HubError, match="The repository user/x exists, without these files; the same command goes on"):
        publish("user/x", "model", files, "message", private=True)
    assert not hub.repositories["model", "user/x"].files
    first = set(hub.blobs)
    assert first
    assert len(first) < 3
    sent.clear()
    hub.mended = True
    publish("user/x", "model", files, "message", private=True)
    assert hub.repositories["model", "user/x"].files == {name: name.encode() * 5000 for name in "abc"}
    assert not first & set(sent)
    assert set(hub.blobs) == {hashlib.sha256(name.encode() * 5000).hexdigest() for name in "abc"}


def test_offline_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    set_client_factory(_http.default_client_factory)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with pytest.raises(HubError, match=r"offline mode is on: unset HF_HUB_OFFLINE\. Nothing was published"):
        publish("user/x", "model", FILES, "message", private=True)


def test_no_token_is_said(hub: FakeHub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "none"))
    hub.faults["create"] = [401]
    with pytest.raises(HubError, match="not logged in"):
        publish("user/x", "model", FILES, "message", private=True)
