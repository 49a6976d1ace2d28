"""The server of `track review`: a page on the loopback address, for browsers that have the token.

The server starts before the run has been read, which takes longer than loading the page. The answers to a
page's first requests are stored in the run folder and sent at once; other requests wait for the run. This
module imports nothing slow, because the user waits for it.
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
    The Host must be a name of the loopback address (otherwise a foreign page could read the answers through a
    foreign name that resolves to it: DNS rebinding). The Origin, if the browser sends one, must be this
    server. Bodies over 1 MB are refused, even if their stated length is wrong or missing.
    """

    def __init__(self, app: ASGIApp, *, port: int, token: str, cookie: str) -> None:
        self.app, self.token, self.cookie = app, token, cookie
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; protocols other than HTTP (WebSocket) are refused."""
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
    """Wrap `receive` so that it counts the bytes that really arrive."""
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
    """Return an error response with the reason."""
    return JSONResponse({"error": text}, status)


async def failed(request: Request, error: Exception) -> Response:
    """Return an error response of one line for any exception."""
    status = error.status_code if isinstance(error, HTTPException) else 500
    text = error.detail if isinstance(error, HTTPException) else f"{type(error).__name__}: {error}"
    return refused(status, " ".join(str(text).split()))


class Awaited:
    """Application that answers from the run once it has been read, and until then with stored answers.

    `kept` are the stored answers by address. `begin` is called at the first request that has none.
    """

    def __init__(self, answers: Future[ASGIApp], kept: Mapping[str, bytes], begin: Callable[[], Any]) -> None:
        self._answers, self._kept, self._begin = answers, kept, begin

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; if the run cannot be read, the answer is the reason."""
        query = scope["query_string"].decode("latin-1")
        asked = f"{scope['path']}?{query}" if query else scope["path"]
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


def guarded_app(answers: ASGIApp, *, port: int, token: str) -> ASGIApp:
    """Return the guarded application: the page, the files present at the start, and answers on the run."""
    files = {path.name: path for path in PAGE.glob("*") if path.suffix in KINDS}
    cookie = f"review_{port}"

    def file(request: Request) -> Response:
        path = files.get(request.path_params.get("name", "index.html"))
        if path is None:
            raise HTTPException(404, "no such file")
        return Response(path.read_bytes(), media_type=f"{KINDS[path.suffix]}; charset=utf-8")

    def index(request: Request) -> Response:
        answer = file(request)  # store the token in a cookie that no script and no other site can read
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
    """Serve the page on the loopback address until the server is stopped.

    opening: reads the run in a thread and returns the application that answers requests about it; its
    argument is a function that stops the server.  opened: called with the address, including the token, when
    the server is ready.  port: 0 selects a free one.  kept: stored answers by address; the run is read at the
    first request that is not among them.

    Raises: InputError if the port is in use or does not exist, or the run cannot be read.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    with contextlib.closing(listening), ThreadPoolExecutor(1) as reader:
        try:
            listening.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise InputError("`port`", "a free one, at most 65535", f"{port}", "leave it out") from error
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
                stop()  # after waiting pages have received the error

        begin = cache(lambda: reader.submit(read))  # only the first call reads the run
        config = uvicorn.Config(
            guarded_app(Awaited(answers, kept or {}, begin), port=number, token=token),
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
    if answers.done():  # raises the error of a run that cannot be read
        answers.result()


async def _run(server: uvicorn.Server, listening: socket.socket, ready: Callable[[], None]) -> None:
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    while not (server.started or serving.done()):
        await asyncio.sleep(0.01)
    if server.started:
        await asyncio.get_running_loop().run_in_executor(None, ready)
    await serving


# --- the first view: answers stored in the run folder -------------------------------------------------------

FIRST_VIEW = "first_view.zip"
READ = ("run.json", "corrections.toml")
SIZED = ("tracks.nc", "kymograph.tif", "events.csv", "clock.json")


def read_first_view(folder: Path, film: Path | None = None) -> dict[str, bytes]:
    """Return the stored answers by address; none if they are damaged or the run has changed since.

    film: path of the film, if it has been moved since it was tracked.
    """
    try:
        with ZipFile(folder / FIRST_VIEW) as file:
            size = sum(one.file_size for one in file.filelist)
            if file.comment != _digest(folder, film) or size > 64 << 20:  # too large for a first view
                return {}
            return {name: file.read(name) for name in file.namelist()}
    except (OSError, ValueError, RuntimeError, EOFError, BadZipFile, zlib.error):  # all that ZipFile raises
        return {}


def write_first_view(
    path: Path, folder: Path, answers: Mapping[str, bytes], film: Path | None = None
) -> None:
    """Write the file that `read_first_view` reads: answers by address."""
    with ZipFile(path, "w") as file:
        for name, content in answers.items():
            file.writestr(name, content)
        file.comment = _digest(folder, film)


def _digest(folder: Path, film: Path | None) -> bytes:
    """Return a digest of what determines the answers: run, decisions, existence of inputs, and program."""
    texts = [(folder / name).read_bytes() if (folder / name).exists() else b"" for name in READ]
    facts = json.loads(texts[0])
    texts += [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    inputs = [Path(str(one["path"])) for one in facts.get("inputs") or []]
    places = [*inputs, *(folder.absolute().parent / one for one in inputs), *([film] if film else [])]
    known = [__version__, *_stamps(folder / name for name in SIZED), *_stamps(places, dated=True)]
    return hashlib.sha256(b"\0".join([*texts, json.dumps(known).encode()])).hexdigest().encode()


def _stamps(paths: Iterable[Path], *, dated: bool = False) -> list[Any]:
    """Return size and, if `dated`, time of the last change of each file; None for missing files."""
    found = [path.stat() if path.exists() else None for path in paths]
    return [one and [one.st_size, one.st_mtime_ns if dated else 0] for one in found]
