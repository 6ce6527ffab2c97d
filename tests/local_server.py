"""A small file server on this machine whose faults the tests choose."""

from __future__ import annotations

import email.utils
import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest


@dataclass
class FileServer:
    """Serves ``files`` (path -> bytes). The switches hold for every request until they are changed."""

    url: str
    files: dict[str, bytes] = field(default_factory=dict)
    drop_at: list[float] = field(default_factory=list)  # share of the whole file at which each next answer is cut off
    drop_always: float | None = None  # the same for every answer
    ranges: bool = True  # False: Range is ignored
    validators: bool = True  # False: neither ETag nor Last-Modified
    weak: bool = False  # ETag is a weak one
    lie_bytes: int = 0  # added to Content-Length
    status: list[int] = field(default_factory=list)  # HTTP answers that come before the file
    redirects: dict[str, str] = field(default_factory=dict)
    seen: list[tuple[str, dict[str, str]]] = field(default_factory=list)  # (path, headers) of every request
    sent_bytes: int = 0


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        state, path = self.server.state, self.path
        state.seen.append((path, {k.lower(): v for k, v in self.headers.items()}))
        if state.status:
            self._empty(state.status.pop(0), {"Retry-After": "0"})
        elif path in state.redirects:
            self._empty(302, {"Location": state.redirects[path]})
        elif path in state.files:
            self._send(state, state.files[path])
        else:
            self._empty(404, {})

    def _empty(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for key, value in {**headers, "Content-Length": "0"}.items():
            self.send_header(key, value)
        self.end_headers()

    def _send(self, state: FileServer, data: bytes) -> None:
        total, start = len(data), 0
        etag = ("W/" if state.weak else "") + f'"{hashlib.md5(data).hexdigest()}"'
        modified = email.utils.formatdate(total, usegmt=True)  # equal lengths have equal dates
        asked, condition = self.headers.get("Range", ""), self.headers.get("If-Range")
        if state.ranges and asked.startswith("bytes=") and condition in (None, etag, modified):
            start = int(asked[6:].rstrip("-"))
            if start >= total:
                self._empty(416, {"Content-Range": f"bytes */{total}"})
                return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        if state.validators:
            self.send_header("ETag", etag)
            self.send_header("Last-Modified", modified)
        self.send_header("Content-Length", str(total - start + state.lie_bytes))
        self.end_headers()
        share = state.drop_at.pop(0) if state.drop_at else state.drop_always
        end = total if share is None else max(start, int(share * total))
        state.sent_bytes += end - start
        self.wfile.write(data[start:end])
        self.close_connection = True

    def log_message(self, *args: Any) -> None:
        pass


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    state: FileServer


@contextmanager
def file_server() -> Iterator[FileServer]:
    """A FileServer at 127.0.0.1, past any proxy, for the length of a ``with``."""
    server = _Server(("127.0.0.1", 0), _Handler)
    server.state = FileServer(f"http://127.0.0.1:{server.server_address[1]}")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("no_proxy", "127.0.0.1")
        try:
            yield server.state
        finally:
            server.shutdown()
            server.server_close()
            thread.join()
