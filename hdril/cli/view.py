"""hdril-view: recordings of evaluations and of datasets in Rerun."""

from __future__ import annotations

import os
import shlex
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from hdril.cli.common import run
from hdril.errors import UserError
from hdril.evaluation.stored import read_evaluation
from hdril.viewer.episodes import compare, find_recordings, replay, show_dataset

MADE = Path("outputs/view")


@dataclass
class ViewConfig:
    """Open episodes in Rerun: those that an evaluation recorded (--run), any of its seeds (--seed), two policies on the
    same seed side by side (--against), or an episode of a dataset with its labels (--dataset).

    On a machine without a display, --web serves them for a browser, and --save writes a file to open elsewhere.
    """

    run: Path | None = None
    """Folder that hdril-eval wrote (its output_dir)."""
    against: Path | None = None
    """Folder of another evaluation, of the same task: both policies play the seed, and are shown side by side."""
    seed: int | None = None
    """Seed of the episode. One that was not recorded is played again, if the checkpoint is still the one that was evaluated.
    Default: all that were recorded."""
    dataset: Path | None = None
    """Root of a LeRobot dataset."""
    episode: int = 0
    """Episode of the dataset."""
    save: Path | None = None
    """Write the recording to this file instead of opening it; must not exist."""
    web: bool = False
    """Serve Rerun's viewer for a browser, until Ctrl-C."""
    bind: str = "127.0.0.1"
    """Address that --web listens on; 0.0.0.0 lets other machines in."""
    port: int = 9090
    """Port of the web viewer; the recordings come from the next one."""


def _check(config: ViewConfig) -> None:
    if (config.run is None) == (config.dataset is None):
        raise ValueError("give either --run (an evaluation) or --dataset")
    if config.against is not None and (config.run is None or config.seed is None):
        raise ValueError("--against compares with --run on one seed: give --run and --seed")
    if config.seed is not None and config.seed < 0:
        raise ValueError(f"seed must be at least 0, got {config.seed}")
    if config.save is not None and config.save.exists():
        raise FileExistsError(f"{config.save} exists; choose another file or delete it")
    if config.save is not None and config.save.suffix != ".rrd":
        raise ValueError(f"--save must end in .rrd, got {config.save}")


def recordings(config: ViewConfig) -> list[Path]:
    """The files to show; makes those that are not there."""
    if config.dataset is not None:
        made = config.save or MADE / f"{config.dataset.name}_episode_{config.episode:06d}.rrd"
        path, line = show_dataset(config.dataset, config.episode, made)
        print(f"Episode {config.episode}: {line}")
        return [path]
    assert config.run is not None
    evaluation, against = read_evaluation(config.run), config.against and read_evaluation(config.against)
    if config.seed is not None:
        for played in (evaluation, against):
            if played is not None:
                played.require_seed(config.seed)
    if against is not None and config.seed is not None:
        made = config.save or MADE / f"compare_seed_{config.seed:07d}.rrd"
        return [compare(evaluation, against, config.seed, made)]
    found = find_recordings(config.run, config.seed)
    if not found and config.seed is None:
        results = evaluation.results
        raise FileNotFoundError(
            f"{config.run} holds no recordings; show any of its seeds, {results['first_seed']} to "
            f"{results['first_seed'] + results['n_episodes'] - 1}, with --seed, or evaluate with --rerun=all"
        )
    if not found and config.seed is not None:
        print(f"Seed {config.seed} was not recorded: playing it again")
        path, changed = replay(evaluation, config.seed, config.save or MADE / f"seed_{config.seed:07d}.rrd")
        if changed:
            print(f"Note: the episode may differ from the one that was evaluated: other {', '.join(changed)}.")
        return [path]
    if config.save is None:
        return found
    config.save.parent.mkdir(parents=True, exist_ok=True)
    if len(found) == 1:
        shutil.copyfile(found[0], config.save)
    else:
        _rerun("rrd", "merge", *map(str, found), "-o", str(config.save), quiet=True)
    return [config.save]


def _rerun(*arguments: str, quiet: bool = False) -> None:
    program = Path(sys.executable).with_name("rerun")
    output = subprocess.DEVNULL if quiet else None
    code = subprocess.run([program, *arguments], check=False, stdout=output, stderr=output).returncode
    if code:
        raise UserError(f"rerun {arguments[0]} ended with exit code {code}")


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def view_command(config: ViewConfig) -> None:
    _check(config)
    files = [str(path) for path in recordings(config)]
    if config.save is not None:
        print(f"Saved: {config.save}\nOpen it with: rerun {shlex.quote(str(config.save))}")
    elif config.web:
        host = socket.gethostname() if config.bind == "0.0.0.0" else config.bind
        source = quote(f"rerun+http://{host}:{config.port + 1}/proxy", safe="")
        print(f"Open http://{host}:{config.port}/?url={source}", flush=True)
        print(f"From another machine first: ssh -L {config.port}:127.0.0.1:{config.port} "
              f"-L {config.port + 1}:127.0.0.1:{config.port + 1} <this machine>; Ctrl-C ends it", flush=True)  # fmt: skip
        _rerun("--web-viewer", "--bind", config.bind, "--web-viewer-port", str(config.port),
               "--port", str(config.port + 1), *files)  # fmt: skip
    elif has_display():
        _rerun(*files)
    else:
        print("There is no display here. Copy and open elsewhere:")
        print(f"  rerun {shlex.join(files)}")
        print("or show them in a browser: add --web")


def main() -> None:
    """Entry point."""
    run("hdril-view", ViewConfig, view_command)


if __name__ == "__main__":
    main()
