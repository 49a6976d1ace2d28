"""The HTTP interface of `track review`: one run, on the loopback address, for whoever has the token."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vision.errors import InputError, with_options
from vision.review.session import Session
from vision.run.provenance import plain

MOST_BODY_BYTES = 1_000_000
MOST_POINTS = 20_000  # of a curve
WINDOW_GONE_S = 6.0  # a window that has not asked for so long is closed; pages ask every two seconds
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

    Parameters
    ----------
    app
        What is guarded.
    port
        On which it is served.
    token
        What every request must carry: in the address of the page, then in a cookie or the header X-Token.

    Notes
    -----
    The Host must be a name of the loopback address (a foreign name that resolves to it could otherwise be
    read by a foreign page: DNS rebinding), and the Origin, where a browser states one, this server. Bodies
    over 1 MB are refused, also where their length was stated wrongly or not at all.
    """

    def __init__(self, app: ASGIApp, *, port: int, token: str) -> None:
        self.app, self.token, self.cookie = app, token, f"review_{port}"
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
            return _error(403, "this host is not served")
        origin = request.headers.get("origin")
        if origin is not None and origin.lower().removeprefix("http://") not in self.hosts:
            return _error(403, "a request from another page")
        if request.method == "POST" and origin is None and "sec-fetch-site" in request.headers:
            return _error(403, "a request from another page")
        given = request.headers.get("x-token") or request.cookies.get(self.cookie, "")
        if request.url.path == "/":
            given = request.query_params.get("token") or given
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            return _error(403, "the address lacks the token: use the one that track review printed")
        length = request.headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MOST_BODY_BYTES:
            return _error(413, "more than 1 MB")
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


def _error(status: int, text: str) -> JSONResponse:
    return JSONResponse({"error": text}, status)


class Windows:
    """Which windows of a browser have the run open."""

    def __init__(self) -> None:
        self._seen: dict[str, float] = {}

    def others(self, window: str) -> int:
        """How many besides this one, which is noted."""
        now = time.monotonic()
        self._seen = {name: at for name, at in self._seen.items() if now - at < WINDOW_GONE_S}
        if window:
            self._seen[window[:64]] = now
        return len(self._seen.keys() - {window[:64]})

    def leave(self, window: str) -> None:
        """This one was closed."""
        self._seen.pop(window[:64], None)


class Api:
    """Answers for one session."""

    def __init__(self, session: Session, *, cookie: str, token: str, stop: Callable[[], None]) -> None:
        self.session, self._stop = session, stop
        self._cookie, self._token = cookie, token
        self._windows = Windows()
        self._files = {path.name: path for path in PAGE.glob("*") if path.suffix in KINDS}

    def routes(self) -> list[Route]:
        """Every address that is served."""
        get = {
            "/": self.page,
            "/page/{name}": self.file,
            "/api/run": self.run,
            "/api/state": self.state,
            "/api/film": self.film,
            "/api/frame/{frame:int}.png": self.frame,
            "/api/kymograph/{level:int}/{x:int}/{y:int}.png": self.tile,
            "/api/tracks": self.tracks,
            "/api/times": self.times,
            "/api/slips": self.slips,
            "/api/force": self.force,
            "/api/stick/{event:int}": self.stick,
            "/api/ridges/{frame:int}": self.ridges,
            "/api/save": self.saving,
            "/api/retrack": self.retracking,
            "/api/retracked/{frame:int}": self.retracked,
        }
        post = {
            "/api/preview": self.preview,
            "/api/decisions": self.decide,
            "/api/undo": self.undo,
            "/api/redo": self.redo,
            "/api/strip": self.strip,
            "/api/clock": self.clock,
            "/api/save": self.save,
            "/api/retrack": self.retrack,
            "/api/retrack/keep": self.keep_retracked,
            "/api/retrack/cancel": self.cancel_retracking,
            "/api/leave": self.leave,
            "/api/quit": self.quit,
        }
        routes = [Route(path, _threaded(work), methods=["GET"]) for path, work in get.items()]
        return routes + [
            Route(path, _threaded(work, body=True), methods=["POST"]) for path, work in post.items()
        ]

    # --- the page -------------------------------------------------------------------------------------------

    def page(self, request: Request) -> Response:
        """index.html; the token goes into a cookie that no script and no other site sees."""
        answer = self._page_file("index.html")
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
        return answer

    def file(self, request: Request) -> Response:
        """One file of the page, by a name that was there when the server started."""
        return self._page_file(request.path_params["name"])

    def _page_file(self, name: str) -> Response:
        path = self._files.get(name)
        if path is None:
            raise HTTPException(404, "no such file")
        return Response(path.read_bytes(), media_type=f"{KINDS[path.suffix]}; charset=utf-8")

    # --- what is shown --------------------------------------------------------------------------------------

    def run(self, request: Request) -> Response:
        """The run at a glance."""
        return _json(self.session.summary() | self._company(request))

    def state(self, request: Request) -> Response:
        """Revision, decisions, and whether another window has the run open."""
        return _json(self.session.state() | self._company(request))

    def _company(self, request: Request) -> dict[str, Any]:
        return {"other_windows": self._windows.others(request.headers.get("x-window", ""))}

    def film(self, request: Request) -> Response:
        """The film's picture, or why it cannot be shown."""
        try:
            rows, columns = self.session.film().shape
        except InputError as error:
            return _json({"rows": None, "columns": None, "error": with_options(str(error), {})})
        return _json({"rows": rows, "columns": columns, "error": ""})

    def frame(self, request: Request) -> Response:
        """One frame of the film."""
        return _png(self.session.frame_png(request.path_params["frame"]))

    def tile(self, request: Request) -> Response:
        """One tile of I(x, t)."""
        place = (request.path_params[name] for name in ("level", "x", "y"))
        return _png(self.session.tiles.png(*place))

    def tracks(self, request: Request) -> Response:
        """Curves of all sheets as float32, row after row."""
        first, stop = _number(request, "first", 0), _number(request, "stop", 1 << 40)
        points = max(2, min(_number(request, "points", 2000), MOST_POINTS))
        what = request.query_params.get("what", "x")
        return _floats(self.session.curves(first, stop, points, what))

    def times(self, request: Request) -> Response:
        """Seconds of the camera's clock as float64, one per frame."""
        return _floats(self.session.positions.time_s[:, None])

    def slips(self, request: Request) -> Response:
        """Frames after the slips, and after the sheets' own steps, whatever the clock; a second's work."""
        return _json({"slips": self.session.slips(), "film": self.session.film_slips()})

    def force(self, request: Request) -> Response:
        """Time by the force clock, load and separation as float64, row after row."""
        points = max(2, min(_number(request, "points", 2000), MOST_POINTS))
        span = (_seconds(request, "first_s", float("-inf")), _seconds(request, "stop_s", float("inf")))
        return _floats(self.session.force_curve(*span, points))

    def stick(self, request: Request) -> Response:
        """σ_x/Λ_st of one stick, or why there is none: a page asks for each stick that the cursor passes."""
        return _json(self.session.effects.stick(request.path_params["event"]))

    def ridges(self, request: Request) -> Response:
        """Candidates of one frame."""
        return _json(self.session.ridges(request.path_params["frame"]))

    # --- what is decided ------------------------------------------------------------------------------------

    def preview(self, request: Request, body: Mapping[str, Any]) -> Response:
        """What a decision would change."""
        decision = _table(body, "decision")
        return _tried(lambda: self.session.effects.preview(decision, body.get("frame")))

    def decide(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Keep a decision."""
        return self._changed(request, body, lambda: self.session.decide(_table(body, "decision")))

    def undo(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Take the last decision back."""
        return self._changed(request, body, self.session.undo)

    def redo(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Make it again."""
        return self._changed(request, body, self.session.redo)

    def _changed(self, request: Request, body: Mapping[str, Any], work: Callable[[], None]) -> Response:
        """Refused where the page has not seen what another window decided meanwhile."""
        with self.session.lock:
            seen = body.get("revision", self.session.revision)
            if seen != self.session.revision:
                raise HTTPException(409, "the run was changed in another window: look again")
            work()
            return self.state(request)

    def strip(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Ridges and noise of other rows."""
        return _tried(lambda: self.session.effects.strip_preview(body.get("rows"), body.get("frame")))

    def clock(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Sticks and slips by another clock, which is not kept."""
        offset_s, drift_ppm = body.get("offset_s"), body.get("drift_ppm", 0.0)
        return _tried(lambda: self.session.effects.clock_preview(offset_s, drift_ppm, body.get("frame")))

    def save(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Begin to re-run what follows from the decisions."""
        self.session.save()
        return _json(self.session.saving())

    def saving(self, request: Request) -> Response:
        """How far saving is."""
        return _json(self.session.saving())

    def retrack(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Begin to track again under a decision that is not kept yet."""
        self.session.trial.start(_table(body, "decision"))
        return _json(self.session.trial.state())

    def retracking(self, request: Request) -> Response:
        """How far that is; at last what it would change."""
        return _json(self.session.trial.state())

    def retracked(self, request: Request) -> Response:
        """The run as it was tracked again, about one frame."""
        return _json(self.session.trial.at(request.path_params["frame"]))

    def keep_retracked(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Keep the decision, and the run as it was tracked again."""
        return self._changed(request, body, self.session.trial.keep)

    def cancel_retracking(self, request: Request, body: Mapping[str, Any]) -> Response:
        """Throw it away, finished or not."""
        self.session.trial.discard()
        return _json({})

    def leave(self, request: Request, body: Mapping[str, Any]) -> Response:
        """A window was closed, or is loaded anew."""
        self._windows.leave(request.headers.get("x-window", ""))
        return _json({})

    def quit(self, request: Request, body: Mapping[str, Any]) -> Response:
        """End the server once this is answered."""
        self._stop()
        return _json({"ended": True})


def _tried(work: Callable[[], Mapping[str, Any]]) -> Response:
    """What was tried out, or why it does not fit: half-typed numbers are no errors, so a 200 says it."""
    try:
        return _json(work())
    except InputError as error:
        return _json({"refused": with_options(str(error), {})})


def _threaded(work: Callable[..., Response], *, body: bool = False) -> Callable[[Request], Any]:
    """A function that waits for files and arrays, off the event loop; InputError becomes an answer."""

    async def answer(request: Request) -> Response:
        given = [await _body_of(request)] if body else []
        try:
            return await run_in_threadpool(work, request, *given)
        except InputError as error:
            return _error(422, with_options(str(error), {}))

    return answer


async def _body_of(request: Request) -> Mapping[str, Any]:
    raw = await request.body()
    try:
        body = json.loads(raw or b"{}")
    except (ValueError, RecursionError):
        raise HTTPException(400, "the body is no JSON") from None
    if not isinstance(body, dict):
        raise HTTPException(400, "the body is no JSON object")
    return body


def _table(body: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = body.get(name)
    if not isinstance(value, dict):
        raise HTTPException(400, f"no {name} in the body")
    return value


def _number(request: Request, name: str, default: int) -> int:
    text = request.query_params.get(name, str(default))
    if not text.isdecimal() or len(text) > 15:
        raise HTTPException(400, f"{name} is a whole number from 0")
    return int(text)


def _seconds(request: Request, name: str, default: float) -> float:
    try:
        return float(request.query_params.get(name, default))
    except ValueError:
        raise HTTPException(400, f"{name} is a number") from None


def _json(content: Any) -> Response:
    text = json.dumps(plain(content), ensure_ascii=False, allow_nan=False)
    return Response(text.encode(), media_type="application/json")


def _png(data: bytes) -> Response:
    return Response(data, media_type="image/png")


def _floats(table: Any) -> Response:
    """Little-endian numbers; their rows and columns in a header."""
    shape = {"X-Rows": str(table.shape[0]), "X-Columns": str(table.shape[1])}
    little = table.astype(table.dtype.newbyteorder("<"), copy=False)
    return Response(little.tobytes(), media_type="application/octet-stream", headers=shape)


async def _failed(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    text = error.detail if isinstance(error, HTTPException) else f"{type(error).__name__}: {error}"
    return _error(status, " ".join(str(text).split()))


def make_app(session: Session, *, port: int, token: str, stop: Callable[[], None]) -> ASGIApp:
    """The application for one session.

    Parameters
    ----------
    session
        The open run.
    port, token
        For `Guard`.
    stop
        Ends the server.
    """
    api = Api(session, cookie=f"review_{port}", token=token, stop=stop)
    app = Starlette(routes=api.routes(), exception_handlers={HTTPException: _failed, Exception: _failed})
    return Guard(app, port=port, token=token)


def serve(session: Session, *, opened: Callable[[str], None], port: int = 0) -> None:
    """Serve a session on the loopback address until it is told to stop.

    Parameters
    ----------
    session
        The open run.
    opened
        Called with the address, token and all, once it can be asked.
    port
        0 takes one that is free.

    Raises
    ------
    InputError
        Where the port is taken.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    with contextlib.closing(listening):
        try:
            listening.bind(("127.0.0.1", port))
        except OSError as error:
            raise InputError("`port`", "a free one", f"{port}, in use", "leave it out") from error
        listening.listen(64)
        number, token = int(listening.getsockname()[1]), secrets.token_urlsafe(32)
        servers: list[uvicorn.Server] = []

        def stop() -> None:
            servers[0].should_exit = True

        app = make_app(session, port=number, token=token, stop=stop)
        config = uvicorn.Config(
            app,
            log_level="critical",
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=2,
            proxy_headers=False,
        )
        servers.append(uvicorn.Server(config))
        address = f"http://127.0.0.1:{number}/?token={token}"
        asyncio.run(_run(servers[0], listening, partial(opened, address)))


async def _run(server: uvicorn.Server, listening: socket.socket, ready: Callable[[], None]) -> None:
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    while not (server.started or serving.done()):
        await asyncio.sleep(0.01)
    if server.started:
        await asyncio.get_running_loop().run_in_executor(None, ready)
    await serving
