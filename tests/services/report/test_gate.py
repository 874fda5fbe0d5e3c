import pytest

from services.look.server import Gate, is_host_known, is_loopback, is_same, judge, make_token

TOKEN = "a-token-of-some-length"
OPEN = Gate(frozenset({"localhost", "lab7"}), None, "verso_1")
CLOSED = Gate(OPEN.names, TOKEN, "verso_1")
HERE = {"host": "127.0.0.1:8722"}


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8722", "localhost", "LocalHost:99", "lab7:8722", "[::1]:8722", "10.0.0.3", "lab7."]
)
def test_the_servers_own_names_and_addresses_are_known(host):
    assert is_host_known(host, OPEN.names)


@pytest.mark.parametrize(
    "host",
    ["", "evil.example", "evil.example:8722", "127.0.0.1.evil.example", "localhost:80@evil", "[::1", "a:b:c", "lab7:x"],
)
def test_a_foreign_name_is_refused_whatever_it_points_to(host):
    assert not is_host_known(host, OPEN.names)
    assert judge(OPEN, "GET", "/", {"host": host}).status == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get"])
def test_only_reading_is_answered(method):
    assert judge(OPEN, method, "/", HERE).status == 405


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_without_a_token_everything_may_be_read(method):
    verdict = judge(OPEN, method, "/live.json?x=1", HERE)
    assert (verdict.status, verdict.path) == (200, "/live.json")


def test_the_token_in_the_address_is_taken_once_and_then_goes_in_a_cookie():
    assert judge(CLOSED, "GET", f"/?token={TOKEN}", HERE).status == 303
    assert judge(CLOSED, "GET", "/", {**HERE, "cookie": f"other=1; verso_1={TOKEN}"}).status == 200
    assert judge(CLOSED, "GET", "/", {**HERE, "authorization": f"Bearer {TOKEN}"}).status == 200


@pytest.mark.parametrize(
    ("target", "headers"),
    [
        ("/", {}),
        ("/?token=", {}),
        (f"/?token={TOKEN[:-1]}", {}),
        (f"/?token={TOKEN}x", {"cookie": f"verso_1={TOKEN}"}),
        ("/", {"cookie": f"verso_2={TOKEN}"}),
        ("/", {"cookie": "verso_1=\x7f;;="}),
        ("/", {"authorization": f"Basic {TOKEN}"}),
        ("/", {"authorization": "Bearer \udcff"}),
    ],
)
def test_a_wrong_or_missing_token_is_refused(target, headers):
    assert judge(CLOSED, "GET", target, {**HERE, **headers}).status == 401


def test_tokens_are_compared_by_digests_of_one_length(monkeypatch):
    compared = []
    monkeypatch.setattr("hmac.compare_digest", lambda a, b: compared.append((a, b)) or a == b)
    assert is_same("x", "x") and not is_same("y" * 99, TOKEN)
    assert {len(one) for pair in compared for one in pair} == {32}


def test_random_tokens_are_long_and_differ():
    assert make_token() != make_token() and len(make_token()) == 32


@pytest.mark.parametrize(("host", "here"), [
    ("127.0.0.1", True), ("127.3.2.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("::", False),
    ("10.1.1.1", False), ("lab7", False),
])  # fmt: skip
def test_only_this_machine_reaches_a_loopback_address(host, here):
    assert is_loopback(host) == here
