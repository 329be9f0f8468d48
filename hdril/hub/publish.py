"""Publishing on the Hugging Face Hub: all files in one commit, retried where that helps, and plain words where not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, hf_hub_download
from huggingface_hub.constants import is_offline_mode
from huggingface_hub.errors import (
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RemoteEntryNotFoundError,
    RepositoryNotFoundError,
)

from hdril.errors import UserError

WAITS = (1.0, 4.0, 15.0)
"""Seconds before each repetition."""
LONGEST_WAIT = 120.0
"""A server that asks to wait longer than this, s, is told of instead."""
_PASSING = {408, 409, 412, 425, 429, 500, 502, 503, 504}
_MEANING = {
    400: "it refused the content",
    401: "not logged in: run `hf auth login`, or set HF_TOKEN",
    403: "the token may not write there",
    404: "no such repository, or the token may not see it",
    409: "somebody else is writing to it",
    412: "somebody else has changed it since it was read",
    413: "it is too large",
    429: "too many requests",
}


_ERRORS = (HfHubHTTPError, httpx.TransportError, LocalTokenNotFoundError, LocalEntryNotFoundError, OfflineModeIsEnabled)


class HubError(UserError):
    """The Hub could not be reached, or refused."""


@dataclass(frozen=True)
class Head:
    """The newest revision of a repository, and the files in it."""

    revision: str
    files: tuple[str, ...]


def _explain(error: BaseException) -> str:
    if isinstance(error, HfHubHTTPError) and error.response is not None:
        code = error.response.status_code
        return f"the Hub says {code}, {_MEANING.get(code, 'an error on its side' if code >= 500 else 'refused')}"
    if isinstance(error, LocalTokenNotFoundError):
        return _MEANING[401]
    if isinstance(error, OfflineModeIsEnabled):
        return "offline mode is on: unset HF_HUB_OFFLINE"
    if isinstance(error, httpx.TimeoutException):
        return "it did not answer in time"
    return f"the connection failed ({error or type(error).__name__})"


def _pause(error: BaseException, wait: float, passing: set[int]) -> float | None:
    """Seconds to wait before another try; None if another would not help."""
    if isinstance(error, HfHubHTTPError) and error.response is not None:
        if error.response.status_code not in passing:
            return None
        asked = error.response.headers.get("retry-after", "")
        wait = max(wait, float(asked)) if asked.isdigit() else wait
        return wait if wait <= LONGEST_WAIT else None
    return wait if isinstance(error, httpx.TransportError) else None


def _try[T](step: Callable[[], T], what: str, so_far: str, passing: set[int] = _PASSING) -> T:
    """Do a step of publishing, again after errors that pass: those of the connection, and answers in ``passing``.

    Raises:
        HubError: it cannot be done; says why, and ``so_far``: what is on the Hub already.
    """
    for wait in (*WAITS, None):
        try:
            return step()
        except _ERRORS as error:
            pause = None if wait is None else _pause(error, wait, passing)
            if pause is None:
                raise HubError(f"could not {what}: {_explain(error)}. {so_far}") from error
            print(f"Could not {what}: {_explain(error)}; trying again in {pause:.0f} s", flush=True)
            time.sleep(pause)
        except RuntimeError as error:  # sending a large file, after the library's own repetitions
            raise HubError(f"could not {what}: {error} {_explain(error.__cause__ or error)}. {so_far}") from error
        except HFValidationError as error:
            raise HubError(f"could not {what}: {error}. {so_far}") from error
    raise AssertionError("unreachable")


def publish(
    repo_id: str,
    repo_type: str,
    files: dict[str, Path | bytes],
    message: str,
    private: bool,
    tag: str | None = None,
    head: Head | None = None,
    remove: Iterable[str] = (),
) -> str:
    """Put files into a repository, which is made if it is not there, in one commit: all of them appear, or none.

    The contents of large files are sent before the commit. After a broken connection the same call sends only those
    that are not there yet.

    Args:
        repo_id: user/name.
        repo_type: ``dataset`` or ``model``.
        files: path in the repository to a file or its content.
        message: of the commit.
        private: whether a new repository is private; an existing one stays as it is.
        tag: put on the commit, and moved there if it exists.
        head: what the commit builds on: if the repository is at another revision by then, nothing is published.
        remove: paths of files that go away in the same commit.

    Returns:
        The address of the repository.

    Raises:
        HubError: what failed, why, and what is on the Hub nevertheless.
    """
    api = HfApi()
    nothing = "Nothing was published; the same command tries again."
    _try(
        lambda: api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True),
        f"make the {repo_type} repository {repo_id}",
        nothing,
    )
    operations = [
        *(
            CommitOperationAdd(path, content if isinstance(content, bytes) else str(content))
            for path, content in sorted(files.items())
        ),
        *(CommitOperationDelete(path) for path in remove),
    ]
    parent = None if head is None else head.revision
    empty = f"The repository {repo_id} exists, without these files; the same command goes on."
    commit = _try(
        lambda: api.create_commit(
            repo_id, operations, commit_message=message, repo_type=repo_type, parent_commit=parent
        ),
        f"upload to {repo_id}",
        empty,
        _PASSING if parent is None else _PASSING - {412},
    )
    if tag is not None:
        done = f"The files are published; only the tag {tag} is missing: the same command sets it."

        def move_tag() -> None:
            present = api.list_repo_refs(repo_id, repo_type=repo_type).tags
            if any(ref.name == tag for ref in present):
                api.delete_tag(repo_id, tag=tag, repo_type=repo_type)
            api.create_tag(repo_id, tag=tag, revision=commit.oid, repo_type=repo_type)

        _try(move_tag, f"set the tag {tag} of {repo_id}", done)
    return str(commit.repo_url)


def read_head(repo_id: str) -> Head | None:
    """What a model's repository holds now; None if there is no such repository, or none that the token may see.

    Raises:
        HubError: the Hub cannot be reached, or refuses.
    """

    def ask() -> Head | None:
        try:
            info = HfApi().model_info(repo_id)
        except RepositoryNotFoundError:
            return None
        return Head(info.sha or "", tuple(file.rfilename for file in info.siblings or ()))

    return _try(ask, f"read {repo_id}", "Nothing was published; the same command tries again.")


def download(repo_id: str, path: str, repo_type: str, revision: str | None = None) -> Path | None:
    """A file of a repository, in the local cache; None if there is none, or no such repository.

    Args:
        repo_id: user/name.
        path: of the file in it.
        repo_type: ``dataset`` or ``model``.
        revision: a commit; the newest unless given.

    Raises:
        HubError: the Hub cannot be reached, or refuses.
    """

    def fetch() -> Path | None:
        try:
            return Path(hf_hub_download(repo_id, path, repo_type=repo_type, revision=revision))
        except (RemoteEntryNotFoundError, RepositoryNotFoundError):
            return None

    # Checked first: offline, the download says only that the file is not in the cache.
    if is_offline_mode():
        raise HubError(f"could not read {path} of {repo_id}: {_explain(OfflineModeIsEnabled())}")
    return _try(fetch, f"read {path} of {repo_id}", "Nothing was published; the same command tries again.")


def read_text(repo_id: str, path: str, repo_type: str, revision: str | None = None) -> str | None:
    """A text file of a repository; None if there is none. Arguments and errors are those of :func:`download`."""
    file = download(repo_id, path, repo_type, revision)
    return None if file is None else file.read_text()
