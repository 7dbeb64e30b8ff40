"""The page's process: whom it lets in, what it keeps and sends, and when it ends."""

from __future__ import annotations

import http.client
import json
import re
import socket
import time
from typing import Any

import pytest

from tests.live.conftest import Running, paced_twin
from thermogrip.datasets.errors import UserError
from thermogrip.live.server import MOST_ROWS, MOST_TEXT, State, page_text
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


@pytest.mark.parametrize(
    ("body", "status"), [("{}" * 3000, 413), ("no JSON", 400), ("[1]", 200), ('"text"', 400), ("{}", 200)]
)
def test_what_is_no_request_is_refused(body: str, status: int, watch: Watch) -> None:
    assert ask(watch, "POST", "/answer", body)[0] == status


def test_a_mark_is_cut_to_its_length(watch: Watch) -> None:
    assert ask(watch, "POST", "/bad", json.dumps({"text": "x" * 1000}))[0] == 200
    assert _soon(watch.operator.take_bad) == ["x" * MOST_TEXT]


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
    for k in range(3 * MOST_ROWS):
        state.take(message([[float(k), 0.0]]))
    times = [row[0] for row in state.whole()["rows"]]
    assert len(times) <= MOST_ROWS
    assert times[0] == 0.0
    assert times == sorted(times)
    assert times[-1000:] == [float(k) for k in range(3 * MOST_ROWS - 1000, 3 * MOST_ROWS)]


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


def test_the_process_ends_with_the_session() -> None:
    with Watch("run", Console(), Show(live=0)) as watch:
        process = watch._page
        assert process is not None
        Running(watch, paced_twin(), settle_timeout=5.0).result()
    assert process.returncode == 0
