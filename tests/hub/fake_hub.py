"""A Hugging Face Hub in memory, behind httpx: what pushing and loading need of it, and faults on demand."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import dataclass, field

import httpx


@dataclass
class Repository:
    private: bool
    files: dict[str, bytes] = field(default_factory=dict)
    commits: int = 0
    tags: dict[str, str] = field(default_factory=dict)

    @property
    def revision(self) -> str:
        return hashlib.sha1(str(self.commits).encode()).hexdigest()


@dataclass
class FakeHub:
    """Repositories by (type, name). ``faults`` are answers, or errors to raise, by route (create, preupload, commit, …); each
    request of the route uses one up."""

    repositories: dict[tuple[str, str], Repository] = field(default_factory=dict)
    faults: dict[str, list[int | Exception]] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    blobs: dict[str, bytes] = field(default_factory=dict)
    large: int = 1 << 40
    """Files from this size on go through LFS."""

    def client(self) -> httpx.Client:
        return httpx.Client(transport=httpx.MockTransport(self.answer), follow_redirects=True)

    def answer(self, request: httpx.Request) -> httpx.Response:
        route, response = self._route(request)
        self.requests.append(route)
        if self.faults.get(route):
            fault = self.faults[route].pop(0)
            if isinstance(fault, Exception):
                raise fault
            return httpx.Response(fault, json={"error": "as asked for"}, request=request)
        return response()

    def _route(self, request: httpx.Request):
        path, method = request.url.path, request.method
        body = request.content
        if path == "/api/repos/create":
            return "create", lambda: self._create(json.loads(body))
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            return "batch", lambda: self._batch(request, json.loads(body))
        if found := re.fullmatch(r"/blob/(\w+)", path):
            return "blob", lambda: self._keep(found[1], body)
        if found := re.fullmatch(r"/api/(models|datasets)/([^/]+/[^/]+)(/.*)?", path):
            kind, name, rest = found[1].removesuffix("s"), found[2], found[3] or ""
            repository = self.repositories.get((kind, name))
            if repository is None:
                return "unknown", lambda: self._missing("RepoNotFound")
            if rest.startswith("/preupload/"):
                return "preupload", lambda: self._preupload(json.loads(body))
            if rest.startswith("/commit/"):
                return "commit", lambda: self._commit(kind, name, repository, body)
            if rest.startswith("/refs"):
                tags = [{"name": t, "ref": f"refs/tags/{t}", "targetCommit": r} for t, r in repository.tags.items()]
                return "refs", lambda: httpx.Response(200, json={"branches": [], "converts": [], "tags": tags})
            if rest.startswith("/tag/"):
                return "tag", lambda: self._tag(method, repository, rest.removeprefix("/tag/"), body)
            if rest.startswith("/revision/") or not rest:
                names = [{"rfilename": n} for n in repository.files]
                return "info", lambda: httpx.Response(
                    200, json={"id": name, "sha": repository.revision, "siblings": names}
                )
            if rest.startswith("/tree/"):
                tree = [{"type": "file", "path": n, "size": len(c), "oid": hashlib.sha1(c).hexdigest()}
                        for n, c in repository.files.items()]  # fmt: skip
                return "tree", lambda: httpx.Response(200, json=tree)
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            kind = "dataset" if found[1] else "model"
            return "resolve", lambda: self._resolve(method, kind, found[2], found[4])
        if path.endswith("validate-yaml"):
            return "validate", lambda: httpx.Response(200, json={"errors": [], "warnings": []})
        return "other", lambda: httpx.Response(404, json={"error": path})

    @staticmethod
    def _missing(code: str) -> httpx.Response:
        return httpx.Response(404, headers={"X-Error-Code": code}, json={"error": code})

    def _create(self, values: dict) -> httpx.Response:
        name = f"{values.get('organization') or 'user'}/{values['name']}"
        kind = values.get("type") or "model"
        url = f"https://huggingface.co/{'datasets/' if kind == 'dataset' else ''}{name}"
        if (kind, name) in self.repositories:
            return httpx.Response(409, json={"url": url, "error": "exists"})
        self.repositories[kind, name] = Repository(
            values.get("private") is True or values.get("visibility") == "private"
        )
        return httpx.Response(200, json={"url": url})

    def _preupload(self, values: dict) -> httpx.Response:
        modes = [
            {"path": f["path"], "uploadMode": "lfs" if f["size"] >= self.large else "regular", "shouldIgnore": False}
            for f in values["files"]
        ]
        return httpx.Response(200, json={"files": modes})

    def _batch(self, request: httpx.Request, values: dict) -> httpx.Response:
        objects = []
        for entry in values["objects"]:
            actions = {} if entry["oid"] in self.blobs else {
                "actions": {"upload": {"href": f"https://huggingface.co/blob/{entry['oid']}", "header": {}}}
            }  # fmt: skip
            objects.append({"oid": entry["oid"], "size": entry["size"], **actions})
        return httpx.Response(200, json={"transfer": "basic", "objects": objects})

    def _keep(self, oid: str, body: bytes) -> httpx.Response:
        self.blobs[oid] = body
        return httpx.Response(200)

    def _commit(self, kind: str, name: str, repository: Repository, body: bytes) -> httpx.Response:
        entries = [json.loads(line) for line in body.decode().splitlines()]
        parent = next(entry["value"] for entry in entries if entry["key"] == "header").get("parentCommit")
        if parent not in (None, repository.revision):
            return httpx.Response(412, json={"error": "the branch is not at that commit"})
        for entry in entries:
            value = entry["value"]
            if entry["key"] == "file":
                repository.files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                repository.files[value["path"]] = self.blobs[value["oid"]]
            elif entry["key"] == "deletedFile":
                del repository.files[value["path"]]
        repository.commits += 1
        prefix = "datasets/" if kind == "dataset" else ""
        url = f"https://huggingface.co/{prefix}{name}/commit/{repository.revision}"
        return httpx.Response(200, json={"success": True, "commitOid": repository.revision, "commitUrl": url})

    @staticmethod
    def _tag(method: str, repository: Repository, rest: str, body: bytes) -> httpx.Response:
        if method == "DELETE":
            del repository.tags[rest]
        else:
            repository.tags[json.loads(body)["tag"]] = rest
        return httpx.Response(200, json={})

    def _resolve(self, method: str, kind: str, name: str, path: str) -> httpx.Response:
        repository = self.repositories.get((kind, name))
        if repository is None:
            return self._missing("RepoNotFound")
        if path not in repository.files:
            return self._missing("EntryNotFound")
        content = repository.files[path]
        headers = {
            "ETag": f'"{hashlib.sha1(content).hexdigest()}"',
            "X-Repo-Commit": repository.revision,
            "Content-Length": str(len(content)),
        }
        return httpx.Response(200, headers=headers, content=b"" if method == "HEAD" else content)
