"""A review that is served, within the test's own process or as a user starts it."""

from __future__ import annotations

import http.client
import json
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, Self

from starlette.testclient import TestClient
from starlette.types import ASGIApp

from vision.review.api import session_app
from vision.review.server import guarded_app, serve
from vision.review.session import Session

PORT, TOKEN = 54321, "a-token-of-this-test"
HERE = f"http://127.0.0.1:{PORT}"
PROJECT = Path(__file__).parents[2]
PATIENCE_S = 120.0  # the machine may be busy


def app_of(session: Session) -> ASGIApp:
    """What a review serves, without a server."""
    return guarded_app(session_app(session, lambda: None), port=PORT, token=TOKEN)


def page_of(app: ASGIApp) -> TestClient:
    """A page of this application that has its token."""
    return TestClient(app, base_url=HERE, headers={"X-Token": TOKEN, "X-Window": "one"})


class Address:
    """What may be asked of a review at its address."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.url, _, self.token = address.partition("/?token=")
        self.port = int(self.url.rpartition(":")[2])

    def ask(self, path: str, body: Mapping[str, Any] | None = None) -> tuple[int, Any]:
        """Status and JSON of the answer."""
        asked = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        data = None if body is None else json.dumps(body)
        asked.request("GET" if body is None else "POST", path, data, {"X-Token": self.token})
        answer = asked.getresponse()
        content = answer.read()
        asked.close()
        return answer.status, json.loads(content) if content[:1] == b"{" else content

    def connected(self, text: str) -> socket.socket:
        """An open connection, to which these bytes were sent."""
        line = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        line.sendall(text.encode())
        return line

    def raw(self, text: str) -> str:
        """The first line that the server says to these bytes."""
        with self.connected(text) as line:
            return line.recv(4096).partition(b"\r\n")[0].decode()


class Served(Address):
    """Within this process; ended at the end of the block. `kept` answers questions while `opening` lasts."""

    def __init__(
        self,
        session: Session,
        kept: Mapping[str, bytes] | None = None,
        opening: Callable[[], object] = lambda: None,
    ) -> None:
        ready: Queue[str] = Queue()

        def opened(stop: Callable[[], None]) -> ASGIApp:
            opening()
            return session_app(session, stop)

        self.thread = Thread(target=serve, args=(opened,), kwargs={"opened": ready.put, "kept": kept})
        self.thread.daemon = True
        self.thread.start()
        super().__init__(ready.get(timeout=PATIENCE_S))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.thread.is_alive():
            self.ask("/api/quit", {})
        self.ended()

    def ended(self) -> None:
        """Waits until the server has ended."""
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


class Started(Address):
    """`track review RUN` in a process of its own; killed at the end of the block."""

    def __init__(self, run: Path) -> None:
        command = [sys.executable, PROJECT / "cli.py", "review", run, "--no-browser"]
        self.process = subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        super().__init__(next(m[0] for line in self.process.stdout if (m := re.search(r"http://\S+", line))))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.kill()

    def kill(self) -> None:
        """At once, with nothing put in order."""
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()
