"""What the pages say: length, links, commands and tables, against the repository as it is."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml

import hdril
from hdril.cli.bench import BenchConfig
from hdril.cli.benchmark import BenchmarkConfig
from hdril.cli.check import CheckConfig
from hdril.cli.eval import EvalConfig
from hdril.cli.labels import LabelsConfig
from hdril.cli.record import RecordConfig
from hdril.cli.view import ViewConfig
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.schema import features
from hdril.simulation.actions import ACTION_NAMES

ROOT = Path(__file__).parents[2]
FOLDERS = ("docs", "datasets", "policies")
PAGES = sorted([*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))])
COMMANDS = {
    "hdril-record": RecordConfig,
    "hdril-check": CheckConfig,
    "hdril-labels": LabelsConfig,
    "hdril-eval": EvalConfig,
    "hdril-view": ViewConfig,
    "hdril-bench": BenchConfig,
    "hdril-benchmark": BenchmarkConfig,
}
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def test_the_readme_has_at_most_500_words_and_the_two_commands() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= 500
    assert "make demo\nmake test\n" in text


HEADLINES = {
    "Table lift": "table lift",
    "Handover": "handover",
    "Peg in hole": "peg-in-hole",
    "Clear and lift": "clear and lift",
}


def test_headline_numbers_are_those_of_the_benchmark() -> None:
    """README's and the first ones of the results, by the data of the page that has the commands."""
    tables = {table["title"]: table for table in json.loads((ROOT / "docs/benchmark/suite.json").read_text())["tables"]}
    readme, results = ((ROOT / name).read_text() for name in ("README.md", "docs/results.md"))
    few = {f"{title}, from 50 demonstrations": task for title, task in HEADLINES.items()}
    for title, task in (HEADLINES | {title: task for title, task in few.items() if title in tables}).items():
        (row,) = tables[title]["rows"]
        for name, runs in row["cells"].items():
            (run,), level = runs, name.split(", ")[1]
            low, high = (f"{bound:.3g}" for bound in run["pc_success_ci95"])
            success = f"{run['n_success']} of {run['n_episodes']} | {low} to {high} %"
            expert = run["n_episodes"] - run["n_expert_failures"]
            beside = f"{expert} | {run['pc_expert_choice']:.3g} % | {run['jerk_to_expert']:.2f}"
            assert f"| {task}, `{level}` | {row['demonstrations']} | {success} | {beside} |" in results
            if level == "varied" and title in HEADLINES:
                assert f"| {task}, everything varied | {row['demonstrations']} | {success} |" in readme
    nominal = json.loads((ROOT / "docs/benchmark/headline.json").read_text())["tables"]
    found = {}
    for title in ("Table lift", "Peg in hole"):
        (row,) = next(table["rows"] for table in nominal if table["title"] == title)
        ((run,),) = row["cells"].values()
        low, high = (f"{bound:.3g}" for bound in run["pc_success_ci95"])
        found[title] = f"{row['demonstrations']} | {run['n_success']:,} of {run['n_episodes']:,} | {low} to {high} % |"
        apart = f"{10.0 * run['position_error_cm']['mean']:.1f} mm"
        assert f"| {HEADLINES[title]}, the default policy (seeds 650000 and up) | {found[title]} {apart} |" in results
    assert f"| table lift | {found['Table lift']}" in readme
    few = next(table["rows"] for table in nominal if table["title"] == "Table lift from ten demonstrations")
    runs = [run for row in few for run in row["cells"]["table_lift, few"]]
    success = (
        f"10 | {len(runs)} × {runs[0]['n_episodes']}: {', '.join(f'{run["pc_success"]:.3g}' for run in runs)} % | |"
    )
    assert f"| table lift, three trainings | {success}" in readme
    assert f"| table lift, the default policy, three trainings (seeds 650000 and up) | {success}" in results


EVENTS = {
    "push": "the object is pushed before it is grasped",
    "push_held": "it is pushed while it is held",
    "open_hand": "a hand opens for 0.3 to 0.6 s",
    "stop_motor": "a motor stops for 0.5 to 1 s",
    "platform_slide": "the goal slides",
    "rack_slide": "the goal slides",
    "freeze": "the sensor freezes",
    "repeat": "the sensor shows each third frame alone",
    "hands_stay": "in the first grasp, the hands stay where they are",
    "fingers_open": "in the first grasp, the fingers stay open",
    "hands_high": "in the first grasp, the hands arrive 6 cm too high",
}


def test_what_events_cost_is_what_the_benchmark_found() -> None:
    """The table of the results, by the data of the page: a column for each task, a row for each event."""
    tables = json.loads((ROOT / "docs/benchmark/suite.json").read_text())["tables"]
    text = (ROOT / "docs/results.md").read_text().partition("**Where one thing happens**")[2]
    written = text[text.index("| |") :].partition("\n\n")[0].splitlines()
    header, _, *lines = (line.strip("| ").split(" | ") for line in written)
    rows = {name: dict(zip(header, cells, strict=False)) for name, *cells in lines}
    told = [(table["rows"][0]["cells"], fall) for table in tables for fall in table["falls"]]
    assert told
    for cells, fall in told:
        task, event = fall["evaluation"].split(", ")
        ((run,), (control,)) = cells[fall["evaluation"]], cells[fall["control"]]
        low, high = fall["pc_difference_ci95"]
        column = HEADLINES[task.replace("_", " ").capitalize()]
        found = f"{run['n_success']} of {run['n_episodes']}, {fall['pc_difference']:+.1f} ({low:+.1f} to {high:+.1f})"
        assert rows[EVENTS[event]][column] == found
        assert rows["nothing"][column] == f"{control['n_success']} of {control['n_episodes']}"


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text())
    local = [target for target in targets if not target.startswith(("http:", "https:", "mailto:"))]
    assert [target for target in local if not (page.parent / target).exists()] == []


def _command_lines(text: str) -> Iterator[list[str]]:
    """Commands of hdril in code blocks, cut at spaces."""
    for block in re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            words = line.split("#")[0].split()
            if words and words[0] in COMMANDS:
                yield words


@cache
def _options(config: type[Any]) -> set[str]:
    """Names of the options of a command, those of nested configs with a dot."""
    hints = get_type_hints(config)
    nested = {
        f"{f.name}.{name}" for f in fields(config) if is_dataclass(hints[f.name]) for name in _options(hints[f.name])
    }
    return {field.name for field in fields(config)} | nested | {"config_path", "help"}


@each_page
def test_commands_have_the_options_that_the_page_gives_them(page: Path) -> None:
    for program, *words in _command_lines(page.read_text()):
        given = {word.removeprefix("--").split("=")[0] for word in words if word.startswith("--")}
        of_the_policy = {name for name in given if program == "hdril-eval" and name.startswith("policy.")}
        assert given - of_the_policy <= _options(COMMANDS[program]), f"{page.name}: {program} {' '.join(words)}"


def test_commands_are_found_in_pages() -> None:
    found = {words[0] for page in PAGES for words in _command_lines(page.read_text())}
    assert {"hdril-record", "hdril-check", "hdril-eval", "hdril-view"} <= found


@each_page
def test_files_that_the_page_names_exist(page: Path) -> None:
    named = set(re.findall(r"\b(?:configs|scripts|hdril|tests)/[\w/]+\.(?:yaml|py)\b", page.read_text()))
    if page.name == "CHANGELOG.md":  # it also names what is gone
        return
    assert {name for name in named if not (ROOT / name).exists()} == set()


@pytest.mark.parametrize("task", ["table_lift", "peg_in_hole"])
def test_the_page_of_the_dataset_has_every_column(task: str) -> None:
    text = (ROOT / "docs/reference/dataset.md").read_text()
    for name, feature in features(Recipe(task)).items():
        size = "7 for each object" if name == "observation.environment_state" else feature["shape"][0]
        assert f"| `{name}` | {feature['dtype']}, {size} |" in text, name
    for name in ACTION_NAMES[:8]:
        assert re.search(rf"\b{re.escape(name)}\b", text), name


def test_the_citation_is_valid_and_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    # The keys that version 1.2.0 of the format requires, and their types.
    assert citation["cff-version"] == "1.2.0"
    assert citation["message"]
    assert citation["title"].startswith("hdril")
    assert citation["type"] == "software"
    assert citation["version"] == hdril.__version__
    assert citation["license"] == "Apache-2.0"
    assert all("name" in author or "family-names" in author for author in citation["authors"])
    paper = citation["references"][0]
    assert paper["type"] == "conference-paper"
    assert paper["title"] == "Deep Imitation Learning for Bimanual Robotic Manipulation"
    assert [author["family-names"] for author in paper["authors"]][::5] == ["Xie", "Yu"]


@pytest.mark.long
def test_the_documentation_builds_without_warnings(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", ROOT / "docs", tmp_path]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--num_episodes" in (tmp_path / "reference/commands.html").read_text()
    assert "run_episode" in (tmp_path / "reference/api/hdril/hdril.rollout.html").read_text()
