"""A host on a network of its own, made of namespaces: what comes out of it is seen, and it is attacked from outside.

The host has two links. `out` leads to the default gateway and the name server, which answer nothing and note every frame.
`lan` leads to an attacker. Needs root, because only root gives a namespace links.
"""

import contextlib
import ctypes
import os
import shutil
import socket
import struct
import subprocess
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

GATEWAY, HOST_OUT = "10.211.0.1", "10.211.0.2"
ATTACKER, HOST_LAN = "10.212.0.1", "10.212.0.2"
CLONE_NEWNET = 0x40000000
ETH_P_ALL = 3

Result = TypeVar("Result")


class NoNamespacesError(Exception):
    """This machine does not let us make network namespaces; the message says what failed."""


@dataclass
class Network:
    """The names of the host's and the outside's namespace, and a folder for the host's resolv.conf."""

    host: str
    outside: str
    folder: Path
    frames: list[str] = field(default_factory=list)
    """What left the host through `out`, one line each, since `watch` began."""

    def command(self, command: Sequence[str]) -> list[str]:
        """The command line that runs a command on the host."""
        resolver = self.folder / "resolv.conf"
        resolver.write_text(f"nameserver {GATEWAY}\noptions timeout:1 attempts:1\n")
        mount = 'mount --bind "$1" "$(readlink -f /etc/resolv.conf)" && shift && exec "$@"'
        return ["ip", "netns", "exec", self.host, "sh", "-c", mount, "sh", str(resolver), *command]

    def from_outside(self, work: Callable[[], Result]) -> Result:
        """The result of `work` in a thread whose new sockets are the attacker's."""
        return _in_namespace(self.outside, work)

    @contextlib.contextmanager
    def watch(self) -> Iterator[list[str]]:
        """Notes each frame that leaves the host through `out` while the block lasts."""

        def open_socket() -> socket.socket:
            watching = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
            watching.bind(("out", 0))
            watching.settimeout(0.1)
            return watching

        over = threading.Event()
        with self.from_outside(open_socket) as watching:
            watcher = threading.Thread(target=self._note, args=(watching, over))
            watcher.start()
            try:
                yield self.frames
            finally:
                over.set()
                watcher.join()

    def _note(self, watching: socket.socket, over: threading.Event) -> None:
        while True:
            try:
                frame, sender = watching.recvfrom(65536)
            except TimeoutError:
                if over.is_set():
                    return
                continue
            if sender[2] != socket.PACKET_OUTGOING:
                self.frames.append(describe_frame(frame))


@contextlib.contextmanager
def private_network(folder: Path) -> Iterator[Network]:
    """A host, an attacker and a gateway. Raises NoNamespacesError where that cannot be done here."""
    name = f"verso-{uuid.uuid4().hex[:6]}"
    network = Network(f"{name}-host", f"{name}-outside", folder)
    try:
        try:
            _build(network)
        except (OSError, subprocess.CalledProcessError) as error:
            told = getattr(error, "stderr", b"") or str(error).encode()
            raise NoNamespacesError(f"no network namespaces here: {told.decode().strip()}") from error
        yield network
    finally:
        if shutil.which("ip"):
            for namespace in (network.host, network.outside):
                subprocess.run(["ip", "netns", "del", namespace], capture_output=True, check=False)


def _build(network: Network) -> None:
    host, outside = network.host, network.outside
    commands = [f"ip netns add {host}", f"ip netns add {outside}", f"ip -n {host} link set lo up"]
    for link, here, there in (("out", HOST_OUT, GATEWAY), ("lan", HOST_LAN, ATTACKER)):
        commands += [
            f"ip -n {host} link add {link} type veth peer name {link} netns {outside}",
            *(f"ip netns exec {one} sysctl -qw net.ipv6.conf.{link}.disable_ipv6=1" for one in (host, outside)),
            f"ip -n {host} addr add {here}/24 dev {link}",
            f"ip -n {outside} addr add {there}/24 dev {link}",
            f"ip -n {outside} link set {link} up",
            f"ip -n {host} link set {link} up",
        ]
    commands.append(f"ip -n {host} route add default via {GATEWAY}")
    for command in commands:
        subprocess.run(command.split(), check=True, capture_output=True)


def _in_namespace(name: str, work: Callable[[], Result]) -> Result:
    """In a thread of its own, because a thread that entered a namespace stays there."""

    def entered() -> Result:
        with open(f"/run/netns/{name}") as namespace:
            if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return work()

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(entered).result()


def open_ports(address: str, ports: Iterable[int]) -> list[int]:
    """The ports at which something accepts a connection."""
    found = []
    for port in ports:
        with socket.socket() as attempt:
            attempt.settimeout(1.0)
            if not attempt.connect_ex((address, port)):
                found.append(port)
    return found


def describe_frame(frame: bytes) -> str:
    """An Ethernet frame in a few words: its protocol, and where it goes."""
    (kind,) = struct.unpack_from("!H", frame, 12)
    if kind == 0x0806:
        return f"ARP for {socket.inet_ntoa(frame[38:42])}"
    if kind != 0x0800:
        return f"Ethernet type {kind:#06x}"
    start, protocol, target = 14 + 4 * (frame[14] & 15), frame[23], socket.inet_ntoa(frame[30:34])
    if protocol not in (socket.IPPROTO_TCP, socket.IPPROTO_UDP):
        return f"IP protocol {protocol} to {target}"
    (port,) = struct.unpack_from("!H", frame, start + 2)
    return f"{'TCP' if protocol == socket.IPPROTO_TCP else 'UDP'} to {target}:{port}"
