"""A benchmark's results as Markdown."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from hdril.benchmark.matrix import BESIDE
from hdril.evaluation.statistics import TrainingSpread
from hdril.markdown import table as markdown_table

_LISTED = re.compile(r"'?--dataset\.episodes=(\[[\d, ]+\])'?")
_HELD_OUT = "No seed of an evaluation was trained or tuned on."
_TUNING = (
    "**This is for tuning.** No seed of an evaluation was trained on, but choices are made by these numbers: the best of them "
    "are better here than they will be on other seeds."
)
SIGNIFICANCE = 0.05
"""Family-wise error of a list of tests."""


def markdown(results: Mapping[str, Any], pictures: Sequence[Sequence[str]] = ()) -> str:
    """The report, with links to the pictures of each table, if there are any."""
    blocks = [
        f"# Benchmark: {results['name']}",
        "Made by `hdril-benchmark`, one thread a step. Success is in percent, with the 95 % interval (Wilson) over the seeds "
        "for one trained policy. Several trainings are written as trainings × seeds: the mean, then the range and the standard "
        f"deviation over trainings. {_TUNING if results['tuning'] else _HELD_OUT} Commands stand at the end.",
    ]
    shown = pictures or [()] * len(results["tables"])
    for table, names in zip(results["tables"], shown, strict=True):
        blocks += [
            f"## {table['title']}",
            *([table["note"]] if table["note"] else []),
            _data(table),
            _seeds(table),
            _made(table["made"]),
            _rows(table),
        ]
        blocks += [f"![{table['title']}]({name})" for name in names]
        blocks += [*_tests(table), *_falls(table)]
    blocks += ["## Commands", *_commands(results)]
    return "\n\n".join(blocks) + "\n"


def _data(table: Mapping[str, Any]) -> str:
    told = [
        f"`{name}`: {spec['episodes']} of `{spec['task']}`, seeds from {spec['seed']} on"
        + "".join(f", `--{noise}={spec[noise]:g}`" for noise in ("perturb", "stray") if spec[noise])
        for name, spec in table["data"].items()
    ]
    return f"Demonstrations of the scripted expert: {'; '.join(told)}."


def _seeds(table: Mapping[str, Any]) -> str:
    told = [
        f"`{name}`: `{spec['task']}`, {spec['episodes']} seeds from {spec['seed']} on"
        + (f", `{' '.join(spec['options'])}`" if spec["options"] else "")
        + f" (the expert succeeds on {spec['episodes'] - table['rows'][0]['cells'][name][0]['n_expert_failures']})"
        for name, spec in table["evaluations"].items()
    ]
    return f"Evaluations: {'; '.join(told)}. Training seeds: {', '.join(map(str, table['training_seeds']))}."


def _made(made: Mapping[str, Any]) -> str:
    """What made a table, in sentences."""
    software = ", ".join(f"{name} {version}" for name, version in made["software"].items())
    return (
        f"Its steps took {made['hours']:.2g} hours, each with one thread, on {'; '.join(made['machines'])}. A step that tables "
        f"share counts in each of them. Evaluated with {software}."
    )


def _rows(table: Mapping[str, Any]) -> str:
    names, beside, published = table["evaluations"], table["beside"], table["published"]
    heads = ["policy", "trained on", "demonstrations", *_budget(table, None), "steps", "minutes of training"]
    heads += [head for name in names for head in (name, *(f"{name}: {BESIDE[key]}" for key in beside))]
    heads += [table["published_by"]] if published else []
    lines = []
    for row in table["rows"]:
        minutes = row["training_minutes"]
        spent = f"{min(minutes):.1f}" if len(minutes) == 1 else f"{min(minutes):.1f} to {max(minutes):.1f}"
        cells = [
            cell
            for name in names
            for cell in (_cell(row["cells"][name]), *(_mean(row["cells"][name], key) for key in beside))
        ]
        cells += [published.get(row["policy"], "")] if published else []
        lines.append(
            [f"`{row['policy']}`", row["data"], row["demonstrations"], *_budget(table, row), f"{row['steps']:,}", spent,
             *cells]
        )  # fmt: skip
    return markdown_table(heads, lines)


def _minutes(given: float | None) -> str:
    return "" if given is None else f"{given:g}"


def _cell(runs: Sequence[Mapping[str, Any]]) -> str:
    if len(runs) > 1:
        return str(TrainingSpread(tuple(run["n_success"] for run in runs), runs[0]["n_episodes"]))
    (run,) = runs
    low, high = run["pc_success_ci95"]
    return f"{run['n_success']} of {run['n_episodes']}: {run['pc_success']:.1f} ({low:.1f} to {high:.1f})"


def _mean(runs: Sequence[Mapping[str, Any]], name: str) -> str:
    """What each training has in the mean over episodes, to three digits, and the range over trainings if there are several."""
    found = [run[name] for run in runs if run[name] is not None]
    means = [value["mean"] if isinstance(value, Mapping) else value for value in found]
    if not means:
        return ""
    spread = f" ({min(means):.3g} to {max(means):.3g})" if len(means) > 1 else ""
    return f"{sum(means) / len(means):.3g}{spread}"


def _tests(table: Mapping[str, Any]) -> list[str]:
    if not table["tests"]:
        return []
    lines = [
        [f"`{test['policy']}`", test["data"], test["demonstrations"], *_both_minutes(table, test), test["evaluation"],
         *_difference(test)]
        for test in table["tests"]
    ]  # fmt: skip
    heads = ["policy", "trained on", "demonstrations", *_both_minutes(table, None), "evaluation", *_DIFFERENCE]
    caution = (
        "Few trainings show little of how trainings differ: such an interval is rather too narrow."
        if len(table["training_seeds"]) > 1
        else "One training of each tells two trained policies apart, not two methods."
    )
    told = f"Against `{table['against']}`, seed by seed: {_what_differs(table, table['tests'], 'pair of trainings')} {caution}"
    return [told, markdown_table(heads, lines)]


def _falls(table: Mapping[str, Any]) -> list[str]:
    if not table["falls"]:
        return []
    lines = [
        [f"`{fall['policy']}`", fall["data"], fall["demonstrations"], *_budget(table, fall), fall["evaluation"], fall["control"],
         *_difference(fall)]
        for fall in table["falls"]
    ]  # fmt: skip
    heads = ["policy", "trained on", "demonstrations", *_budget(table, None), "evaluation", "control", *_DIFFERENCE]
    told = (
        "What an event or a mishap does: each evaluation against its control, in which it does not happen. Both episodes of a "
        f"seed are the same, bit for bit, until then. The columns tell {_what_differs(table, table['falls'], 'training')}"
    )
    return [told, markdown_table(heads, lines)]


_DIFFERENCE = ("difference", "p", "differs")
"""Heads of the cells of :func:`_difference`."""


def _difference(test: Mapping[str, Any]) -> list[str]:
    """The difference with its interval, the adjusted p-values, and whether they show one."""
    (low, high), adjusted = test["pc_difference_ci95"], test["p_values_holm"]
    return [
        f"{test['pc_difference']:+.1f} ({low:+.1f} to {high:+.1f})",
        ", ".join("< 0.001" if p < 0.001 else f"{p:.2g}" for p in adjusted),
        "yes" if max(adjusted) < SIGNIFICANCE else "not shown",
    ]


def _what_differs(table: Mapping[str, Any], tests: Sequence[Mapping[str, Any]], each: str) -> str:
    """What :func:`_difference` tells, in words."""
    several = len(table["training_seeds"]) > 1
    interval = "two-level bootstrap over trainings and seeds" if several else "Newcombe, over seeds"
    count = sum(len(test["p_values"]) for test in tests)
    return (
        f"the difference in points with its 95 % interval ({interval}), p of McNemar's exact test for each {each}, adjusted by "
        f"Holm's method for these {count} tests, and whether all are below {SIGNIFICANCE}."
    )


def _budget(table: Mapping[str, Any], row: Mapping[str, Any] | None) -> list[str]:
    """The cell of the minutes given to a policy, or its heading; none in a table where no minutes are given."""
    if not any(each["minutes"] for each in table["rows"]):
        return []
    return [_minutes(row["minutes"])] if row else ["minutes given"]


def _both_minutes(table: Mapping[str, Any], test: Mapping[str, Any] | None) -> list[str]:
    """The same for the two policies of a test."""
    budget = _budget(table, test)
    return [*budget, _minutes(test["against_minutes"]) if test else "to the other"] if budget else []


def _commands(results: Mapping[str, Any]) -> list[str]:
    """The commands under the numbers, once each, and what stands for the folder of the results in them."""
    found: dict[str, None] = {}
    for table in results["tables"]:
        for row in table["rows"]:
            found |= dict.fromkeys(row["training_commands"])
            found |= dict.fromkeys(run["command"] for runs in row["cells"].values() for run in runs)
    told = "`STORE` is the folder of all results, `outputs/benchmark/store` unless `--store` names another."
    return [told, "```\n" + "\n".join(re.sub(_LISTED, _first_of, command) for command in found) + "\n```"]


def _first_of(listed: re.Match[str]) -> str:
    """The choice of the first demonstrations, in short."""
    numbers = json.loads(listed[1])
    return f"--dataset.episodes=[0,…,{numbers[-1]}]"
