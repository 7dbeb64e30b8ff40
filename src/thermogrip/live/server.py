"""The page's own process: what the session sends goes to every viewer, what a viewer asks goes back.

    session --- a line of JSON, 10 a second ---> this process --- server-sent events ---> viewers
            <-- a line of JSON a request ------               <-- POST -----------------

Neither end needs the other.  Without this process the session goes on.  Without the session the line ends
here, the page says so, and says what then holds for the drive.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import os
import secrets
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from thermogrip.datasets.files import parse_json

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Receive, Scope, Send
    from uvicorn import Server

HOST = "127.0.0.1"  # only this computer is served


@dataclass(frozen=True)
class PageSettings:
    """How much a page holds, how often it is sent, and what a viewer may send."""

    every_s: float = 0.1  # between two events to a viewer
    alive_s: float = 1.0  # at most
    linger_s: float = 600.0  # that a page whose session was killed may still be opened
    most_rows: int = 4000  # that are kept; older ones are thinned
    most_bytes: int = 4096  # of a request
    most_text: int = 200  # characters, of what a viewer says
    mark_every_s: float = 1.0  # at most: nobody types another reason in less


PAGE = PageSettings()


class State:
    """What a viewer sees: the rows so far and the newest message."""

    def __init__(self) -> None:
        self.columns: list[str] = []
        self.history: list[list[Any]] = []
        self.recent: deque[list[Any]] = deque(maxlen=PAGE.most_rows)
        self.posterior: list[list[Any]] = []
        self.now: dict[str, Any] = {}
        self.count = self.messages = 0
        self.lost = False  # the session is gone without a verdict
        self.over = False
        self.viewers = 0

    def take(self, message: dict[str, Any]) -> None:
        """Take one message of the session."""
        rows, probabilities = message.pop("rows"), message.pop("posterior")
        if message["columns"] != self.columns or (rows and self.recent and rows[0][0] < self.recent[-1][0]):
            self.columns = message["columns"]
            self.history.clear()
        for row in probabilities:
            if self.posterior and row[0] <= self.posterior[-1][0]:
                self.posterior = []  # of another contact
            self.posterior.append(row)
        self.history += rows
        self.recent.extend(rows)
        self.count += len(rows)
        if len(self.history) > PAGE.most_rows:
            half = PAGE.most_rows // 2
            self.history[:half] = self.history[:half:2]
        self.now, self.over = message, bool(message["ended"])
        self.messages += 1

    def lose(self) -> None:
        """Note that the session's process is gone; one that said goodbye has ended."""
        self.lost = not self.over
        self.messages += 1

    def whole(self) -> dict[str, Any]:
        """Return everything, for a new viewer."""
        return {"all": True, "rows": self.history, "posterior": self.posterior, **self._present()}

    def since(self, count: int) -> dict[str, Any]:
        """Return what is new after so many rows."""
        new = min(self.count - count, len(self.recent))
        rows = list(self.recent)[len(self.recent) - new :]
        return {"rows": rows, "posterior": self.posterior, **self._present()}

    def _present(self) -> dict[str, Any]:
        return {"lost": self.lost, **self.now}


class Requests:
    """What viewers ask, handed on at a person's pace, since the session takes its time for each."""

    def __init__(
        self, state: State, ask: Callable[[dict[str, Any]], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._state = state
        self._ask = ask
        self._clock = clock
        self._marked, self._done = -float("inf"), set[str]()

    def take(self, do: str, words: dict[str, str]) -> tuple[int, str]:
        """Take a request; return its HTTP status and why it is refused ("" where it is not)."""
        state, once = self._state, do
        if state.lost or state.over:
            return 409, "the session is not there any more"
        if do == "bad":
            if self._clock() - self._marked < PAGE.mark_every_s:
                return 429, "it was marked a moment ago"
            self._marked, once = self._clock(), ""  # each of them counts
        elif do == "answer":
            once = str((state.now.get("question") or {}).get("number", ""))
            if not once or words.get("question") != once:
                return 409, "this is not asked any more"
        if once not in self._done:  # a stop, and the answer to a question
            self._ask({"do": do, **words})
        if once:
            self._done.add(once)
        return 200, ""


class Gate:
    """Lets in who calls this computer by its own name, comes from its own page, and has the token."""

    def __init__(self, app: ASGIApp, *, port: int, token: str) -> None:
        self.app = app
        self._token = token
        self.cookie = f"thermogrip_{port}"
        self._hosts = tuple(f"{name}:{port}" for name in (HOST, "localhost"))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse, or pass on."""
        from starlette.requests import Request
        from starlette.responses import PlainTextResponse

        why = self.refused(Request(scope)) if scope["type"] == "http" else "only HTTP is served"
        if why:
            await PlainTextResponse(why + "\n", 403)(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def refused(self, request: Request) -> str:
        """Return why a request is refused, "" where it is not."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if host not in self._hosts:  # a rebound DNS name, whatever it knows
            return "refused: this address is not the page's own"
        if origin != f"http://{host}" and (origin is not None or request.method == "POST"):
            return "refused: this comes from another page"
        # the token is in the address that the terminal shows, and in a cookie from then on
        shown_token = request.cookies.get(self.cookie, "")
        if request.url.path == "/":
            shown_token = request.query_params.get("token", shown_token)
        if not secrets.compare_digest(shown_token.encode(), self._token.encode()):
            return "refused: open the address that the terminal shows, with its token"
        return ""


def page_text() -> tuple[str, str]:
    """Return the page and the policy under which a browser shows it."""
    # it loads nothing from elsewhere, and runs no script but its own, which the browser knows by its hash
    sources = {
        name: (files(__package__) / f"page.{name}").read_text(encoding="utf-8")
        for name in ("html", "css", "js")
    }
    hashes = {
        name: base64.b64encode(hashlib.sha256(sources[name].encode()).digest()).decode()
        for name in ("css", "js")
    }
    policy = (
        f"default-src 'none'; script-src 'sha256-{hashes['js']}'; style-src 'sha256-{hashes['css']}'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return sources["html"].replace("{{css}}", sources["css"]).replace("{{js}}", sources["js"]), policy


def application(state: State, ask: Callable[[dict[str, Any]], None], *, port: int, token: str) -> ASGIApp:
    """Return the page; ``ask`` hears what viewers want."""
    from starlette.applications import Starlette
    from starlette.responses import HTMLResponse, JSONResponse, StreamingResponse
    from starlette.routing import Route

    (text, policy), requests = page_text(), Requests(state, ask)
    safe = {
        "Cache-Control": "no-store",
        "Content-Security-Policy": policy,
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cross-Origin-Resource-Policy": "same-origin",
    }

    async def page(request: Request) -> Response:
        response = HTMLResponse(text, headers=safe)
        response.set_cookie(f"thermogrip_{port}", token, httponly=True, samesite="strict")
        return response

    async def events(request: Request) -> Response:
        return StreamingResponse(watched(), media_type="text/event-stream", headers=safe)

    async def watched() -> AsyncIterator[str]:
        state.viewers += 1
        ask({"do": "viewers", "count": state.viewers})
        try:
            async for event in _events(state):
                yield event
        finally:
            state.viewers -= 1
            ask({"do": "viewers", "count": state.viewers})

    async def act(request: Request) -> Response:
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > PAGE.most_bytes:
                return JSONResponse({"refused": "too long"}, 413)
        try:
            words = _request_words(body)
        except (ValueError, RecursionError):
            return JSONResponse({"refused": "no JSON object of text"}, 400)
        status, refused = requests.take(request.url.path.lstrip("/"), words)
        return JSONResponse({"refused": refused} if refused else {"done": True}, status)

    # POST alone: no link and no image of another page can ask for anything
    actions = [Route(f"/{name}", act, methods=["POST"]) for name in ("stop", "bad", "answer")]
    app = Starlette(routes=[Route("/", page), Route("/events", events), *actions])
    return Gate(app, port=port, token=token)


def _request_words(body: bytes) -> dict[str, str]:
    """Return what a request says; ValueError or RecursionError where it is no JSON object of texts."""
    content = parse_json(body.decode())
    if not isinstance(content, dict):
        raise ValueError("no object")
    return {key: str(content[key])[: PAGE.most_text] for key in ("text", "question") if key in content}


async def _events(state: State) -> AsyncIterator[str]:
    """Yield what a viewer is sent, until the session is over."""
    count, messages = state.count, state.messages
    content, last_sent_s = state.whole(), 0.0
    while True:
        if content:
            last_sent_s = time.monotonic()
            yield f"data: {json.dumps(content)}\n\n"
        if state.over:
            return
        await asyncio.sleep(PAGE.every_s)
        content = {}
        if messages != state.messages:
            content = state.since(count)
            count, messages = state.count, state.messages
        elif time.monotonic() - last_sent_s > PAGE.alive_s:
            content = {"rows": [], "posterior": state.posterior, **state._present()}


async def _serve(settings: dict[str, Any], lines: Iterator[bytes], listener: socket.socket | None) -> None:
    """Serve until the session is over."""
    state, ended = State(), asyncio.Event()
    loop = asyncio.get_running_loop()
    mirror: Callable[[dict[str, Any]], None] | None = None
    if settings["foxglove"] is not None:
        from thermogrip.live.foxglove import Mirror

        mirror = Mirror(settings["foxglove"], settings["title"], settings["layout"]).take
    server = None if listener is None else _server(state, settings["token"], listener)
    _send_to_session({"ready": True})

    def take(line: bytes) -> None:
        message = json.loads(line, parse_constant=lambda _: None)  # NaN: the session has no time to look
        if mirror is not None:
            mirror(message)
        state.take(message)
        if state.over:
            ended.set()

    def lose() -> None:
        state.lose()
        if state.over or server is None:
            ended.set()
        loop.call_later(PAGE.linger_s, ended.set)

    def hear() -> None:
        for line in lines:
            loop.call_soon_threadsafe(take, line)
        loop.call_soon_threadsafe(lose)

    threading.Thread(target=hear, daemon=True).start()
    running = None if server is None else asyncio.create_task(server.serve(sockets=[listener]))  # type: ignore[list-item]
    await ended.wait()
    await asyncio.sleep(2 * PAGE.every_s)  # every viewer is sent the end
    if server is not None and running is not None:
        server.should_exit = True
        await running


def _server(state: State, token: str, listener: socket.socket) -> Server:
    from uvicorn import Config, Server

    app = application(state, _send_to_session, port=listener.getsockname()[1], token=token)
    plain: Any = {"loop": "asyncio", "http": "h11", "ws": "none", "lifespan": "off", "proxy_headers": False}
    quiet: Any = {"log_level": "critical", "access_log": False, "server_header": False}
    return Server(Config(app, **plain, **quiet, timeout_graceful_shutdown=1))


def _send_to_session(content: dict[str, Any]) -> None:
    """Say something to the session."""
    with suppress(OSError):  # one that is gone hears nothing
        sys.stdout.write(json.dumps(content) + "\n")
        sys.stdout.flush()


def _stdin_lines() -> Iterator[bytes]:
    """Yield the lines of standard input."""
    # unbuffered: a thread that waits in a buffer holds up the end
    unfinished = b""
    while data := os.read(0, 1 << 16):
        *whole, unfinished = (unfinished + data).split(b"\n")
        yield from whole


def main() -> None:
    """Serve what comes on standard input; its first line has the settings."""
    if hasattr(os, "nice"):
        os.nice(5)  # the session comes first
    lines = _stdin_lines()
    settings = json.loads(next(lines))
    listener = None
    try:
        if settings["port"] is not None:
            listener = socket.create_server((HOST, settings["port"]))
            _send_to_session({"port": listener.getsockname()[1]})
        asyncio.run(_serve(settings, lines, listener))
    except OSError as error:
        _send_to_session({"error": os.strerror(error.errno) if error.errno else str(error)})
    except RuntimeError as error:  # of Foxglove's server
        _send_to_session({"error": str(error)})


if __name__ == "__main__":
    main()
