"""The live page: how far a folder is, what is followed and shown, who may read it, and the server over real connections."""

import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import InputError
from schemas.job.job import Job
from services.job.record import encode_job, record_job
from services.look import live as module
from services.look import server
from services.look.live import (
    Follower,
    PictureShelf,
    Progress,
    latest_scenes,
    live_html,
    read_progress,
    title_of,
)
from services.look.pictures import picture_of_colour
from services.look.server import HEADERS, Gate, Place, choose_place, is_host_known, is_loopback, is_same, judge, serving
from services.merge.merge import merge
from services.read.status import Running, Status
from services.run.lock import hold_lock
from tests.made_up_scenes import attempt_at
from tests.services.look.conftest import address, scene
from workers.store.local import LocalStore

ROOT = Path(__file__).resolve().parents[3]


def test_a_folder_is_empty_made_stopped_finished_or_unreadable(tmp_path, unflushed):
    store = LocalStore(tmp_path / "out")
    assert read_progress(store).phase == "empty"
    store.prepare()
    assert read_progress(store).phase == "empty"
    store.put("job.yaml", encode_job(record_job(Job(name="small", seed=1, scenes=8), "0" * 64, store.root)))
    progress = read_progress(store)
    assert (progress.phase, progress.name, progress.status.asked) == ("empty", "small", 8)
    attempt_at(store, 0, 4).commit()
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    with hold_lock(store):
        progress = read_progress(store)
    status = progress.status
    assert (progress.phase, status.asked, status.made, progress.done) == ("making", 8, 7, 8)
    assert status.failed == {"intrinsic: left_table": 1}
    assert read_progress(store).phase == "stopped"
    assert latest_scenes(store) == []  # their images are no PNG
    merge(store, 0, 8)
    assert read_progress(store).phase == "finished"
    store.put("job.yaml", b"verso: [")
    progress = read_progress(store)
    assert progress.phase == "unreadable" and "job.yaml" in progress.damage


def test_the_latest_scenes_are_those_of_the_newest_commits(shown):
    for start, age in ((0, 1e9), (2, 2e9)):
        os.utime(shown.path(f"manifest/_commits/{start:010d}.json"), (age, age))
    assert [scene.scene_id for scene in latest_scenes(shown, 3)] == [3, 2, 1]
    os.utime(shown.path("manifest/_commits/0000000000.json"), (3e9, 3e9))
    assert [scene.scene_id for scene in latest_scenes(shown, 3)] == [1, 0, 3]


def test_the_live_section_tells_done_rate_time_left_failures_and_scenes_and_is_no_markup_of_theirs():
    at = tuple(Running(40, "a", scene_id) for scene_id in (41, None, 57, 3, 4, 5))
    status = Status(1000, 380, {"intrinsic: left_table": 2}, 618, 3.14159, None, at[:3], None)
    making = Progress("making", "small", status)
    html = live_html(making, [scene(3, "<i>box"), scene(4, "mug")], address)
    assert "382 of 1,000 scenes · 2 failed · 3.1 a second · 3.3 min left · now at 41, 57" in html
    assert '<progress max="1000" value="382"' in html and "<li>2 failed, intrinsic: left table</li>" in html
    assert html.count("<img") == 4 and "<i>" not in html and title_of(making) == "38% · small"
    many = replace(making, status=replace(status, running=at, scenes_per_s=None))
    assert "2 failed · now at 41, 57, 3, 4 and more" in live_html(many, (), address)
    assert "second" not in live_html(replace(making, phase="stopped"), (), address)
    assert "There is no job yet." in live_html(Progress("empty"), (), address)
    assert "The job small asks for 12 scenes." in live_html(
        Progress("empty", "small", replace(status, asked=12)), (), address
    )
    assert title_of(Progress("empty")) == "Verso"
    html = live_html(Progress("unreadable", damage="job.yaml is <broken>"), (), address)
    assert "<li>job.yaml is &lt;broken&gt;</li>" in html and "<img" not in html


def test_the_oldest_pictures_leave_a_full_shelf():
    pictures = [picture_of_colour(np.full((64, 64, 3), shade, np.uint8), "") for shade in (0, 90, 180)]
    shelf = PictureShelf(2 * max(len(one.data) for one in pictures))
    addresses = [shelf.put(one) for one in pictures[:2]]
    shelf.put(pictures[0])  # is new again
    shelf.put(pictures[2])
    assert [shelf.get(one.name) is not None for one in pictures] == [True, False, True]
    assert addresses[0] == f"/picture/{pictures[0].name}" and shelf.get("../../etc/passwd") is None


def test_a_folder_is_followed_from_nothing_to_its_report_and_a_thread_looks_by_itself(shown, tmp_path, monkeypatch):
    out = tmp_path / "out"
    follower = Follower(LocalStore(out), 2)
    follower.look()
    follower.report()
    assert "Waiting for a job" in follower.view.live and (follower.view.shape, follower.view.version) == ("", 0)
    monkeypatch.setattr(module, "LOOK_S", 0.02)
    follower._not_before = 0.0
    follower.start()
    try:
        shutil.copytree(shown.root, tmp_path / "copy")
        (tmp_path / "copy").rename(out)
        end = time.monotonic() + 20
        while follower.view.version == 0:
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        follower.stop()
    assert not follower._thread.is_alive()
    assert "Finished" in follower.view.live and follower.view.name == "small"
    assert follower.view.shape == "overview scenes pictures compare space figures effects failures"


def test_a_report_is_made_again_only_after_a_change_and_a_while_but_at_once_when_all_is_finished(shown, monkeypatch):
    follower, made = Follower(shown, 2), []
    begun = Progress("making", "x", Status(96, 80, {}, 16, 3.0, digest=None, running=(), holder=None))

    def told(done: int, phase: str = "making", sections: tuple | None = (), waited: bool = False) -> list[int]:
        monkeypatch.setattr(follower, "_read_sections", lambda: made.append(done) or sections)
        follower._shown = replace(begun, status=replace(begun.status, made=done), phase=phase)
        follower._not_before *= not waited
        follower.report()
        return list(made)

    assert told(80, sections=None) == [80]
    assert told(80) == [80]  # it failed, and the next try is too soon
    assert told(80, waited=True) == [80, 80]
    assert told(84) == [80, 80]  # too soon
    assert told(88, "finished") == [80, 80, 88]
    assert told(96) == [80, 80, 88] and follower._not_before > time.monotonic() + 5  # somebody extends it
    assert told(88, "finished", waited=True) == [80, 80, 88]  # nothing changed since it succeeded


# ---------------------------------------------------------------------------------------------- who may read

TOKEN = "a-token-of-some-length"
OPEN = Gate(frozenset({"localhost", "lab7"}), None, "verso_1")
CLOSED = Gate(OPEN.names, TOKEN, "verso_1")
HERE = {"host": "127.0.0.1:8722"}
COOKIE = {"cookie": f"other=1; verso_1={TOKEN}"}
OURS = ("127.0.0.1:8722", "localhost", "LocalHost:99", "lab7:8722", "[::1]:8722", "10.0.0.3", "lab7.")
FOREIGN = (
    *("", "evil.example", "evil.example:8722", "127.0.0.1.evil.example", "localhost:80@evil", "[::1", "a:b:c"),
    *("lab7:x", "evil@localhost", "lab7/x"),
)
ASKED = (
    *((OPEN, method, "/", {}, 405) for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "get")),
    *((OPEN, method, "/live.json?x=1", {}, 200) for method in ("GET", "HEAD")),
    *((OPEN, "GET", "/", {"host": host}, 403) for host in FOREIGN),
    (CLOSED, "GET", f"/?token={TOKEN}", {}, 303),
    (CLOSED, "GET", "/", COOKIE, 200),
    (CLOSED, "GET", "/", {"authorization": f"Bearer {TOKEN}"}, 200),
    *((CLOSED, "GET", target, {}, 401) for target in ("/", "/?token=", f"/?token={TOKEN[:-1]}")),
    (CLOSED, "GET", f"/?token={TOKEN}x", COOKIE, 401),
    *((CLOSED, "GET", "/", {"cookie": cookie}, 401) for cookie in (f"verso_2={TOKEN}", "verso_1=\x7f;;=")),
    *((CLOSED, "GET", "/", {"authorization": one}, 401) for one in (f"Basic {TOKEN}", "Bearer \udcff")),
)


def test_reading_alone_is_answered_under_the_servers_own_names_and_with_its_token(monkeypatch):
    for gate, method, target, headers, status in ASKED:
        assert judge(gate, method, target, {**HERE, **headers})[0] == status, (method, target, headers)
    assert judge(OPEN, "GET", "/live.json?x=1", HERE) == (200, "/live.json")
    assert all(is_host_known(host, OPEN.names) for host in OURS)
    assert not any(is_host_known(host, OPEN.names) for host in FOREIGN)
    compared = []
    monkeypatch.setattr("hmac.compare_digest", lambda a, b: compared.append((a, b)) or a == b)
    assert is_same("x", "x") and not is_same("y" * 99, TOKEN)
    assert {len(one) for pair in compared for one in pair} == {32}  # digests of one length


def test_a_place_that_others_reach_has_a_token_and_a_weak_one_is_refused():
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.3.2.1", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "10.1.1.1", "lab7"))
    assert choose_place("127.0.0.1", 1, None).token is None
    made = [choose_place(host, 1, token).token for host, token in (("0.0.0.0", None), ("127.0.0.1", "auto"))]
    assert [len(token) for token in made] == [32, 32] and made[0] != made[1]
    assert choose_place("::", 1, TOKEN).token == TOKEN
    for weak in ("short", "", "ä" * 20, "a" * 15 + "\n" * 3):
        with pytest.raises(InputError, match="at least 16 plain"):
            choose_place("0.0.0.0", 1, weak)
    assert Place("127.0.0.1", 8722, None).address == "http://127.0.0.1:8722/"
    assert Place("::1", 8722, "a b&c").address == "http://[::1]:8722/?token=a%20b%26c"
    assert Place("0.0.0.0", 8722, TOKEN).address == f"http://{socket.gethostname()}:8722/?token={TOKEN}"


# ---------------------------------------------------------------------------------------------- over connections


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


def ask(port: int, path: str, method: str = "GET", **headers: str):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer, data


def first_line(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), 20) as link:
        link.sendall(request)
        link.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: link.recv(65_536), b"")).splitlines()[0]


def test_the_page_and_all_that_it_names_are_there(port):
    answer, data = ask(port, "/")
    assert (answer.status, answer.headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b"<style" not in data and b" style=" not in data and b"data:" not in data  # the policy allows none
    named = set(re.findall(r'(?:src|href)="(/[^"]*)"', data.decode()))
    assert len([path for path in named if path.startswith("/picture/")]) >= 14
    for path in sorted(named):
        found, body = ask(port, path)
        assert found.status == 200 and body and int(found.headers["Content-Length"]) == len(body), path
        if path.endswith("jpeg"):
            assert found.headers["Content-Type"] == "image/jpeg" and body[:2] == b"\xff\xd8"
    state, sections = (json.loads(ask(port, f"/{name}.json")[1]) for name in ("live", "sections"))
    assert state["name"] == "small" and "Finished" in state["live"]
    assert list(sections["sections"]) == state["shape"].split()
    assert f'data-version="{state["version"]}" data-shape="{state["shape"]}"'.encode() in data


NOWHERE = (
    *("/..", "/../../etc/passwd", "/picture/../page.css", "/picture/..%2f..%2fjob.yaml", "//etc/passwd", "/picture/"),
    *("/job.yaml", "/manifest/", "/box/RGB00000.png", "/web/page.css", "/page.css/", "/page.html", "/%2e%2e/x"),
    *("/picture", "/page.css%00", "/\\..\\x", "/http://[", "/favicon.ico"),
)


def test_nothing_is_written_no_path_leads_to_a_file_and_every_answer_has_the_headers_of_safety(port):
    for path, method in (("/", "GET"), ("/nothing", "GET"), ("/", "POST"), ("/page.css", "HEAD")):
        answer, data = ask(port, path, method)
        assert {name: answer.headers[name] for name in HEADERS} == HEADERS and "Python" not in answer.headers["Server"]
    assert (answer.status, data) == (200, b"") and "unsafe" not in HEADERS["Content-Security-Policy"]
    assert answer.headers["Content-Length"] == ask(port, "/page.css")[0].headers["Content-Length"]
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "PROPFIND"):
        answer, _ = ask(port, "/", method)
        assert (answer.status, answer.headers["Allow"]) == (405, "GET, HEAD")
    for path in NOWHERE:
        answer, data = ask(port, path)
        assert answer.status == 404 and len(data) < 200, path
    assert b" 404 " in first_line(port, b"GET http://[::1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert b" 200 " not in first_line(port, b"GET\r\n\r\n")
    assert b" 403 " in first_line(port, b"GET / HTTP/1.0\r\n\r\n")
    assert ask(port, "/", Host="evil.example:8722")[0].status == 403
    assert ask(port, "/", Host=f"localhost:{port}")[0].status == 200


def test_without_its_token_nothing_is_told_and_it_stays_in_a_cookie_that_scripts_cannot_read(follower):
    with serving(follower, Place("127.0.0.1", 0, TOKEN)) as place:
        for path in ("/", "/live.json", "/page.css", "/nothing", "/?token=wrong", f"/?token={TOKEN[:-1]}"):
            answer, data = ask(place.port, path)
            assert answer.status == 401 and b"small" not in data and answer.headers["Set-Cookie"] is None
        answer, _ = ask(place.port, f"/?token={TOKEN}")
        cookie = answer.headers["Set-Cookie"]
        assert (answer.status, answer.headers["Location"]) == (303, "/")
        assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
        assert ask(place.port, "/", Cookie=cookie.partition(";")[0])[0].status == 200


def test_a_taken_port_is_told_connections_beyond_the_most_are_closed_and_stalled_ones_end(follower, port, monkeypatch):
    told = f"127.0.0.1 port {port} cannot be opened.*choose another --port"
    with pytest.raises(InputError, match=told), serving(follower, Place("127.0.0.1", port, None)):
        pass
    monkeypatch.setattr(server, "MOST_REQUESTS", 2)
    monkeypatch.setattr(server._Handler, "timeout", 0.5)
    with serving(follower, Place("127.0.0.1", 0, None)) as place:
        stalled = [socket.create_connection(("127.0.0.1", place.port), 20) for _ in range(2)]
        with socket.create_connection(("127.0.0.1", place.port), 20) as third:
            assert third.recv(1) == b""
        for link in stalled:
            assert link.recv(1) == b""  # after half a second
            link.close()
        assert ask(place.port, "/page.css")[0].status == 200


def test_a_connection_that_trickles_its_request_is_closed_at_the_deadline_of_the_request(follower, monkeypatch):
    monkeypatch.setattr(server, "STALLED_S", 1.0)
    monkeypatch.setattr(server, "MOST_REQUESTS", 1)
    finish = server._Handler.finish

    def finish_late(self) -> None:  # as on a busy machine: the next connection comes before this thread has ended
        time.sleep(0.3)
        finish(self)

    monkeypatch.setattr(server._Handler, "finish", finish_late)
    begun = time.monotonic()
    with serving(follower, Place("127.0.0.1", 0, None)) as place:
        with socket.create_connection(("127.0.0.1", place.port), 20) as link:
            link.settimeout(0.1)
            while time.monotonic() < begun + 30.0:
                try:
                    link.sendall(b"G")
                    if link.recv(1) == b"":
                        break
                except TimeoutError:
                    continue
                except OSError:
                    break
        assert 0.9 < time.monotonic() - begun < 20.0
        assert ask(place.port, "/page.css")[0].status == 200


@pytest.mark.minute
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_says_where_it_listens_and_ends_at_a_signal(shown, number):
    command = [sys.executable, "-m", "services.cli.main", "serve", str(shown.root), "--port", "0", "--token", "auto"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--json"], cwd=ROOT, **pipes) as process:
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
