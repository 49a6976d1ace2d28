"""The HTTP interface of a review: every address that the page can request, and its answer."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import anyio
import anyio.to_thread
import cv2
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message

from vision.errors import InputError, with_options
from vision.folder import plain, whole_file
from vision.memory import give_back_freed
from vision.review.recordings import TILE_COLUMNS, TILE_FACTOR, TILE_ROWS, Grey
from vision.review.server import FIRST_VIEW, failed, read_first_view, refused, write_first_view
from vision.review.session import Session


def session_app(session: Session, stop: Callable[[], None]) -> ASGIApp:
    """Return the application that answers requests about an open run; `stop` ends the server."""
    routes = Api(session, stop).routes()
    return Starlette(routes=routes, exception_handlers={HTTPException: failed, Exception: failed})


def keep_first_view(session: Session) -> None:
    """Store the answers to a page's first requests in the run folder, if possible and not yet done."""
    folder, film = session.folder, session.recordings.moved
    if session.saver.running or read_first_view(folder, film):
        return
    with suppress(InputError):
        session.stored.check_there()
        with whole_file(folder / FIRST_VIEW) as path:
            write_first_view(path, folder, first_answers(session), film)


def first_answers(session: Session) -> dict[str, bytes]:
    """Return, by address, the answers to a page's first requests: the whole test, and the first frame."""
    first, frames, tiles = int(session.positions.frame[0]), session.diagram.frames, session.tiles
    addresses = [f"/api/{name}" for name in ("times", "film", f"frame/{first}.png", f"ridges/{first}")]
    addresses += ["/api/force?points=4096"]  # as a page requests it first
    addresses += [f"/api/stick/{one['event']}" for one in session.sticks()[:1]]
    for level in range(tiles.levels):
        scale = TILE_FACTOR**level
        # A page with more than 2048 pixels along time requests a finer level, which takes as long as reading.
        step, shown = TILE_ROWS * scale, frames <= 4096 * scale
        if not (shown or level == 0):
            continue
        for k, begin in enumerate(range(first, first + (frames if shown else 1), step)):
            stop = min(begin + step, first + frames)
            addresses.append(f"/api/tracks?first={begin}&stop={stop}&points={2 * TILE_ROWS}")
            across = range(-(-session.diagram.columns // TILE_COLUMNS) if shown else 0)
            addresses += [f"/api/kymograph/{level}/{x}/{k}.png" for x in across]
    found = {"/api/run": bytes(_json(session.summary() | {"revision": 0, "other_windows": 0}).body)}
    app = session_app(session, lambda: None)
    give_back_freed()

    async def ask() -> None:
        for address in addresses:
            answer = await _request(app, address)
            if answer is not None:  # there may be no film, or no force
                found[address] = answer

    anyio.run(ask)  # once: each leaves its thread's memory
    return found


async def _request(app: ASGIApp, address: str) -> bytes | None:
    """Return the answer to one request; None if it is refused."""
    path, _, query = address.partition("?")
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query.encode(), "headers": []}
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request", "body": b""}

    async def send(message: Message) -> None:
        sent.append(message)

    await app(scope, receive, send)
    body = b"".join(message.get("body", b"") for message in sent)
    return body if sent[0]["status"] == 200 else None


class Api:
    """Addresses and answers for one session."""

    def __init__(self, session: Session, stop: Callable[[], None]) -> None:
        self.session, self._stop = session, stop
        # Requests answered at a time: more are no faster on a few cores, and each thread needs memory.
        self._threads = anyio.CapacityLimiter(4)
        self._windows: dict[str, float] = {}  # time of the last request of each browser window

    def routes(self) -> list[Route]:
        """Return every address with its function."""
        asked = [Route(path, self._threaded(work), methods=["GET"]) for path, work in self._get().items()]
        return asked + [
            Route(path, self._threaded(work, body=True), methods=["POST"])
            for path, work in self._post().items()
        ]

    def _get(self) -> dict[str, Callable[[Request], Response]]:
        """Return the requests for data, by address."""
        run, trial, effects = self.session, self.session.trial, self.session.effects
        return {
            "/api/run": lambda ask: _json(run.summary() | self._other_windows(ask)),
            "/api/state": lambda ask: _json(run.state() | self._other_windows(ask)),
            "/api/film": self._film,
            "/api/frame/{frame:int}.png": lambda ask: _png(run.picture(ask.path_params["frame"])),
            "/api/kymograph/{level:int}/{x:int}/{y:int}.png": lambda ask: _png(
                run.tiles.part(*(ask.path_params[name] for name in ("level", "x", "y")))
            ),
            "/api/tracks": lambda ask: _floats(  # positions of all sheets as float32, row after row
                run.curves(_number(ask, "first", 0), _number(ask, "stop", 1 << 40), _points(ask))
            ),
            "/api/times": lambda ask: _floats(run.positions.time_s[:, None]),  # s, one per frame
            "/api/slips": lambda ask: _json({"slips": run.slips(), "film": run.film_slips()}),
            "/api/force": lambda ask: _floats(  # time on the force clock, load and separation as float64
                run.recordings.force(
                    _seconds(ask, "first_s", -math.inf), _seconds(ask, "stop_s", math.inf), _points(ask)
                )
            ),
            # the page requests each stick phase that the cursor passes
            "/api/stick/{event:int}": lambda ask: _json(effects.stick(ask.path_params["event"])),
            "/api/ridges/{frame:int}": lambda ask: _json(run.ridges(ask.path_params["frame"])),
            "/api/save": lambda ask: _json(run.saving()),
            "/api/retrack": lambda ask: _json(trial.state()),
            "/api/retracked/{frame:int}": lambda ask: _json(trial.at(ask.path_params["frame"])),
        }

    def _post(self) -> dict[str, Callable[[Request, Mapping[str, Any]], Response]]:
        """Return the requests with a body, by address: previews and changes."""
        run, trial, effects = self.session, self.session.trial, self.session.effects
        return {
            "/api/preview": lambda ask, body: _previewed(
                lambda: effects.preview(_table(body, "decision"), body.get("frame"))
            ),
            "/api/strip": lambda ask, body: _previewed(
                lambda: effects.strip_preview(body.get("rows"), body.get("frame"))
            ),
            "/api/clock": lambda ask, body: _previewed(
                lambda: effects.clock_preview(
                    body.get("offset_s"), body.get("drift_ppm", 0.0), body.get("frame")
                )
            ),
            "/api/decisions": lambda ask, body: self._changed(
                ask, body, lambda: run.decide(_table(body, "decision"))
            ),
            "/api/undo": lambda ask, body: self._changed(ask, body, run.undo),
            "/api/redo": lambda ask, body: self._changed(ask, body, run.redo),
            "/api/save": lambda ask, body: _done(run.save, run.saving),
            "/api/retrack": lambda ask, body: _done(
                lambda: trial.start(_table(body, "decision")), trial.state
            ),
            "/api/retrack/keep": lambda ask, body: self._changed(ask, body, trial.keep),
            "/api/retrack/cancel": lambda ask, body: _done(trial.discard),
            "/api/leave": lambda ask, body: _done(lambda: self._windows.pop(_window(ask), None)),
            "/api/quit": lambda ask, body: _done(self._stop, lambda: {"ended": True}),
        }

    def _threaded(self, work: Callable[..., Response], *, body: bool = False) -> Callable[[Request], Any]:
        """Wrap `work` so that it runs in a thread beside the event loop and InputError becomes an answer."""

        async def answer(request: Request) -> Response:
            content = [await _body_of(request)] if body else []
            try:
                return await anyio.to_thread.run_sync(work, request, *content, limiter=self._threads)
            except InputError as error:
                return refused(422, with_options(str(error)))

        return answer

    def _other_windows(self, request: Request) -> dict[str, Any]:
        """Record the requesting window and return the number of others."""
        window, now = _window(request), time.monotonic()
        # pages send a request every two seconds, so a window silent for 6 s is closed
        self._windows = {name: at for name, at in self._windows.items() if now - at < 6.0}
        if window:
            self._windows[window] = now
        return {"other_windows": len(self._windows.keys() - {window})}

    def _film(self, request: Request) -> Response:
        """Return the size of the film's picture, or why it cannot be shown."""
        try:
            rows, columns = self.session.recordings.film().shape
        except InputError as error:
            return _json({"rows": None, "columns": None, "error": with_options(str(error))})
        return _json({"rows": rows, "columns": columns, "error": ""})

    def _changed(self, request: Request, body: Mapping[str, Any], work: Callable[[], None]) -> Response:
        """Make a change, unless the page has not yet seen a change made in another window."""
        with self.session.lock:
            if body.get("revision", self.session.revision) != self.session.revision:
                raise HTTPException(409, "the run was changed in another window: look again")
            work()
            return _json(self.session.state() | self._other_windows(request))


def _window(request: Request) -> str:
    """Return the identifier of the requesting window; "" if it sends none."""
    return request.headers.get("x-window", "")[:64]


def _done(work: Callable[[], Any], state: Callable[[], Mapping[str, Any]] = dict) -> Response:
    """Do something that changes no decision, and return the state after it."""
    work()
    return _json(state())


def _previewed(work: Callable[[], Mapping[str, Any]]) -> Response:
    """Return a preview or why there is none, with status 200: a half-typed number is not an error."""
    try:
        return _json(work())
    except InputError as error:
        return _json({"refused": with_options(str(error))})


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


def _points(request: Request) -> int:
    return max(2, min(_number(request, "points", 2000), 20_000))


def _seconds(request: Request, name: str, default: float) -> float:
    try:
        return float(request.query_params.get(name, default))
    except ValueError:
        raise HTTPException(400, f"{name} is a number") from None


def _json(content: Any) -> Response:
    text = json.dumps(plain(content), ensure_ascii=False, allow_nan=False)
    return Response(text.encode(), media_type="application/json")


def _png(pixels: Grey) -> Response:
    """Return a picture as PNG, compressed fast rather than well, since it stays on this computer."""
    encoded, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert encoded
    return Response(data.tobytes(), media_type="image/png")


def _floats(table: Any) -> Response:
    """Return little-endian numbers, with the number of rows and columns in headers."""
    shape = {"X-Rows": str(table.shape[0]), "X-Columns": str(table.shape[1])}
    little = table.astype(table.dtype.newbyteorder("<"), copy=False)
    return Response(little.tobytes(), media_type="application/octet-stream", headers=shape)
