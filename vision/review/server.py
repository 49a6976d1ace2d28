"""The server of `track review`: a page on the loopback address, for whoever has the token.

It is there before the run has been read, which takes longer than to load the page. Answers to what a page
asks first are kept in the run's folder and given at once; other questions wait until the run has been read.
This module imports nothing that takes time, for it is what is waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import json
import secrets
import socket
import zlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vision import __version__
from vision.errors import InputError, with_options

MOST_BODY_BYTES = 1_000_000
PAGE = Path(__file__).parent / "page"
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


class Guard:
    """Refuses requests that do not come from this page, before anything else sees them.

    Every request must carry the token: in the address of the page, then in a cookie or the header X-Token.
    The Host must be a name of the loopback address (a foreign name that resolves to it could otherwise be
    read by a foreign page: DNS rebinding), and the Origin, where a browser states one, this server. Bodies
    over 1 MB are refused, also where their length was stated wrongly or not at all.
    """

    def __init__(self, app: ASGIApp, *, port: int, token: str, cookie: str) -> None:
        self.app, self.token, self.cookie = app, token, cookie
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request; what is no HTTP (a WebSocket) is refused."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        send = _with_headers(send)
        request = Request(scope)
        refusal = self._refusal(request)
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        await self.app(scope, _bounded(receive), send)

    def _refusal(self, request: Request) -> Response | None:
        if request.headers.get("host", "").lower() not in self.hosts:
            return refused(403, "this host is not served")
        origin = request.headers.get("origin")
        if origin is not None and origin.lower().removeprefix("http://") not in self.hosts:
            return refused(403, "a request from another page")
        if request.method == "POST" and origin is None and "sec-fetch-site" in request.headers:
            return refused(403, "a request from another page")
        given = request.headers.get("x-token") or request.cookies.get(self.cookie, "")
        if request.url.path == "/":
            given = request.query_params.get("token") or given
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            return refused(403, "the address lacks the token: use the one that track review printed")
        length = request.headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MOST_BODY_BYTES:
            return refused(413, "more than 1 MB")
        return None


def _bounded(receive: Receive) -> Receive:
    """Counts what really arrives."""
    seen = 0

    async def counted() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > MOST_BODY_BYTES:
            raise HTTPException(413, "more than 1 MB")
        return message

    return counted


def _with_headers(send: Send) -> Send:
    extra = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]

    async def answer(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", []), *extra]
        await send(message)

    return answer


def refused(status: int, text: str) -> JSONResponse:
    """A request that is not answered, and why."""
    return JSONResponse({"error": text}, status)


async def failed(request: Request, error: Exception) -> Response:
    """An answer in one line of JSON, whatever went wrong."""
    status = error.status_code if isinstance(error, HTTPException) else 500
    text = error.detail if isinstance(error, HTTPException) else f"{type(error).__name__}: {error}"
    return refused(status, " ".join(str(text).split()))


class Awaited:
    """Answers that are there once the run has been read; until then those that were kept, by their questions.

    `begin` is called with the first question that has none among them.
    """

    def __init__(self, answers: Future[ASGIApp], kept: Mapping[str, bytes], begin: Callable[[], Any]) -> None:
        self._answers, self._kept, self._begin = answers, kept, begin

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request; of a run that cannot be read the reason."""
        asked = scope["path"] + (
            "?" + scope["query_string"].decode("latin-1") if scope["query_string"] else ""
        )
        kept = None if self._answers.done() or scope["method"] != "GET" else self._kept.get(asked)
        app: ASGIApp
        if kept is None:
            self._begin()
            try:
                app = await asyncio.shield(asyncio.wrap_future(self._answers))
            except InputError as error:
                app = refused(422, with_options(str(error)))
        else:
            kind = "image/png" if asked.endswith(".png") else "application/octet-stream"
            app = Response(kept, media_type=kind)
        await app(scope, receive, send)


def make_app(answers: ASGIApp, *, port: int, token: str) -> ASGIApp:
    """The page, its files by names that were there at the start, and answers about the run; guarded."""
    files = {path.name: path for path in PAGE.glob("*") if path.suffix in KINDS}
    cookie = f"review_{port}"

    def file(request: Request) -> Response:
        path = files.get(request.path_params.get("name", "index.html"))
        if path is None:
            raise HTTPException(404, "no such file")
        return Response(path.read_bytes(), media_type=f"{KINDS[path.suffix]}; charset=utf-8")

    def index(request: Request) -> Response:
        answer = file(request)  # the token goes into a cookie that no script and no other site sees
        answer.set_cookie(cookie, token, httponly=True, samesite="strict", path="/")
        return answer

    routes = [
        Route("/", index, methods=["GET"]),
        Route("/page/{name}", file, methods=["GET"]),
        Route("/api/{question:path}", answers),
    ]
    app = Starlette(routes=routes, exception_handlers={HTTPException: failed, Exception: failed})
    return Guard(app, port=port, token=token, cookie=cookie)


def serve(
    opening: Callable[[Callable[[], None]], ASGIApp],
    *,
    opened: Callable[[str], None],
    port: int = 0,
    kept: Mapping[str, bytes] | None = None,
) -> None:
    """Serve the page on the loopback address until it is told to stop.

    Parameters
    ----------
    opening
        Reads the run, in a thread, and returns what answers questions about it; called with what ends the
        server.
    opened
        Called with the address, token and all, once it can be asked.
    port
        0 takes one that is free.
    kept
        Answers from before; the run is read with the first question that has none among them.

    Raises
    ------
    InputError
        Where the port is taken, or the run cannot be read.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    with contextlib.closing(listening), ThreadPoolExecutor(1) as reader:
        try:
            listening.bind(("127.0.0.1", port))
        except OSError as error:
            raise InputError("`port`", "a free one", f"{port}, in use", "leave it out") from error
        listening.listen(64)
        number, token = int(listening.getsockname()[1]), secrets.token_urlsafe(32)
        answers: Future[ASGIApp] = Future()

        def stop() -> None:
            server.should_exit = True

        def read() -> None:
            try:
                answers.set_result(opening(stop))
            except BaseException as error:
                answers.set_exception(error)
                stop()  # once a page that waits has been told

        begin = cache(lambda: reader.submit(read))  # once
        config = uvicorn.Config(
            make_app(Awaited(answers, kept or {}, begin), port=number, token=token),
            log_level="critical",
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=2,
            proxy_headers=False,
        )
        server = uvicorn.Server(config)
        if not kept:
            begin()
        address = f"http://127.0.0.1:{number}/?token={token}"
        asyncio.run(_run(server, listening, partial(opened, address)))
    if answers.done():  # it was begun
        answers.result()


async def _run(server: uvicorn.Server, listening: socket.socket, ready: Callable[[], None]) -> None:
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    while not (server.started or serving.done()):
        await asyncio.sleep(0.01)
    if server.started:
        await asyncio.get_running_loop().run_in_executor(None, ready)
    await serving


# --- the first view: answers kept in the run folder ---------------------------------------------------------


FIRST_VIEW = "first_view.zip"
READ = ("run.json", "corrections.toml")
SIZED = ("tracks.nc", "kymograph.tif", "events.csv", "clock.json")
MOST_BYTES = 64 << 20  # more is not a first view


def read_first_view(folder: Path, film: Path | None = None) -> dict[str, bytes]:
    """Answers by their questions; none where they are not those about this run, or damaged.

    film: where it lies now, if not where it was when it was tracked.
    """
    try:
        with ZipFile(folder / FIRST_VIEW) as kept:
            size = sum(one.file_size for one in kept.filelist)
            if kept.comment != _state(folder, film) or size > MOST_BYTES:
                return {}
            return {name: kept.read(name) for name in kept.namelist()}
    except (OSError, ValueError, RuntimeError, EOFError, BadZipFile, zlib.error):  # all that ZipFile raises
        return {}


def write_first_view(
    path: Path, folder: Path, answers: Mapping[str, bytes], film: Path | None = None
) -> None:
    """Write the file that `read_first_view` finds in the run folder: answers by their questions."""
    with ZipFile(path, "w") as kept:
        for name, content in answers.items():
            kept.writestr(name, content)
        kept.comment = _state(folder, film)


def _state(folder: Path, film: Path | None) -> bytes:
    """A digest of what the answers follow from: the run, its decisions, whether its inputs are there, and the
    program that gave them."""
    texts = [(folder / name).read_bytes() if (folder / name).exists() else b"" for name in READ]
    facts = json.loads(texts[0])
    texts += [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    inputs = [Path(str(one["path"])) for one in facts.get("inputs") or []]
    places = [*inputs, *(folder.absolute().parent / one for one in inputs), *([film] if film else [])]
    known = [__version__, *_facts(folder / name for name in SIZED), *_facts(places, dated=True)]
    return hashlib.sha256(b"\0".join([*texts, json.dumps(known).encode()])).hexdigest().encode()


def _facts(paths: Iterable[Path], *, dated: bool = False) -> list[Any]:
    """Sizes, and times of the last change; nothing of files that are not there."""
    found = [path.stat() if path.exists() else None for path in paths]
    return [one and [one.st_size, one.st_mtime_ns if dated else 0] for one in found]
