"""Mutation testing: change one line at a time in the code that makes published numbers, and count what tests notice.

python scripts/mutants.py                     a fixed sample of 200; writes docs/reference/mutants.md and docs/mutants.json
python scripts/mutants.py --seed=1 --size=50  another sample, which is only printed
python scripts/mutants.py --again             after tests were added: only the mutants of the last run that no test noticed

The tool is mutmut; ``[tool.mutmut]`` in pyproject.toml says which files it changes and which tests it runs. mutmut wants all
sources in one folder ``src``, and this repository has two: so it works on a copy, in ``outputs/mutants``. Each mutant runs the
tests that call the changed function, the fastest first, until one fails.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import chdir
from dataclasses import asdict, dataclass
from pathlib import Path

from tabulate import tabulate

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("hdril", "policies/lerobot_policy_hdril/src/lerobot_policy_hdril")
ALSO = ("tests", "configs", "pyproject.toml")
"""What the tests need beside the sources."""
CLOCK = "minutes"
"""A file in the copy: how long the runs on it have taken, minutes."""
REPORT, RESULTS = ROOT / "docs/reference/mutants.md", ROOT / "docs/mutants.json"
SEED, SIZE, REQUIRED = 11, 200, 0.85
NOTICED = frozenset({"killed", "timeout", "segfault"})
"""mutmut's words for a mutant that tests notice: a test fails, never ends, or the interpreter crashes."""


@dataclass(frozen=True)
class Mutant:
    """One changed line and what became of it."""

    name: str
    status: str
    seconds: float
    diff: str = ""
    """Of those that no test noticed."""

    @property
    def module(self) -> str:
        return self.name.partition(".x")[0]

    @property
    def noticed(self) -> bool:
        return self.status in NOTICED


def stage(folder: Path) -> None:
    """A copy of the working tree in the layout that mutmut wants. What was in ``folder`` is deleted."""
    shutil.rmtree(folder, ignore_errors=True)
    without = shutil.ignore_patterns("__pycache__")
    for source in SOURCES:
        shutil.copytree(ROOT / source, folder / "src" / Path(source).name, ignore=without)
    for name in ALSO:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=without)
        else:
            shutil.copy2(ROOT / name, folder / name)


def stage_tests(folder: Path) -> None:
    """Bring the tests of a copy up to date.

    Raises:
        ValueError: the sources are not those of the copy, so what was found of them does not hold any more.
    """
    for source in SOURCES:
        for file in sorted((ROOT / source).rglob("*.py")):
            copy = folder / "src" / Path(source).name / file.relative_to(ROOT / source)
            if not copy.is_file() or copy.read_bytes() != file.read_bytes():
                raise ValueError(f"{file.relative_to(ROOT)} is not as it was in the last run; run all mutants")
    for place in (folder / "tests", folder / "mutants/tests"):
        shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))


def mutant_names(folder: Path) -> list[str]:
    """All mutants that mutmut makes of the staged sources, in order."""
    with chdir(folder):
        from mutmut.mutation.file_mutation import mutate_file_contents
        from mutmut.utils.file_utils import walk_mutatable_files
        from mutmut.utils.format_utils import get_mutant_name

        return sorted(
            get_mutant_name(path, name)
            for path in walk_mutatable_files()
            for name in mutate_file_contents(str(path), path.read_text()).mutant_names
        )


def environment(folder: Path) -> dict[str, str]:
    """Of mutmut: one thread a process, because it forks; a dataset that all processes share."""
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    return os.environ | threads | {"HF_HUB_OFFLINE": "1", "HDRIL_TEST_DATASET": str(folder / "dataset")}


def run_mutants(folder: Path, names: Iterable[str], processes: int) -> None:
    """Run mutmut on these mutants; it leaves its results in ``folder``."""
    command = [str(Path(sys.executable).with_name("mutmut")), "run", f"--max-children={processes}", *names]
    subprocess.run(command, cwd=folder, env=environment(folder), check=True)


def read_mutants(folder: Path, names: Iterable[str]) -> list[Mutant]:
    """What became of these mutants."""
    with chdir(folder):
        from mutmut.mutation.data import SourceFileMutationData
        from mutmut.mutation.diff_apply import get_diff_for_mutant
        from mutmut.stats import status_by_exit_code
        from mutmut.utils.file_utils import walk_mutatable_files

        found: dict[str, Mutant] = {}
        for path in walk_mutatable_files():
            data = SourceFileMutationData(path=path)
            data.load()
            for name in data.exit_code_by_key.keys() & set(names):
                status = status_by_exit_code[data.exit_code_by_key[name]]
                diff = "" if status == "killed" else changed_lines(get_diff_for_mutant(name, path=path))
                found[name] = Mutant(name, status, data.durations_by_key.get(name, 0.0), diff)
    return [found[name] for name in names]


def changed_lines(diff: str) -> str:
    """The lines of a unified diff that were removed and added, without indentation."""
    lines = [line for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


def share(mutants: list[Mutant]) -> float:
    """Of mutants that tests notice."""
    return sum(mutant.noticed for mutant in mutants) / len(mutants)


def summary(mutants: list[Mutant], total: int, seed: int, minutes: float) -> str:
    counts = ", ".join(f"{count} {status}" for status, count in Counter(m.status for m in mutants).most_common())
    return (
        f"Tests notice {100 * share(mutants):.1f} % of {len(mutants)} mutants ({counts}), drawn from {total} with seed {seed}, "
        f"in {minutes:.0f} minutes."
    )


def by_module(mutants: list[Mutant]) -> str:
    """A Markdown table: module, mutants drawn, mutants noticed."""
    modules = sorted({mutant.module for mutant in mutants})
    groups = [[mutant for mutant in mutants if mutant.module == module] for module in modules]
    rows = [
        (f"`{module}`", len(group), sum(m.noticed for m in group))
        for module, group in zip(modules, groups, strict=True)
    ]
    return tabulate(rows, ("module", "drawn", "noticed"), tablefmt="github")


INTRODUCTION = """\
# Mutation tests

A mutant is the code with one small change: `+` for `-`, `<` for `<=`, a number plus one, an argument left out, a text altered.
A test suite is as good as the share of mutants that make a test fail. `make mutants` draws a fixed, seeded sample from all
mutants of the code that makes published numbers (`[tool.mutmut]` in `pyproject.toml` lists the files), runs the fast tests
against each with [mutmut](https://mutmut.readthedocs.io), and prints the share. It must be at least {required:.0f} %.

The sample is uniform over all mutants of these files: texts of messages and reports count as much as formulas. No mutant is left
out by hand, and no line of code is marked as not to be mutated. One file of these folders is left out: `evaluation/picture.py`,
the arguments of a drawing. mutmut itself changes no decorated functions (properties, `@torch.no_grad()`), no decorators, no type
annotations and no code outside functions. Mutants that cannot change behaviour are among the survivors.

The sample depends on the seed and on the code: another version of the code has other mutants, and so another sample.
"""


def write_report(mutants: list[Mutant], total: int, seed: int, minutes: float) -> None:
    """The report as Markdown, and the same as JSON."""
    survivors = [mutant for mutant in mutants if mutant.status != "killed"]
    listed = [f"`{mutant.name}`: {mutant.status}\n\n```diff\n{mutant.diff}\n```\n" for mutant in survivors]
    parts = [
        INTRODUCTION.format(required=100 * REQUIRED),
        f"## Result\n\n{summary(mutants, total, seed, minutes)}\n\n{by_module(mutants)}\n",
        "## Mutants that no test killed\n\nThose with `timeout` made a test run without end, which counts as noticed.\n",
        *listed,
    ]
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    REPORT.write_text("\n".join(parts))
    results = {"seed": seed, "total": total, "share": share(mutants), "minutes": round(minutes, 1)}
    rows = [{**asdict(mutant), "seconds": round(mutant.seconds, 2)} for mutant in mutants]
    RESULTS.write_text(json.dumps(results | {"mutants": rows}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--size", type=int, default=SIZE, help="mutants to draw")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="only those that no test noticed in the last run")
    parser.add_argument(
        "--folder", type=Path, default=ROOT / "outputs/mutants", help="for the copy; it is deleted first"
    )
    options = parser.parse_args()
    began = time.monotonic()
    try:
        stage_tests(options.folder) if options.again else stage(options.folder)
    except ValueError as error:
        sys.exit(f"mutants: {error}")
    names = mutant_names(options.folder)
    drawn = sorted(random.Random(options.seed).sample(names, options.size))
    left = [m.name for m in read_mutants(options.folder, drawn) if not m.noticed] if options.again else drawn
    if left:
        run_mutants(options.folder, left, options.processes)
    mutants = read_mutants(options.folder, drawn)
    clock = options.folder / CLOCK
    minutes = (time.monotonic() - began) / 60 + (float(clock.read_text()) if options.again else 0.0)
    clock.write_text(str(minutes))
    for mutant in mutants:
        if mutant.status != "killed":
            print(f"\n{mutant.name}: {mutant.status}\n{mutant.diff}")
    print(f"\n{summary(mutants, len(names), options.seed, minutes)}")
    if (options.seed, options.size) == (SEED, SIZE):
        write_report(mutants, len(names), options.seed, minutes)
    if share(mutants) < REQUIRED:
        sys.exit(f"mutants: at least {100 * REQUIRED:.0f} % must be noticed")


if __name__ == "__main__":
    main()
