"""A stand-in for the Hugging Face hub on this machine: what ``huggingface_hub`` asks of its server, over HTTP."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

COMMIT = "0" * 39 + "1"
TOKEN = "hf_of_a_test"


class Repositories(dict[str, dict[str, bytes]]):
    """The contents of the files of each repository by name."""

    def __init__(self) -> None:
        self.private: dict[str, bool] = {}
        """Whether each was created as a private one."""


@contextmanager
def served() -> Iterator[tuple[str, Repositories]]:
    """Yields the address of a hub, and its repositories."""
    repos = Repositories()

    class Hub(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None: ...

        def answer(self, content: Any, status: int = 200, **headers: str) -> None:
            body = content if isinstance(content, bytes) else json.dumps(content).encode()
            self.send_response(status)
            for key, value in {"Content-Length": str(len(body)), **headers}.items():
                self.send_header(key.replace("_", "-"), value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def refuse(self, status: int, code: str) -> None:
            self.answer({"error": code}, status, X_Error_Code=code, X_Error_Message=code)

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"] or 0))
            path = urlsplit(self.path).path
            if self.headers.get("Authorization") != f"Bearer {TOKEN}":
                self.refuse(401, "Unauthorized")
            elif path == "/api/repos/create":
                given = json.loads(body)
                repo = f"{given.get('organization') or 'me'}/{given['name']}"
                if repo.startswith("others/"):
                    self.refuse(403, "Forbidden")
                    return
                is_new = repo not in repos
                repos.private.setdefault(repo, given.get("private") or given.get("visibility") == "private")
                repos.setdefault(repo, {".gitattributes": b""})
                self.answer({"url": f"{address}/{repo}"}, 200 if is_new else 409)
            elif path == "/api/validate-yaml":
                self.answer({"errors": [], "warnings": []})
            elif path.endswith("/preupload/main"):
                files = json.loads(body)["files"]
                kept = {"uploadMode": "regular", "shouldIgnore": False, "oid": None}
                self.answer({"files": [{"path": one["path"], **kept} for one in files]})
            elif path.endswith("/commit/main"):
                repo = path.removeprefix("/api/models/").removesuffix("/commit/main")
                for line in map(json.loads, body.splitlines()):
                    if line["key"] == "file":
                        repos[repo][line["value"]["path"]] = base64.b64decode(line["value"]["content"])
                self.answer({"commitUrl": f"{address}/{repo}/commit/{COMMIT}", "commitOid": COMMIT})
            else:
                self.refuse(404, "EntryNotFound")

        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            repo, _, name = path.removeprefix("/api/models").strip("/").partition("/resolve/")
            repo = "/".join(repo.split("/")[:2])
            if repo not in repos:
                self.refuse(404, "RepoNotFound")
            elif path.startswith("/api/models/"):
                siblings = [{"rfilename": one} for one in repos[repo]]
                tree = [
                    {"type": "file", "path": one, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}
                    for one, content in repos[repo].items()
                ]
                about = {"id": repo, "modelId": repo, "sha": COMMIT, "siblings": siblings, "private": False, "tags": []}
                self.answer(tree if "/tree/" in path else about)
            elif (content := repos[repo].get(name.partition("/")[2])) is None:
                self.refuse(404, "EntryNotFound")
            else:
                self.answer(content, ETag=f'"{hashlib.sha1(content).hexdigest()}"', X_Repo_Commit=COMMIT)

        do_HEAD = do_GET  # noqa: N815

    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    address = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield address, repos
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
