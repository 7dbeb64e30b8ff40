"""One grasp in, one answer out: requests in JSON, over pipes or over HTTP on this computer.

A request is an object with ``time_s`` and ``t_surface_degC`` (null is a lost sample), and what else is known
of the grasp under the names of a meta file (``t_object_nominal_degC``, ...); ``id``, a number or text, comes
back.
The answer is the row that ``classify`` writes, or ``error``, one line.  Over pipes both are lines of JSON.
Over HTTP a request is the body of a POST; the server has a loopback address, takes only requests that call it
by one, and none of a web page: a page elsewhere, opened in a browser here, must not learn what is touched.  A
body must come within some seconds: one that never ends would hold up the end of the server.
Requests wait for one thread, in the order of their arrival: an answer is all arithmetic.
"""

from __future__ import annotations

import json
import math
import re
import socket
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.grasp_files import META_NAMES
from thermogrip.datasets.schema import GRASP_NUMBERS, make_grasps, with_lead_in

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp
    from uvicorn import Server

    from thermogrip.datasets.schema import Grasps

MOST_BYTES = 1 << 18  # of a request
BODY_S = 10.0  # for the body of a request to come
HOST = "127.0.0.1"
#: What returns the rows of a record.
Rows: TypeAlias = "Callable[[Grasps], list[dict[str, Any]]]"

_TRACES = {"time_s": "time", "t_surface_degC": "t_surface", "t_surface_2_degC": "t_surface_2"}
_META_FIELDS = {
    META_NAMES.get(name, name) + ("" if unit == "1" else f"_{unit}"): name
    for name, unit in GRASP_NUMBERS.items()
}


def reply(answer: Rows, request: bytes) -> dict[str, Any]:
    """Return the answer to one request, or what is wrong with it."""
    content: Any = {}
    try:
        content = _content(request)
        (row,) = answer(grasp_of(content))
        response = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value  # JSON has no NaN
            for key, value in row.items()
            if key != "grasp_id"
        }
    except UserError as error:
        response = {"error": str(error)}
    return ({"id": content["id"]} if "id" in content else {}) | response


def grasp_of(given: Mapping[str, Any]) -> Grasps:
    """Return the record of one grasp that a request describes."""
    known_keys = {"id", *_TRACES, *_META_FIELDS}
    for name in given:
        if name not in known_keys:
            raise UserError(f"{name!r} is unknown", hint=known_names(name, sorted(known_keys)))
    traces = {ours: _request_numbers(given, name) for name, ours in _TRACES.items() if name in given}
    for name in ("time_s", "t_surface_degC"):
        if _TRACES[name] not in traces:
            raise UserError(f"no {name}", hint="give time_s and t_surface_degC, lists of one length")
    if len({len(values) for values in traces.values()}) > 1:
        raise UserError("lists of several lengths", hint="null is a lost sample")
    about = {
        ours: [_request_number(name, given[name])] for name, ours in _META_FIELDS.items() if name in given
    }
    second = [traces["t_surface_2"]] if "t_surface_2" in traces else None
    record = make_grasps(
        traces["time"], [traces["t_surface"]], ["grasp"], name="request", t_surface_2=second, **about
    )
    record = with_lead_in(record)
    time, has_sample = record["time"].values, ~record["t_surface"].isnull().values[0]
    if not (has_sample & (time < 0)).any() or not (has_sample & (time > 0)).any():
        raise UserError("no sample before 0 s or none after", hint="0 s is the closed message")
    return record


def serve_lines(answer: Rows, requests: BinaryIO, answers: BinaryIO) -> int:
    """Answer lines of JSON until they end; return their number."""
    n = 0
    while line := requests.readline(MOST_BYTES + 2):
        if not line.endswith(b"\n") and len(line) > MOST_BYTES:
            response = _too_long()
            while line and not line.endswith(b"\n"):
                line = requests.readline(MOST_BYTES)
        elif line.strip():
            response = reply(answer, line)
        else:
            continue
        answers.write(json.dumps(response, allow_nan=False).encode() + b"\n")
        answers.flush()
        n += 1
    return n


def application(replies: Callable[[bytes], dict[str, Any]], port: int) -> ASGIApp:
    """Return the server of answers for uvicorn; it is called by the loopback's names and this port.
    ``replies`` returns what :func:`reply` does, one after the other in a thread."""
    import asyncio

    from starlette.applications import Starlette
    from starlette.requests import ClientDisconnect
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    thread = ThreadPoolExecutor(1)
    hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    async def ask(request: Request) -> Response:
        why = "" if request.headers.get("host") in hosts else "refused: this address is not the server's own"
        if "origin" in request.headers:
            why = "refused: this comes from a web page"
        if why:
            return JSONResponse({"error": why}, 403)
        body, end = bytearray(), {"connection": "close"}
        declared = request.headers.get("content-length", "0")  # digits, or it does not come this far
        if len(declared) > 18 or int(declared) > MOST_BYTES:
            return JSONResponse(_too_long(), 413, end)
        try:
            async with asyncio.timeout(BODY_S):
                async for piece in request.stream():
                    body += piece
                    if len(body) > MOST_BYTES:
                        return JSONResponse(_too_long(), 413, end)
        except TimeoutError:
            return JSONResponse({"error": f"the request did not come within {BODY_S:g} s"}, 408, end)
        except ClientDisconnect:  # nobody is there to read an answer
            return Response(status_code=400)
        response = await asyncio.get_running_loop().run_in_executor(thread, replies, bytes(body))
        return JSONResponse(response, 400 if "error" in response else 200)

    return Starlette(routes=[Route("/", ask, methods=["POST"])])


def listen(port: int) -> socket.socket:
    """Return a socket on the loopback; UserError where the port (0: any) is taken."""
    try:
        return socket.create_server((HOST, port))  # listens: who reads the address may call at once
    except OSError as error:
        raise UserError(f"port {port} cannot be used ({error.strerror})", hint="choose another") from error


def server(replies: Callable[[bytes], dict[str, Any]], listening: socket.socket) -> Server:
    """Return what answers over HTTP once its ``run(sockets=[listening])`` is called, as
    :func:`application`."""
    import uvicorn

    app = application(replies, listening.getsockname()[1])
    config = uvicorn.Config(app, log_level="warning", access_log=False, lifespan="off")
    return uvicorn.Server(config)


def _content(request: bytes) -> dict[str, Any]:
    try:
        content = json.loads(request)
    except (ValueError, RecursionError) as error:
        raise UserError(f"is no JSON ({error})", hint="write an object on one line") from error
    if not isinstance(content, dict):
        raise UserError("is no JSON object", hint="write an object on one line")
    name = content.get("id", 0)
    if not isinstance(name, str | int) or (isinstance(name, str) and re.search("[\ud800-\udfff]", name)):
        del content["id"]
        raise UserError("id is no text and no whole number", hint="leave it out, or number the requests")
    return content


def _request_numbers(given: Mapping[str, Any], name: str) -> list[float]:
    if not isinstance(given[name], list):
        raise UserError(f"{name} is no list", hint="write a list of numbers")
    return [_request_number(name, value) for value in given[name]]


def _request_number(name: str, value: Any) -> float:
    """Return a number of a request; null is NaN."""
    if value is None:
        return math.nan
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise UserError(
            f"{name} has {str(value)[:20]!r}, which is no finite number", hint="write one or null"
        )
    return number


def _too_long() -> dict[str, Any]:
    return {"error": f"request of more than {MOST_BYTES} bytes"}
