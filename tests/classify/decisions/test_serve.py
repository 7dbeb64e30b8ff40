"""Requests for one answer: what is refused, that nothing is lost, and that only this computer is served."""

from __future__ import annotations

import http.client
import io
import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Thread
from typing import Any

import numpy as np
import pytest

from thermogrip.classify.decisions import serve
from thermogrip.classify.decisions.serve import HOST, MOST_BYTES, grasp_of, listen, reply, serve_lines, server
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

GRASP: dict[str, Any] = {"time_s": [-1.0, 0.0, 1.0], "t_surface_degC": [23.0, None, 25.0]}


def answer(record: Grasps) -> list[dict[str, Any]]:
    """Return the last reading as the answer."""
    last = float(record["t_surface"].values[0, -1])
    row = {"grasp_id": "grasp", "material": "iron", "p_iron": last, "p_unknown": float("nan")}
    return [row]


def asked(**more: Any) -> dict[str, Any]:
    return reply(answer, json.dumps(GRASP | more).encode())


def test_an_answer_is_the_row_with_the_id_of_its_request() -> None:
    found = {"material": "iron", "p_iron": 25.0, "p_unknown": None}
    assert asked() == found
    assert asked(id="a") == {"id": "a"} | found


def test_a_request_has_the_names_of_a_meta_file() -> None:
    record = grasp_of(
        GRASP | {"t_object_nominal_degC": 28, "t_ambient_degC": None, "t_surface_2_degC": [1, 2, 3]}
    )
    assert record["t_object"].values.tolist() == [28.0]
    assert np.isnan(record["t_ambient"].values[0])
    assert record["t_surface_2"].values.tolist() == [[1.0, 2.0, 3.0]]
    assert np.isnan(record["t_surface"].values[0, 1])


@pytest.mark.parametrize(
    ("more", "words"),
    [({"colour": 1}, "'colour' is unknown; .*t_object_nominal_degC"),
     ({"time_s": 3}, "time_s is no list"),
     ({"time_s": [0, 1]}, "lists of several lengths"),
     ({"time_s": [0, 0, 1]}, "time does not increase"),
     ({"time_s": [1, 2, 3]}, "no sample before 0 s"),
     ({"t_surface_degC": ["23", 24, 25]}, "t_surface_degC has '23', which is no finite number"),
     ({"t_surface_degC": [10**400, 24, 25]}, "no finite number"),
     ({"t_surface_degC": [None, None, None]}, "no temperature"),
     ({"t_ambient_degC": True}, "t_ambient_degC has 'True'"),
     ({"id": [1]}, "id is no text and no whole number"),
     ({"id": "\ud800"}, "id is no text and no whole number")],  # half a character, which no answer can hold
)  # fmt: skip
def test_what_is_no_grasp_is_refused_in_one_line(more: dict[str, Any], words: str) -> None:
    found = asked(**more)
    assert set(found) == {"error"}
    assert "\n" not in found["error"]
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(found["error"])


@pytest.mark.parametrize("text", [b"{", b"[]", b"\xff", b"[" * 10_000, b'{"time_s": [NaN]}', b""])
def test_what_is_no_json_object_is_refused(text: bytes) -> None:
    assert set(reply(answer, text)) == {"error"}


def test_lines_are_answered_in_order_and_one_too_long_is_skipped_whole() -> None:
    lines = [json.dumps(GRASP | {"id": k}).encode() for k in range(3)]
    lines[1:1] = [b"x" * (3 * MOST_BYTES), b"", b"{"]
    out = io.BytesIO()
    assert serve_lines(answer, io.BytesIO(b"\n".join(lines)), out) == 5
    found = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [each.get("id") for each in found] == [0, None, None, 1, 2]
    assert found[1]["error"] == f"request of more than {MOST_BYTES} bytes"


@pytest.fixture
def port() -> Iterator[int]:
    """Return the port of a server that runs during the test."""
    listening = listen(0)
    found = server(partial(reply, answer), listening)
    thread = Thread(target=found.run, kwargs={"sockets": [listening]})
    thread.start()
    while not found.started:
        time.sleep(0.01)
    yield listening.getsockname()[1]
    found.should_exit = True
    thread.join()


def post(port: int, body: bytes, method: str = "POST", **headers: str) -> tuple[int, Any]:
    client = http.client.HTTPConnection(HOST, port, timeout=20)
    client.request(method, "/", body, headers)
    response = client.getresponse()
    text = response.read()
    client.close()
    return response.status, json.loads(text) if text.startswith(b"{") else text


def test_four_clients_at_once_get_their_own_answers(port: int) -> None:
    def client(of: int) -> list[Any]:
        line = http.client.HTTPConnection(HOST, port, timeout=20)
        found = []
        for k in range(50):
            line.request("POST", "/", json.dumps(GRASP | {"id": f"{of}-{k}"}))
            found.append(json.loads(line.getresponse().read())["id"])
        line.close()
        return found

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(client, range(4)))
    assert found == [[f"{of}-{k}" for k in range(50)] for of in range(4)]


def test_over_http_too_only_grasps_are_answered(port: int) -> None:
    assert post(port, json.dumps(GRASP).encode())[0] == 200
    status, found = post(port, b"{")
    assert (status, set(found)) == (400, {"error"})
    assert post(port, b"", "GET")[0] == 405


def test_a_body_that_is_too_long_is_refused_before_it_is_read(port: int) -> None:
    client = socket.create_connection((HOST, port), timeout=20)
    head = f"POST / HTTP/1.1\r\nHost: {HOST}:{port}\r\nContent-Length: {1 << 40}\r\n\r\n"
    client.sendall(head.encode() + b"x")
    assert client.recv(100).startswith(b"HTTP/1.1 413")
    client.close()


def test_a_body_in_chunks_is_read_as_far_as_it_may_be_long(port: int) -> None:
    body = json.dumps(GRASP).encode()
    client = http.client.HTTPConnection(HOST, port, timeout=20)
    client.request("POST", "/", iter([body[:9], body[9:]]), encode_chunked=True)
    assert json.loads(client.getresponse().read())["material"] == "iron"
    client.putrequest("POST", "/")
    client.putheader("Transfer-Encoding", "chunked")
    client.endheaders()
    client.send(b"%x\r\n" % (MOST_BYTES + 1) + b"x" * (MOST_BYTES + 1))
    assert client.getresponse().status == 413
    client.close()


def test_a_client_that_stops_midway_holds_nothing_up(
    port: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    head = f"POST / HTTP/1.1\r\nHost: {HOST}:{port}\r\nContent-Length: 100\r\n\r\n{{".encode()
    gone = socket.create_connection((HOST, port), timeout=20)
    gone.sendall(head)
    gone.close()
    monkeypatch.setattr(serve, "BODY_S", 0.2)
    waits = socket.create_connection((HOST, port), timeout=20)
    waits.sendall(head)
    assert post(port, json.dumps(GRASP).encode())[0] == 200
    assert waits.recv(100).startswith(b"HTTP/1.1 408")
    waits.close()
    assert not caplog.records


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example:80"}, {"Host": HOST}, {"Origin": "http://evil.example"}, {"Origin": "null"}],
)
def test_a_request_by_another_name_or_of_a_web_page_is_refused(port: int, headers: dict[str, str]) -> None:
    status, found = post(port, json.dumps(GRASP).encode(), **headers)
    assert (status, found["error"].startswith("refused")) == (403, True)


def test_only_the_loopback_listens_and_a_taken_port_is_one_line() -> None:
    first = listen(0)
    socket.create_connection(first.getsockname()).close()
    assert first.getsockname()[0] == "127.0.0.1"
    with pytest.raises(UserError, match="cannot be used"):
        listen(first.getsockname()[1])
    first.close()
