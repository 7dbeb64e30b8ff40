"""The page's process: whom it lets in, what it keeps and sends, and when it ends."""

from __future__ import annotations

import http.client
import re
import socket
import threading
import time
from contextlib import suppress
from typing import Any

import pytest

from tests.live.conftest import Running, paced_twin
from thermogrip.datasets.errors import UserError
from thermogrip.live.server import PAGE, Requests, State, page_text
from thermogrip.live.watch import Show, Watch
from thermogrip.report.console import Console


def ask(watch: Watch, method: str, path: str, body: str = "{}", **headers: str | None) -> tuple[int, str]:
    """Return status and beginning of an answer; by default the request is the page's own."""
    host, token = re.fullmatch(r"http://([^/]+)/\?token=(.+)", watch.address).groups()
    given: dict[str, str | None] = {"Host": host, "Cookie": f"thermogrip_{host.split(':')[1]}={token}"}
    given |= {"Origin": f"http://{host}"} if method == "POST" else {}
    given |= {name.title(): value for name, value in headers.items()}
    line = http.client.HTTPConnection(host, timeout=30)
    line.putrequest(method, path, skip_host=True)
    for name, value in given.items():
        if value is not None:
            line.putheader(name, value)
    data = body.encode() if method == "POST" else b""
    line.putheader("Content-Length", str(len(data)))
    line.endheaders(data)
    answer = line.getresponse()
    found = answer.status, answer.read(200).decode()
    line.close()
    return found


FORGED: dict[str, tuple[str, str, dict[str, str | None]]] = {
    "a rebound name": ("GET", "/events", {"host": "evil.example:80"}),
    "a rebound name, to stop": ("POST", "/stop", {"host": "evil.example", "origin": "http://evil.example"}),
    "no port in the name": ("POST", "/stop", {"host": "127.0.0.1"}),
    "no name": ("POST", "/stop", {"host": None}),
    "another origin": ("POST", "/stop", {"origin": "http://evil.example"}),
    "another port's origin": ("POST", "/stop", {"origin": "http://127.0.0.1:1"}),
    "an opaque origin": ("POST", "/stop", {"origin": "null"}),
    "no origin": ("POST", "/stop", {"origin": None}),
    "another origin that reads": ("GET", "/events", {"origin": "http://evil.example"}),
    "no token": ("POST", "/stop", {"cookie": None}),
    "another token": ("POST", "/stop", {"cookie": "thermogrip_1=x"}),
    "a token of letters that are none": ("GET", "/?token=%C3%A9", {"cookie": None}),
    "the page without a token": ("GET", "/", {"cookie": None}),
    "events without a token": ("GET", "/events", {"cookie": None}),
    "the token in an action's address": ("POST", "/stop?token={token}", {"cookie": None}),
}


def test_forged_requests_are_refused_and_change_nothing(watch: Watch) -> None:
    token = watch.address.split("token=")[1]
    for name, (method, path, headers) in FORGED.items():
        status, said = ask(watch, method, path.format(token=token), **headers)
        assert (status, said.startswith("refused")) == (403, True) or (name, status) == ("no name", 400), name
    assert ask(watch, "GET", "/stop")[0] == 405
    assert ask(watch, "GET", "/bad")[0] == 405
    assert watch.operator.stop_asked == ""
    assert ask(watch, "GET", f"/?token={token}", cookie=None)[0] == 200
    assert ask(watch, "GET", "/")[0] == 200  # the cookie is enough
    assert ask(watch, "POST", "/stop") == (200, '{"done":true}')
    assert _soon(lambda: watch.operator.stop_asked) == "the page"


def _soon(look: Any) -> Any:
    """Return what a look finds, once it finds something."""
    for _ in range(200):
        if found := look():
            return found
        time.sleep(0.05)
    return look()


def test_what_is_no_request_is_refused_and_is_no_traceback(
    watch: Watch, capfd: pytest.CaptureFixture[str]
) -> None:
    for body, status in [
        ("{}" * 3000, 413), ("no JSON", 400), ("[1]", 400), ('"text"', 400), (r'{"text": "\ud800"}', 400),
        ("[" * 4000, 400), ('{"text": ' + "[" * 4000, 400), ('{"text": ' + "9" * 4080 + "}", 200),
    ]:  # fmt: skip
        assert ask(watch, "POST", "/bad", body)[0] == status, body[:20]
    marks = _soon(watch.operator.take_bad)
    assert marks == ["9" * PAGE.most_text]
    assert capfd.readouterr().err.count("\n") <= 2  # the address, and a line of the view


def test_a_body_without_an_end_and_one_that_is_cut_off_cost_nothing(
    watch: Watch, capfd: pytest.CaptureFixture[str]
) -> None:
    host, token = re.fullmatch(r"http://([^/]+)/\?token=(.+)", watch.address).groups()
    name, port = host.split(":")
    head = f"POST /bad HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n"
    head += f"Cookie: thermogrip_{port}={token}\r\n"
    with socket.create_connection((name, int(port)), timeout=30) as line:  # it says 10, and never ends
        line.sendall(f"{head}Content-Length: 10\r\nTransfer-Encoding: chunked\r\n\r\n".encode())
        with suppress(OSError):  # hung up on
            for _ in range(2000):
                line.sendall(b"400\r\n" + b"x" * 0x400 + b"\r\n")
        with suppress(ConnectionError):
            assert line.recv(100).startswith((b"HTTP/1.1 413", b"HTTP/1.1 400"))
    with socket.create_connection((name, int(port)), timeout=30) as line:
        line.sendall(f"{head}Content-Length: 1000\r\n\r\n{{".encode())
    assert ask(watch, "POST", "/stop") == (200, '{"done":true}')
    assert _soon(lambda: watch.operator.stop_asked) == "the page"
    assert watch.operator.take_bad() == []
    assert capfd.readouterr().err.count("\n") <= 2


def test_requests_reach_the_session_at_a_person_s_pace() -> None:
    state, heard, now = State(), [], [0.0]
    requests = Requests(state, heard.append, lambda: now[0])
    state.take(message([], question={"number": 2}))
    found = []
    for k in range(3000):  # in a second and a half
        now[0] = k / 2000
        found.append(requests.take("bad", {"text": str(k)})[0])
        assert requests.take("stop", {}) == (200, "")
        assert requests.take("answer", {"question": "2"}) == (200, "")
        assert requests.take("answer", {"question": "1"})[0] == 409
    assert [said["do"] for said in heard] == ["bad", "stop", "answer", "bad"]
    assert (found.count(200), found.count(429)) == (2, 2998)
    state.take(message([], question=None))
    assert requests.take("answer", {"question": "2"})[0] == 409


def test_the_page_runs_its_own_script_only_and_asks_nobody_else() -> None:
    text, policy = page_text()
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert not re.findall(r"https?://|//cdn|@import|src=|href=| on[a-z]+=| style=", text)
    assert text.count("<script>") == text.count("<style>") == 1


def message(
    rows: list[list[float]], columns: tuple[str, ...] = ("time_s", "a"), **more: Any
) -> dict[str, Any]:
    return {"rows": rows, "columns": list(columns), "posterior": [], "ended": "", **more}


def test_a_viewer_gets_all_once_and_then_what_is_new() -> None:
    state = State()
    state.take(message([[0.0, 1.0], [1.0, 2.0]]))
    seen = state.count
    assert state.whole()["rows"] == [[0.0, 1.0], [1.0, 2.0]]
    state.take(message([[2.0, 3.0]]))
    assert state.since(seen)["rows"] == [[2.0, 3.0]]
    assert state.since(state.count)["rows"] == []
    state.take(message([[0.0, 9.0]]))  # another session
    assert state.whole()["rows"] == [[0.0, 9.0]]


def test_old_rows_are_thinned_and_new_ones_are_whole() -> None:
    state = State()
    for k in range(3 * PAGE.most_rows):
        state.take(message([[float(k), 0.0]]))
    times = [row[0] for row in state.whole()["rows"]]
    assert len(times) <= PAGE.most_rows
    assert times[0] == 0.0
    assert times == sorted(times)
    assert times[-1000:] == [float(k) for k in range(3 * PAGE.most_rows - 1000, 3 * PAGE.most_rows)]


def test_a_posterior_begins_anew_with_each_contact() -> None:
    state = State()
    state.take(message([], posterior=[[0.1, {"wood": 0.5}], [0.2, {"wood": 0.6}]]))
    state.take(message([], posterior=[[0.3, {"wood": 0.7}]]))
    assert [row[0] for row in state.posterior] == [0.1, 0.2, 0.3]
    state.take(message([], posterior=[[0.1, {"wood": 0.4}]]))
    assert state.posterior == [[0.1, {"wood": 0.4}]]


def test_only_a_session_that_did_not_say_goodbye_is_lost() -> None:
    state = State()
    state.take(message([]))
    state.lose()
    assert state.whole()["lost"]
    state.take(message([], ended="settled"))
    state.lose()
    assert not state.whole()["lost"]


def test_a_port_that_is_taken_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(UserError, match=r"cannot be served \(.*in use\)"),
            Watch("run", Console(), Show(live=port)),
        ):
            raise AssertionError


def test_the_page_of_a_twin_stays_until_its_viewer_has_left() -> None:
    watch = Watch("run", Console(), Show(live=0, pace=10.0)).__enter__()
    process = watch.page
    assert process is not None
    Running(watch, paced_twin(), settle_timeout=5.0).result()
    leaving = threading.Thread(target=watch.__exit__, args=(None, None, None))
    leaving.start()
    host, token = re.fullmatch(r"http://([^/]+)/\?token=(.+)", watch.address).groups()
    viewer = http.client.HTTPConnection(host, timeout=30)
    viewer.request("GET", "/events", headers={"Cookie": f"thermogrip_{host.split(':')[1]}={token}"})
    answer = viewer.getresponse()
    # who comes after the end sees it all the same, in the first message or in one that was on its way
    assert any(b"not settled" in answer.readline() for _ in range(20))
    assert _soon(lambda: watch.viewers) == 1
    assert (leaving.is_alive(), process.poll()) == (True, None)
    answer.close()
    viewer.close()
    leaving.join(60.0)
    assert (leaving.is_alive(), process.returncode) == (False, 0)
