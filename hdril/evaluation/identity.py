"""What an evaluation is of: weights, scenes and software, so that results are never taken for those of another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from hdril.digest import SHORT
from hdril.evaluation.mishap import MISHAPS
from hdril.evaluation.software import evaluation_software
from hdril.tasks import DETAILED, base_name, get_task, task_parameters
from hdril.tasks.task import Variation

Values = Mapping[str, Any]


@dataclass(frozen=True)
class PolicyIdentity:
    """What decides a policy's actions. Where its files lie, and how they are called, is no part of it.

    The device is: kernels of another one round in another way, and an episode at the edge of success may end otherwise.
    """

    type: str
    weights: str
    """SHA-256 of ``model.safetensors``."""
    config: str
    """SHA-256 of the config as it is used, overrides included, as canonical JSON; without the device, and without
    repositories, tags and paths, which change no action."""
    processors: str
    """SHA-256 of the files of both processors."""
    device: str
    software: dict[str, str]

    @property
    def summary(self) -> str:
        """The type of the policy and the digests that tell it apart, for people."""
        return f"{self.type}, weights {self.weights[:SHORT]}, config {self.config[:SHORT]}"


@dataclass(frozen=True)
class TrialsIdentity:
    """What a policy was tried on: the same for any two that are compared."""

    task: str
    """Its name, without parameters."""
    parameters: dict[str, float]
    """Of the task, with the defaults of those that were not given; what of the scene is observed is left out, because policies
    that observe other things can be compared."""
    first_seed: int
    num_episodes: int
    max_frames: int
    """Frames after which an episode is cut."""
    software: dict[str, str]
    mishap: str = ""
    """What changes the policy's first actions, see :data:`hdril.evaluation.mishap.MISHAPS`; empty: nothing."""


@dataclass(frozen=True)
class Identity:
    """All that makes the results of an evaluation, the machine aside."""

    policy: PolicyIdentity
    trials: TrialsIdentity

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def identify_trials(
    task: str, first_seed: int, num_episodes: int, max_frames: int | None = None, mishap: str = ""
) -> TrialsIdentity:
    """The trials on a task's seeds from ``first_seed`` on; ``max_frames`` is the task's budget unless given. With a
    mishap, an episode may last as long as where something may happen: a grasp can be tried again.

    Raises:
        ValueError: there is no such task or mishap, or an episode would be cut before the task's horizon, where success is
            judged.
    """
    if mishap and mishap not in MISHAPS:
        raise ValueError(f"mishap must be {', '.join(MISHAPS)}, got {mishap!r}")
    spec = get_task(task)
    horizon, budget = spec.horizon, replace(spec, variation=Variation(any_event=1.0)).budget if mishap else spec.budget
    frames = budget if max_frames is None else max_frames
    if frames < horizon:
        raise ValueError(
            f"max_frames must be at least {horizon}, the horizon of {task}, from which on success is judged; got {frames}"
        )
    software = evaluation_software(base_name(task))
    parameters = {name: value for name, value in task_parameters(task).items() if name != DETAILED}
    return TrialsIdentity(base_name(task), parameters, first_seed, num_episodes, frames, software, mishap)


def _leaves(values: Values, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, path if name in ("policy", "trials", "software") else (*path, name))
        else:
            yield " ".join((*path, name)).replace("_", " "), value


def _shown(value: Any) -> str:
    text = str(value) or "none"
    return text[:SHORT] if len(text) == 64 and " " not in text else text


def differences(there: Values, here: Values) -> list[str]:
    """What differs between two identities, or the same part of two, as JSON has them: "weights (3f2a… there, 9c1b… here)".

    ``there`` is what was stored, ``here`` what is asked for now. An identity that is empty differs in everything.
    """
    stored, wanted = dict(_leaves(there)), dict(_leaves(here))
    names = [*wanted, *(name for name in stored if name not in wanted)]
    return [
        f"{name} ({_shown(stored.get(name, ''))} there, {_shown(wanted.get(name, ''))} here)"
        for name in names
        if stored.get(name, "") != wanted.get(name, "")
    ]


def require_same(what: str, there: Values | None, here: Values, remedy: str) -> None:
    """Refuse results that something else made.

    Args:
        what: names the stored results, as the subject of a sentence.
        there: their identity, or a part of it; None or empty if they have none.
        here: the same part of the identity that is asked for.
        remedy: what to do instead.

    Raises:
        ValueError: they differ; names in what.
    """
    if not there:
        raise ValueError(f"{what} has no record of what made its results (an older hdril wrote it); {remedy}")
    if found := differences(there, here):
        raise ValueError(f"{what} holds results of other {', '.join(found)}; {remedy}")
