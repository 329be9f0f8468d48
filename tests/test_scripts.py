"""``make demo``: which of its commands run again. The commands are fakes: nothing is recorded, trained or played."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
demo = import_module("demo")

FAKE = """#!/bin/sh
echo "$(basename "$0") $OMP_NUM_THREADS" >> log
for word; do case $word in
  --root=*|--output_dir=*) out=${word#*=};; --steps=*) steps=${word#*=};; --policy.path=*) policy=${word#*=};;
esac; done
test -e "$out" && exit 3
mkdir -p "$out.partial"
echo begun >> "$out.partial/times"
"""
RECORD = """mv "$out.partial" "$out" && mkdir "$out/meta" && cp recipe "$out/meta/info.json" && cp recipe "$out/meta/stats.json"
"""
TRAIN = """rm -r "$out.partial"
folder=$out/checkpoints/$(printf %06d "$steps")/pretrained_model
mkdir -p "$folder" && ln -sfn "$(printf %06d "$steps")" "$out/checkpoints/last" && cp recipe "$folder/config.json"
test -e interrupt && exit 4
cp recipe "$folder/model.safetensors"
"""
EVALUATE = """test -e interrupt && exit 4
echo '{"n_success": 9, "n_episodes": 10, "pc_success": 90.0, "pc_success_ci95": [60.0, 98.0]}' > "$out.partial/results.json"
cp "$out.partial/results.json" "$out.partial/eval_info.json" && cp "$policy/model.safetensors" "$out.partial/weights"
mv "$out.partial" "$out"
"""
COMMANDS = {"hdril-record": RECORD, "lerobot-train": TRAIN, "lerobot-eval": EVALUATE, "hdril-eval": EVALUATE}
ALL = ["hdril-record", "lerobot-train 1", "lerobot-eval", "hdril-eval"]
EVALUATIONS = ALL[2:]

Demo = Callable[..., list[str]]


@pytest.fixture
def run_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Demo:
    """Runs the demo with fake commands, and tells which of them ran.

    What is recorded and trained is a copy of the file ``recipe``. Training and evaluations fail half way if there is a file
    ``interrupt``. Each command refuses an output folder that exists, as the real ones do.
    """
    commands = tmp_path / "bin"
    commands.mkdir()
    for name, text in COMMANDS.items():
        (commands / name).write_text(FAKE + text)
        (commands / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(commands / "python"))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.chdir(tmp_path)
    demo.CONFIG.parent.mkdir(parents=True)
    for file in (Path("recipe"), demo.CONFIG):
        file.write_text("first")

    def run(*options: str) -> list[str]:
        Path("log").write_text("")
        monkeypatch.setattr(sys, "argv", ["demo", "--output=out", *options])
        demo.main()
        return [line.strip() for line in Path("log").read_text().splitlines()]

    return run


POLICY = Path("out/train/checkpoints/last/pretrained_model")


def test_what_is_done_is_skipped(run_demo: Demo, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_demo() == ALL
    assert "9 of 10 held-out seeds, 90.0 % (95 % interval 60.0 to 98.0)" in capsys.readouterr().out
    assert run_demo() == []
    assert capsys.readouterr().out.count("done before: ") == len(ALL)


@pytest.mark.parametrize(
    "changed", ["configs/train/table_lift.yaml", "out/dataset/meta/info.json", "out/dataset/meta/stats.json"]
)
def test_another_policy_is_evaluated_again(run_demo: Demo, changed: str) -> None:
    run_demo()
    Path(changed).write_text("second")
    Path("recipe").write_text("second")
    assert run_demo() == ["lerobot-train 1", *EVALUATIONS]
    assert Path("out/eval/weights").read_text() == "second"
    assert run_demo() == []


def test_the_same_weights_again_keep_their_evaluations(run_demo: Demo) -> None:
    run_demo()
    Path("out/dataset/meta/info.json").write_text("second")
    assert run_demo() == ["lerobot-train 1"]


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_checkpoint_that_something_else_wrote_is_evaluated_again(run_demo: Demo, name: str) -> None:
    run_demo()
    (POLICY / name).write_text("by hand")
    assert run_demo() == EVALUATIONS


def test_other_options_make_a_result_again(run_demo: Demo) -> None:
    run_demo()
    assert run_demo("--evaluations=20") == ["hdril-eval"]
    assert run_demo("--evaluations=20", "--steps=7") == ["lerobot-train 1"], "the fake weights are the same"


def test_results_of_unknown_origin_are_made_again(run_demo: Demo) -> None:
    run_demo()
    Path("out/eval.made_from").unlink()
    assert run_demo() == ["hdril-eval"]


def test_an_interrupted_training_starts_again_and_an_interrupted_evaluation_continues(run_demo: Demo) -> None:
    interrupt = Path("interrupt")
    interrupt.touch()
    with pytest.raises(SystemExit, match="lerobot-train failed with exit code 4"):
        run_demo()
    interrupt.unlink()
    assert run_demo() == ALL[1:]
    Path("out/eval.made_from").unlink()
    interrupt.touch()
    with pytest.raises(SystemExit, match="hdril-eval failed with exit code 4"):
        run_demo()
    interrupt.unlink()
    assert run_demo() == ["hdril-eval"]
    assert Path("out/eval/times").read_text() == "begun\nbegun\n", "the first part is there"


def test_the_rest_of_an_evaluation_of_other_weights_is_not_continued(run_demo: Demo) -> None:
    run_demo()
    weights = POLICY / "model.safetensors"
    weights.write_text("second")
    Path("interrupt").touch()
    with pytest.raises(SystemExit):
        run_demo()
    weights.write_text("third")
    Path("interrupt").unlink()
    assert run_demo() == EVALUATIONS
    assert Path("out/lerobot-eval/times").read_text() == "begun\n"


def test_records_say_what_a_result_is_made_from(run_demo: Demo) -> None:
    run_demo()
    record = json.loads(Path("out/eval.made_from").read_text())
    assert record["command"][0] == "hdril-eval"
    assert set(record["inputs"]) == {str(POLICY / name) for name in ("model.safetensors", "config.json")}


@pytest.mark.parametrize(
    ("name", "again"),
    [
        ("recording_software", ["hdril-record"]),
        ("training_software", ["lerobot-train 1", *EVALUATIONS]),
        ("evaluation_software", EVALUATIONS),
    ],
)
def test_results_of_other_software_are_made_again(
    run_demo: Demo, monkeypatch: pytest.MonkeyPatch, name: str, again: list[str]
) -> None:
    run_demo()
    monkeypatch.setattr(demo, name, lambda _: {"hdril": "of later"})
    assert run_demo() == again
    assert run_demo() == []
