"""What other packages add: a registry is the built-in entries of one kind, and those of an entry-point group."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol


class PluginError(ValueError):
    """An entry of another package that cannot be used, and why."""


class Named(Protocol):
    @property
    def name(self) -> str: ...


class Registry[T: Named](Mapping[str, T]):
    """Entries by name: the built-in ones, then those that installed packages declare in an entry-point group.

    The name of an entry point is the name of its entry. Listing the names imports no plugin; a plugin is imported when its
    entry is asked for, so a broken one stops nobody else.

    Args:
        kind: what an entry is called in messages, such as ``task``.
        group: the entry-point group, such as ``hdril.tasks``.
        built_in: the sources of the built-in entries, by name. A source is what an entry point loads.
        read: the entry of a source. If the source holds none, it raises TypeError: what the source is, then what was expected.
    """

    def __init__(self, kind: str, group: str, built_in: Mapping[str, Any], read: Callable[[Any], T]) -> None:
        self._kind, self._group, self._built_in, self._read = kind, group, built_in, read
        self._loaded: dict[str, Any] = {}

    @cached_property
    def _plugins(self) -> dict[str, list[EntryPoint]]:
        found: dict[str, list[EntryPoint]] = {}
        for entry_point in entry_points(group=self._group):
            found.setdefault(entry_point.name, []).append(entry_point)
        return dict(sorted(found.items()))

    def __iter__(self) -> Iterator[str]:
        yield from self._built_in
        yield from (name for name in self._plugins if name not in self._built_in)

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._built_in or name in self._plugins

    def __getitem__(self, name: str) -> T:
        return self._read(self.source(name))

    def find(self, name: str) -> T:
        """The entry of that name.

        Raises:
            ValueError: there is no such entry; lists the names. :class:`PluginError` as :meth:`source` raises it.
        """
        if name not in self:
            raise ValueError(f"unknown {self._kind} {name!r}; choose from: {', '.join(self)}")
        return self[name]

    def source(self, name: str) -> Any:
        """What defines the entry: the object that the entry point loads.

        Raises:
            KeyError: there is no entry of that name.
            PluginError: two packages claim the name, or the plugin cannot be imported, or it is something else than an entry:
                one line that names the distribution, the entry point and what was expected.
        """
        claims = self._plugins.get(name, [])
        if len(claims) + (name in self._built_in) > 1:
            owners = ["hdril itself"] * (name in self._built_in) + sorted(_origin(claim) for claim in claims)
            raise PluginError(f"two {self._kind}s are named {name!r}: one is from {', another from '.join(owners)}")
        if name in self._built_in:
            return self._built_in[name]
        if name not in self._loaded:
            if not claims:
                raise KeyError(f"no {self._kind} {name!r}; {self._kind}s: {', '.join(self)}")
            self._loaded[name] = self._load(claims[0])
        return self._loaded[name]

    def _load(self, entry_point: EntryPoint) -> Any:
        claimed = f"the {self._kind} {entry_point.name!r} from {_origin(entry_point)}"
        try:
            source = entry_point.load()
        except (Exception, SystemExit) as error:  # whatever a stranger's module raises
            raise PluginError(f"{claimed} cannot be loaded: {_one_line(f'{type(error).__name__}: {error}')}") from error
        try:
            entry = self._read(source)
        except Exception as error:  # whatever a stranger's object raises when it is looked at
            reason = str(error) if type(error) is TypeError else f"{type(error).__name__}: {error}"
            raise PluginError(f"{claimed} cannot be used: {_one_line(reason)}") from error
        if entry.name != entry_point.name:
            raise PluginError(
                f"the {self._kind} from {_origin(entry_point)} is named {entry.name!r}; "
                f"the entry point must have the same name, not {entry_point.name!r}"
            )
        return source


def _origin(entry_point: EntryPoint) -> str:
    """The distribution and the entry point, for messages."""
    distribution = entry_point.dist
    owner = f"{distribution.name} {distribution.version}" if distribution else "an unknown distribution"
    return f"{owner} (entry point {entry_point.group}: {entry_point.name} = {entry_point.value})"


def _one_line(reason: str, longest: int = 200) -> str:
    """The reason without line breaks. Of a long one, such as the ``repr`` of a whole task, the middle is left out."""
    line = " ".join(reason.split())
    return line if len(line) <= longest else f"{line[: longest // 2]} … {line[-longest // 2 :]}"
