"""The server over real connections: what it answers, to whom, and how it ends."""

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from schemas.errors import InputError
from services.look import server as module
from services.look.live import Follower
from services.look.server import HEADERS, Place, choose_place, serving

ROOT = Path(__file__).resolve().parents[3]
TOKEN = "a-token-of-some-length"


@pytest.fixture(scope="module")
def follower(shown):
    follower = Follower(shown, 2)
    follower.look()
    follower.report()
    return follower


@pytest.fixture(scope="module")
def port(follower):
    with serving(follower, Place("127.0.0.1", 0, None)) as place:
        yield place.port


@pytest.fixture(scope="module")
def closed_port(follower):
    with serving(follower, Place("127.0.0.1", 0, TOKEN)) as place:
        yield place.port


def ask(port: int, path: str, method: str = "GET", **headers: str):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer, data


def raw(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), 20) as link:
        link.sendall(request)
        link.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: link.recv(65_536), b""))


def test_the_page_and_all_that_it_names_are_there(port):
    answer, data = ask(port, "/")
    assert (answer.status, answer.headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    named = set(re.findall(r'(?:src|href)="(/[^"]*)"', data.decode()))
    assert len([path for path in named if path.startswith("/picture/")]) >= 14
    for path in sorted(named):
        found, body = ask(port, path)
        assert found.status == 200 and body, path
        assert int(found.headers["Content-Length"]) == len(body)
        if path.endswith("jpeg"):
            assert found.headers["Content-Type"] == "image/jpeg" and body[:2] == b"\xff\xd8"


def test_the_state_is_what_the_folder_says(port):
    state = json.loads(ask(port, "/live.json")[1])
    assert state["name"] == "small" and "Finished" in state["live"]
    sections = json.loads(ask(port, "/sections.json")[1])
    assert list(sections["sections"]) == state["shape"].split()


def test_every_answer_has_the_headers_of_safety(port):
    for path, method in (("/", "GET"), ("/nothing", "GET"), ("/", "POST"), ("/page.js", "HEAD")):
        answer, _ = ask(port, path, method)
        assert {name: answer.headers[name] for name in HEADERS} == HEADERS
        assert "Python" not in answer.headers["Server"]
    assert (
        "unsafe" not in HEADERS["Content-Security-Policy"]
        and "default-src 'none'" in HEADERS["Content-Security-Policy"]
    )


def test_a_head_has_the_headers_of_its_get_and_no_body(port):
    answer, data = ask(port, "/page.css", "HEAD")
    assert answer.status == 200 and data == b""
    assert answer.headers["Content-Length"] == ask(port, "/page.css")[0].headers["Content-Length"]


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "PROPFIND"])
def test_whatever_would_write_is_refused(port, method):
    answer, _ = ask(port, "/", method)
    assert (answer.status, answer.headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/..",
            "/../../etc/passwd",
            "/picture/../page.css",
            "/picture/..%2f..%2fjob.yaml",
            "//etc/passwd",
            "/picture/",
        ),
        *(
            "/job.yaml",
            "/manifest/",
            "/box/RGB00000.png",
            "/web/page.css",
            "/page.css/",
            "/page.html",
            "/%2e%2e/x",
            "/picture",
        ),
        *("/page.css%00", "/\\..\\x", "/http://[", "/favicon.ico"),
    ],
)
def test_no_path_leads_to_a_file_or_a_listing(port, path):
    answer, data = ask(port, path)
    assert answer.status == 404 and len(data) < 200


def test_an_address_that_is_none_is_not_answered(port):
    assert b" 404 " in raw(port, b"GET http://[::1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n").splitlines()[0]
    assert b" 200 " not in raw(port, b"GET\r\n\r\n").splitlines()[0]


def test_a_page_elsewhere_that_points_its_name_here_reads_nothing(port):
    assert ask(port, "/", Host="evil.example:8722")[0].status == 403
    assert b" 403 " in raw(port, b"GET / HTTP/1.0\r\n\r\n").splitlines()[0]
    assert ask(port, "/", Host=f"localhost:{port}")[0].status == 200


def test_without_its_token_nothing_is_told(closed_port):
    for path in ("/", "/live.json", "/page.css", "/nothing", "/?token=wrong", f"/?token={TOKEN[:-1]}"):
        answer, data = ask(closed_port, path)
        assert answer.status == 401 and b"small" not in data and answer.headers["Set-Cookie"] is None


def test_the_token_leaves_the_address_and_stays_in_a_cookie_that_scripts_cannot_read(closed_port):
    answer, _ = ask(closed_port, f"/?token={TOKEN}")
    cookie = answer.headers["Set-Cookie"]
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
    assert ask(closed_port, "/", Cookie=cookie.partition(";")[0])[0].status == 200


def test_a_place_that_others_reach_has_a_token_and_a_weak_one_is_refused():
    assert choose_place("127.0.0.1", 1, None).token is None
    assert len(choose_place("0.0.0.0", 1, None).token) == 32
    assert len(choose_place("127.0.0.1", 1, "auto").token) == 32
    assert choose_place("::", 1, TOKEN).token == TOKEN
    for weak in ("short", "", "ä" * 20, "a" * 15 + "\n" * 3):
        with pytest.raises(InputError, match="at least 16 plain"):
            choose_place("0.0.0.0", 1, weak)


def test_the_address_is_one_that_a_person_can_open():
    assert Place("127.0.0.1", 8722, None).address == "http://127.0.0.1:8722/"
    assert Place("::1", 8722, "a b&c").address == "http://[::1]:8722/?token=a%20b%26c"
    assert Place("0.0.0.0", 8722, TOKEN).address == f"http://{socket.gethostname()}:8722/?token={TOKEN}"


def test_a_port_that_is_taken_is_told_with_its_remedy(follower, port):
    told = f"127.0.0.1 port {port} cannot be opened.*choose another --port"
    with pytest.raises(InputError, match=told), serving(follower, Place("127.0.0.1", port, None)):
        pass


def test_connections_beyond_the_most_are_closed_and_stalled_ones_end(follower, monkeypatch):
    monkeypatch.setattr(module, "MOST_REQUESTS", 2)
    monkeypatch.setattr(module._Handler, "timeout", 0.5)
    with serving(follower, Place("127.0.0.1", 0, None)) as place:
        stalled = [socket.create_connection(("127.0.0.1", place.port), 20) for _ in range(2)]
        time.sleep(0.2)
        with socket.create_connection(("127.0.0.1", place.port), 20) as third:
            assert third.recv(1) == b""
        for link in stalled:
            assert link.recv(1) == b""  # after half a second
            link.close()
        assert ask(place.port, "/page.css")[0].status == 200


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.minute)])
def test_the_command_says_where_it_listens_and_ends_at_a_signal(shown, number):
    command = [
        sys.executable,
        "-m",
        "services.cli.main",
        "serve",
        str(shown.root),
        "--port",
        "0",
        "--token",
        "auto",
        "--json",
    ]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            lines = [process.stdout.readline() for _ in range(2)]
            told = json.loads(lines[1])
            assert told["address"] in lines[0] and told["ok"]
            assert ask(told["port"], "/")[0].status == 401
            assert ask(told["port"], "/live.json", Authorization=f"Bearer {told['token']}")[0].status == 200
            process.send_signal(number)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, out, err) == (0, "", "")
