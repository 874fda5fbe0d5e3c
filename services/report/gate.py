"""Who may read the live page: names of the server, its token, its headers. Pure."""

import hashlib
import hmac
import ipaddress
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

LEAST_TOKEN = 16
"""Fewest characters of a token that a person chooses."""

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)

HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Sent with every answer."""


@dataclass(frozen=True)
class Gate:
    """What a request is held to."""

    names: frozenset[str]
    """Names of this server, beside addresses: a web page that points a name of its own here must not read the answer."""
    token: str | None
    cookie: str
    """Name of the cookie that holds the token."""


@dataclass(frozen=True)
class Verdict:
    """What to do with a request: `status` 200 to answer it, 303 to go on without the token in the address."""

    status: int
    path: str = "/"


def judge(gate: Gate, method: str, target: str, headers: Mapping[str, str]) -> Verdict:
    """200, 303, 401 without the token, 403 for a foreign host name, 405 for what is not reading; header names in lower case."""
    if method not in ("GET", "HEAD"):
        return Verdict(405)
    if not is_host_known(headers.get("host", ""), gate.names):
        return Verdict(403)
    parts = urlsplit(target)
    given = parse_qs(parts.query).get("token")
    if gate.token is None:
        return Verdict(200, parts.path)
    if given is not None:
        return Verdict(303 if is_same(given[0], gate.token) else 401, parts.path)
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    offered = [bearer.strip()] if scheme.lower() == "bearer" else []
    offered += _cookies(headers.get("cookie", ""), gate.cookie)
    return Verdict(200 if any(is_same(one, gate.token) for one in offered) else 401, parts.path)


def is_same(offered: str, token: str) -> bool:
    """Whether two tokens are one, in a time that tells nothing about either, its length included."""
    digests = (hashlib.sha256(one.encode("utf-8", "surrogateescape")).digest() for one in (offered, token))
    return hmac.compare_digest(*digests)


def is_host_known(host: str, names: Iterable[str]) -> bool:
    """Whether a Host header is an address or one of the names, at any port."""
    name = _name_of(host)
    return bool(name) and (is_address(name) or name in names)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address; a name other than `localhost` is not looked up."""
    return host == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)


def is_address(name: str) -> bool:
    """Whether it is an IP address and no name."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def make_token() -> str:
    """A random token of 192 bits."""
    return secrets.token_urlsafe(24)


def _name_of(host: str) -> str:
    """The name or address in a Host header, in lower case; empty where it is none."""
    if host.startswith("["):
        name, bracket, port = host[1:].partition("]")
        return name.lower() if bracket and (not port or _is_port(port.removeprefix(":"))) else ""
    name, colon, port = host.partition(":")
    return name.lower().rstrip(".") if not colon or _is_port(port) else ""


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 5


def _cookies(header: str, name: str) -> list[str]:
    try:
        cookie: SimpleCookie = SimpleCookie(header)
    except CookieError:
        return []
    return [cookie[name].value] if name in cookie else []
