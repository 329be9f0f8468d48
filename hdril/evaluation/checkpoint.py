"""Checkpoints of policies: found once, checked before anything is made of them, and known by their content."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from contextlib import redirect_stderr
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hdril.digest import digest_file, digest_files, digest_json
from hdril.evaluation.identity import PolicyIdentity
from hdril.evaluation.overrides import ELSEWHERE, running_options
from hdril.evaluation.software import policy_software

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

CONFIG, WEIGHTS, TRAINING = "config.json", "model.safetensors", "train_config.json"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")


@dataclass(frozen=True)
class Checkpoint:
    """A policy's files. ``name`` is what the user called it, ``folder`` where the files are, links followed."""

    name: str
    folder: Path

    @property
    def weights(self) -> Path:
        return self.folder / WEIGHTS

    @property
    def processors(self) -> list[Path]:
        """The files of both processors: their steps, and the numbers that the steps keep."""
        files: list[Path] = []
        for name in PROCESSORS:
            path = self.folder / name
            steps = read_json(path).get("steps", [])
            files += [path, *(self.folder / step["state_file"] for step in steps if step.get("state_file"))]
        return files

    def read_config(self) -> dict[str, Any]:
        """``config.json`` as it stands."""
        return read_json(self.folder / CONFIG)


def read_json(path: Path) -> dict[str, Any]:
    """An object in a JSON file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged; names it.
    """
    try:
        values = json.loads(path.read_bytes())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold a JSON object, not a {type(values).__name__}")
    return values


def find_checkpoint(name: str) -> Checkpoint:
    """A checkpoint on this machine; one on the Hugging Face Hub is fetched, so that all who load it load the same files.

    ``checkpoints/last`` is a link that training moves: it is followed once, here.

    Raises:
        FileNotFoundError: there is none, or a file is missing.
        ValueError: a file is damaged.
        OSError: the Hub cannot be reached.
    """
    path = Path(name)
    if (path / CONFIG).exists():
        checkpoint = Checkpoint(name, path.resolve())
    else:
        looks_local = path.is_absolute() or path.parts[:1] in ((".",), ("..",)) or len(path.parts) != 2
        if looks_local or path.exists():
            raise FileNotFoundError(f"no checkpoint at {path}: it should be a folder with {CONFIG} and {WEIGHTS}")
        checkpoint = Checkpoint(name, _fetch(name))
    _check_files(checkpoint)
    return checkpoint


def find_again(name: str, folder: str) -> Checkpoint:
    """A checkpoint that was used before, from whatever folder the command runs in now.

    Args:
        name: what the user called it then; a relative path was relative to the folder of that command.
        folder: where its files were; empty if that was not recorded.

    Raises:
        As :func:`find_checkpoint`.
    """
    if not folder or not (Path(folder) / CONFIG).exists():
        return find_checkpoint(name)
    checkpoint = Checkpoint(name, Path(folder))
    _check_files(checkpoint)
    return checkpoint


def _fetch(repo_id: str) -> Path:
    """The folder of the newest revision of a model's repository, without its results and pictures."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        folder = snapshot_download(repo_id, allow_patterns=["*.safetensors", "*.json"], ignore_patterns=["eval/*"])
    except HFValidationError as error:
        raise ValueError(f"{repo_id!r} is neither a folder nor a repository of the Hub: {error}") from None
    except LocalEntryNotFoundError:
        raise FileNotFoundError(
            f"no checkpoint at {repo_id}, and the Hub cannot be asked for such a repository (offline, or no connection)"
        ) from None
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else "no answer"
        raise FileNotFoundError(f"no checkpoint at {repo_id}, here or on the Hub ({status})") from None
    if not (Path(folder) / CONFIG).exists():
        raise FileNotFoundError(f"the repository {repo_id} holds no policy: it has no {CONFIG}")
    return Path(folder)


def _check_files(checkpoint: Checkpoint) -> None:
    """Each file is there and whole."""
    from safetensors import SafetensorError, safe_open

    checkpoint.read_config()
    for name in (WEIGHTS, *PROCESSORS):
        if not (checkpoint.folder / name).is_file():
            raise FileNotFoundError(f"the checkpoint {checkpoint.name} is incomplete: {name} is missing")
    for path in (checkpoint.weights, *checkpoint.processors):
        if path.suffix != ".safetensors":
            continue
        if not path.is_file():
            raise FileNotFoundError(f"the checkpoint {checkpoint.name} is incomplete: {path.name} is missing")
        try:
            with safe_open(path, "numpy"):
                pass
        except SafetensorError as error:
            raise ValueError(f"{path} is not a whole safetensors file: download or save it again ({error})") from None


def resolve_config(checkpoint: Checkpoint, overrides: Iterable[str] = (), device: str = "cpu") -> PreTrainedConfig:
    """The config that a checkpoint is used with: the saved one, and what ``overrides`` (``--name=value``) change of it.

    Raises:
        ValueError: an unknown type of policy, an unknown option, an option that cannot change an evaluation, an invalid
            value, or a device that is not there.
    """
    import draccus
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    known = PreTrainedConfig.get_known_choices()
    kind = checkpoint.read_config().get("type")
    if kind not in known:
        raise ValueError(
            f"{checkpoint.folder / CONFIG} is of a policy of the type {kind!r}; installed: {', '.join(sorted(known))}"
        )
    given = list(overrides)
    _check_options(kind, known[kind], given)
    complaint = io.StringIO()  # argparse prints all options before it says what is wrong
    try:
        with redirect_stderr(complaint):
            config = PreTrainedConfig.from_pretrained(checkpoint.folder, cli_overrides=[*given, f"--device={device}"])
    except SystemExit:
        reason = complaint.getvalue().strip().splitlines()[-1].partition("error: ")[2]
        raise ValueError(f"the policy's config cannot be made: {reason.replace('--', 'policy.')}") from None
    except draccus.utils.DraccusException as error:
        # A value that cannot be read names its option; what the config's own check says is wrapped.
        reason = error if isinstance(error, draccus.utils.DecodingError) else error.__cause__ or error
        raise ValueError(f"the config of {checkpoint.name} cannot be made: {' '.join(str(reason).split())}") from error
    if config.device != device:
        raise ValueError(f"the device {device!r} is not available here; torch offers {config.device!r}")
    return config


def _check_options(kind: str, config_class: type[PreTrainedConfig], overrides: list[str]) -> None:
    known = {entry.name for entry in fields(config_class)}
    usable = running_options(config_class)
    for override in overrides:
        name, equals, _ = override.removeprefix("--").partition("=")
        option = name.partition(".")[0]
        if option not in known:
            raise ValueError(f"{kind} has no option policy.{option}; it has: {', '.join(usable)}")
        if not equals:
            raise ValueError(f"policy.{name} must be given with its value, as --policy.{name}=VALUE")
        if option not in usable:
            raise ValueError(f"policy.{option} cannot change an evaluation; what can: {', '.join(usable)}")


def identify(checkpoint: Checkpoint, config: PreTrainedConfig) -> PolicyIdentity:
    """What decides the actions of a checkpoint that is used with ``config``."""
    import draccus
    from lerobot.policies.factory import get_policy_class

    values = draccus.encode(config)
    for name in (*ELSEWHERE, "device"):
        values.pop(name, None)
    return PolicyIdentity(
        type=config.type,
        weights=digest_file(checkpoint.weights),
        config=digest_json(values),
        processors=digest_files(checkpoint.processors),
        device=str(config.device),
        software=policy_software(get_policy_class(config.type)),
    )
