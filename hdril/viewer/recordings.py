"""Episodes as Rerun files: which are kept, what they are called, and how they are written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hdril.digest import SHORT
from hdril.evaluation.evaluate import EvaluatedEpisode
from hdril.evaluation.score import Outcome
from hdril.files import naming
from hdril.viewer.keep import keeps

APPLICATION = "hdril"


@dataclass(frozen=True)
class RecordingWriter:
    """Writes the episodes that ``keep`` asks for into ``folder``: a sink for :func:`hdril.evaluation.evaluate.evaluate`.

    ``keep`` is ``none``, ``failures``, ``all``, or the number of episodes to keep from ``first_seed`` on.
    """

    folder: Path
    keep: str
    first_seed: int

    def __call__(self, episode: EvaluatedEpisode) -> None:
        if keeps(self.keep, episode.outcome.seed - self.first_seed, episode.outcome.success):
            write_recording(self.folder, episode)


def recording_name(outcome: Outcome) -> str:
    """A name that sorts by seed and says how the episode ended."""
    return f"seed_{outcome.seed:07d}_{'success' if outcome.success else 'failure'}"


def write_recording(folder: Path, episode: EvaluatedEpisode) -> Path:
    """Write ``<folder>/<recording_name>.rrd``. Times are seconds from the start of the episode."""
    name = recording_name(episode.outcome)
    return write_episodes(folder / f"{name}.rrd", name, {"": episode})


@contextmanager
def written(path: Path) -> Iterator[None]:
    """Let a recording that is streamed to ``path`` in this context be there whole, or not at all.

    Raises:
        OSError: it cannot be written.
    """
    try:
        yield
    except BaseException as error:
        try:
            if isinstance(error, RuntimeError):
                _raise_why(path)
            raise
        finally:
            path.unlink(missing_ok=True)


def _raise_why(path: Path) -> None:
    """Rerun does not say why it could not write. The system does, to whoever writes more."""
    with naming(path), path.open("ab") as file:
        file.write(bytes(2**20))


def write_episodes(path: Path, name: str, episodes: dict[str, EvaluatedEpisode]) -> Path:
    """Write one recording of several players' episodes of the same seed, side by side on one timeline.

    ``episodes`` are by the name of the player, with which its entities begin; a single one may have the name "". The worlds
    of their environments must still be open. The recording's properties say what played them, as JSON.

    Raises:
        OSError: the file cannot be written; nothing is left of it.
    """
    import rerun as rr  # here: whoever keeps no recording need not wait for it

    from hdril.viewer.blueprint import blueprint
    from hdril.viewer.log import EpisodeLog

    path.parent.mkdir(parents=True, exist_ok=True)
    env = next(iter(episodes.values())).env
    # The viewer takes recordings of the same id for parts of one: the same seed, played by other weights, is another one.
    players = [episode.identity.policy.weights[:SHORT] for episode in episodes.values() if episode.identity is not None]
    with written(path), rr.RecordingStream(APPLICATION, recording_id="-".join([env.task, name, *players])) as stream:
        stream.save(path, default_blueprint=blueprint(env, list(episodes)))
        stream.send_recording_name(name)
        for player, episode in episodes.items():
            if episode.identity is not None:
                stream.send_property(player or "policy", rr.AnyValues(identity=json.dumps(episode.identity.as_dict())))
            EpisodeLog(stream, episode, player).send()
    return path
