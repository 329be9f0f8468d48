"""A benchmark's results as Markdown."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hdril.benchmark.matrix import BESIDE
from hdril.benchmark.results import SIGNIFICANCE
from hdril.evaluation.statistics import TrainingSpread
from hdril.markdown import table as markdown_table

_HELD_OUT = "No seed of an evaluation was trained on."
_UNUSED = "None is in `{}`, the list of seeds by which choices were made."
_TUNING = (
    "**This is for tuning.** No seed of an evaluation was trained on, but choices are made by these numbers: the best of them "
    "are better here than they will be on other seeds."
)


def markdown(results: Mapping[str, Any], pictures: Sequence[Sequence[str]] = ()) -> str:
    """The report, with links to the pictures of each table, if there are any."""
    blocks = [
        f"# Benchmark: {results['name']}",
        "Made by `hdril-benchmark`, one thread a step; the loader of a training may be a second process. Success is in percent, "
        "with the 95 % interval (Wilson) over the seeds for one trained policy. Several trainings are written as trainings × "
        "seeds: the mean, then the range and the standard deviation over trainings. "
        f"{' '.join(_about_seeds(results))} In the commands, `STORE` is the folder of all results, "
        "`outputs/benchmark/store` unless `--store` names another.",
        *_losses(results["tables"]),
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
        blocks += [*_by_primitive(table), *_tests(table), *_falls(table), _commands(table), *_failures(table)]
    return "\n\n".join(blocks) + "\n"


def _losses(tables: Sequence[Mapping[str, Any]]) -> list[str]:
    """Before all else: which policies are ahead of the one that a table compares with, and which events cost too much."""
    tests = [(table, test) for table in tables for test in table["tests"]]
    falls = [(table, fall) for table in tables for fall in table["falls"]]
    ahead = [_ahead(table, test) for table, test in tests if test["pc_difference"] > 0.0]
    costs = [_too_much(table, fall) for table, fall in falls if _costs(fall)]
    lines = [line for _, line in sorted([*ahead, *costs], key=lambda line: line[0])]
    if tests and not ahead:
        lines.append("No policy is ahead of the one that it is compared with.")
    if falls and not costs:
        lines.append("No event costs more than it may.")
    return ["## Who is ahead, and what costs too much", "\n".join(f"- {line}" for line in lines)] if lines else []


def _ahead(table: Mapping[str, Any], test: Mapping[str, Any]) -> tuple[int, str]:
    """Rank and words of a policy that succeeds more often than the one that it is compared with."""
    other = (
        ""
        if test["minutes"] == test["against_minutes"]
        else f", the other for {_minutes(test['against_minutes'])} minutes"
    )
    where = f"`{table['against']}` on {test['evaluation']} ({_trained_on(test)}{other}): {_difference(test)[0]} points"
    if test["differs"]:
        return 0, f"{table['title']}: `{test['policy']}` is better than {where}."
    return 1, f"{table['title']}: `{test['policy']}` is ahead of {where}; this may be chance."


def _costs(fall: Mapping[str, Any]) -> bool:
    """Whether success falls by more than it may, or might; without a margin, by more than chance."""
    if fall.get("margin"):
        return bool(fall["within"] != "yes")
    return bool(fall["differs"] and fall["pc_difference"] < 0.0)


def _too_much(table: Mapping[str, Any], fall: Mapping[str, Any]) -> tuple[int, str]:
    """Rank and words of an event after which success falls too much."""
    told = {
        "no": f"success falls by more than {fall.get('margin', 0):g} points",
        "not shown": f"it is not shown that success falls by at most {fall.get('margin', 0):g} points",
    }.get(fall.get("within", ""), "success falls")
    where = f"{table['title']}: `{fall['policy']}` on {fall['evaluation']} ({_trained_on(fall)})"
    return int(fall.get("within") == "not shown"), f"{where}: {told}: {_difference(fall)[0]}."


def _trained_on(row: Mapping[str, Any]) -> str:
    """How the policy of a row, a test or a fall was trained."""
    minutes = f" for {_minutes(row['minutes'])} minutes" if row["minutes"] else ""
    return f"trained{minutes} on {row['demonstrations']} of {row['data']}"


def _about_seeds(results: Mapping[str, Any]) -> list[str]:
    if results["tuning"]:
        return [_TUNING]
    return [_HELD_OUT, *([_UNUSED.format(results["used_seeds"])] if results["used_seeds"] else [])]


def _data(table: Mapping[str, Any]) -> str:
    counts = " and ".join(str(count) for count in sorted({row["demonstrations"] for row in table["rows"]}))
    told = [
        f"`{name}`: {counts} of `{spec['task']}`, seeds from {spec['seed']} on"
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
    commits = f", commit {' and '.join(made['commits'])}" if made.get("commits") else ""
    return (
        f"Its steps took {made['hours']:.2g} hours on {'; '.join(made['machines'])}{commits}. A step that tables share counts in "
        f"each of them. Evaluated with {software}."
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


def _by_primitive(table: Mapping[str, Any]) -> list[str]:
    """How far the hands are from the expert's, by the expert's primitive; nothing unless the table asks for it."""
    if not (phases := table.get("by_primitive")):
        return []
    lines = [
        [f"`{row['policy']}`", row["data"], row["demonstrations"], *_budget(table, row), name,
         *(_error(row["cells"][name], primitives) for primitives in phases.values())]
        for row in table["rows"] for name in table["evaluations"]
    ]  # fmt: skip
    lines += [
        [f"`{policy}`", "", "", *([""] if _budget(table, None) else []), "published",
         *(f"{told[phase]:g}" if phase in told else "" for phase in phases)]
        for policy, told in table["published_by_primitive"].items()
    ]  # fmt: skip
    heads = ["policy", "trained on", "demonstrations", *_budget(table, None), "evaluation", *phases]
    together = any(primitives != [phase] for phase, primitives in phases.items())
    listed = "; ".join(f"{phase}: {', '.join(primitives)}" for phase, primitives in phases.items())
    told = (
        "How far the hands are from the noise-free expert's, by the expert's primitive, cm: the mean over the seeds that the "
        "expert solves, without those whose episode ended before that primitive began. Several trainings: "
        "their mean and, in brackets, range." + (f" Primitives of a phase count alike: {listed}." if together else "")
    )
    return [told, markdown_table(heads, lines)]


def _error(runs: Sequence[Mapping[str, Any]], primitives: Sequence[str]) -> str:
    """The mean over ``primitives`` in each training that reached all of them; it is told if others did not."""
    errors = [run["position_error_cm_by_primitive"] for run in runs]
    reached = [error for error in errors if all(name in error for name in primitives)]
    means = [sum(error[name]["mean"] for name in primitives) / len(primitives) for error in reached]
    few = "" if len(reached) in (0, len(runs)) else f", {len(reached)} of {len(runs)} trainings"
    return _mean([{"error": mean} for mean in means], "error") + few


def _tests(table: Mapping[str, Any]) -> list[str]:
    if not table["tests"]:
        return []
    lines = [
        [f"`{test['policy']}`", test["data"], test["demonstrations"], *_both_minutes(table, test), test["evaluation"],
         *_difference(test)]
        for test in table["tests"]
    ]  # fmt: skip
    heads = ["policy", "trained on", "demonstrations", *_both_minutes(table, None), "evaluation", *_DIFFERENCE]
    told = f"Against `{table['against']}`, seed by seed: {_what_differs(table, table['tests'], 'pair of trainings')}"
    return [told, markdown_table(heads, lines)]


def _falls(table: Mapping[str, Any]) -> list[str]:
    if not table["falls"]:
        return []
    margin = table["falls"][0].get("margin")
    lines = [
        [f"`{fall['policy']}`", fall["data"], fall["demonstrations"], *_budget(table, fall), fall["evaluation"], fall["control"],
         *_difference(fall), *([fall["within"]] if margin else [])]
        for fall in table["falls"]
    ]  # fmt: skip
    heads = ["policy", "trained on", "demonstrations", *_budget(table, None), "evaluation", "control", *_DIFFERENCE]
    told = (
        "What an event or a mishap does: each evaluation against its control, in which it does not happen. Both episodes of a "
        f"seed are the same, bit for bit, until then. The columns tell {_what_differs(table, table['falls'], 'training')}"
    )
    if margin:
        heads.append(f"falls by at most {margin:g} points")
        told += (
            f" Falls by at most {margin:g} points: yes, the whole interval is at or above -{margin:g}; no, the whole interval is "
            "below; each row by itself."
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
        "yes" if test["differs"] else "not shown",
    ]


def _what_differs(table: Mapping[str, Any], tests: Sequence[Mapping[str, Any]], each: str) -> str:
    """What :func:`_difference` tells, in words."""
    several = len(table["training_seeds"]) > 1
    interval = (
        "the smallest that contains the two-level bootstrap's over trainings and seeds, Student's over trainings, and Newcombe's "
        "for one pair of trainings in the mean"
        if several
        else "Newcombe, over seeds"
    )
    count = sum(len(test["p_values"]) for test in tests)
    told = (
        f"the difference in points with its 95 % interval ({interval}), p of McNemar's exact test for each {each}, adjusted by "
        f"Holm's method for these {count} tests, and whether they differ: p is below {SIGNIFICANCE}"
        + (f" for each {each}, always in the same direction," if several else ",")
        + " and the interval is on one side of 0."
    )
    if not several:
        return f"{told} One training tells about a trained policy, not about a method."
    return f"{told} Few trainings show little of how trainings differ, so that their interval is wide."


def _budget(table: Mapping[str, Any], row: Mapping[str, Any] | None) -> list[str]:
    """The cell of the minutes given to a policy, or its heading; none in a table where no minutes are given."""
    if not any(each["minutes"] for each in table["rows"]):
        return []
    return [_minutes(row["minutes"])] if row else ["minutes given"]


def _both_minutes(table: Mapping[str, Any], test: Mapping[str, Any] | None) -> list[str]:
    """The same for the two policies of a test."""
    budget = _budget(table, test)
    return [*budget, _minutes(test["against_minutes"]) if test else "to the other"] if budget else []


LISTED = 5
"""Failed seeds of an evaluation that are listed."""


def _failures(table: Mapping[str, Any]) -> list[str]:
    """The first failed seeds of each evaluation, folded, and how to see why; nothing if none failed."""
    lines = []
    for row in table["rows"]:
        for name, runs in row["cells"].items():
            for run in (run for run in runs if run["failed_seeds"]):
                seeds = run["failed_seeds"]
                rest = f" and {len(seeds) - LISTED} more" if len(seeds) > LISTED else ""
                lines.append(
                    f"- `{row['policy']}` ({_trained_on(row)}, training seed {run['training_seed']}) on {name}, "
                    f"`{_folder(run['command'], '--output_dir=').parent}`: {', '.join(map(str, seeds[:LISTED]))}{rest}"
                )
    if not lines:
        return []
    told = (
        "A recording for Rerun shows how an episode failed: run the evaluation's command, above, with these options at its end, "
        "`--seed=SEED --num_episodes=1 --rerun=failures --output_dir=FOLDER`. All failed seeds are in the JSON beside this page. "
        "Who changes something after a look at them needs other seeds for the next report."
    )
    return [
        "<details><summary>Failed seeds of this table</summary>\n\n" + "\n".join([told, "", *lines]) + "\n\n</details>"
    ]


def _commands(table: Mapping[str, Any]) -> str:
    """The commands under a table's numbers, once each, folded."""
    found: dict[str, None] = {}
    for row in table["rows"]:
        runs = [run for cell in row["cells"].values() for run in cell]
        for run in runs:
            found |= dict.fromkeys(run["made_from"][kind]["command"] for kind in ("record", "train"))
        found |= dict.fromkeys(run["command"] for run in runs)
    return "<details><summary>Commands of this table</summary>\n\n```\n" + "\n".join(found) + "\n```\n\n</details>"


def _folder(command: str, option: str) -> Path:
    """The folder that a command gives to an option."""
    (folder,) = (word.removeprefix(option) for word in shlex.split(command) if word.startswith(option))
    return Path(folder)
