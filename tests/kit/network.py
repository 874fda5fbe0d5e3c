"""A host on a network of its own, made of namespaces: what comes out of it is seen, and it is attacked from outside.

The host has two links. `out` leads to the default gateway and the name server, which answer nothing and note every frame.
`lan` leads to an attacker. Needs root, because only root gives a namespace links.
"""

import contextlib
import ctypes
import os
import re
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
from typing import NamedTuple, TypeVar

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


def free_ports(count: int) -> list[int]:
    """So many different ones."""
    with contextlib.ExitStack() as stack:
        bound = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in bound:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in bound]


def free_port() -> int:
    """One of them."""
    return free_ports(1)[0]


LISTENS = "0A"  # the state of a TCP socket in /proc/net/tcp


class Listener(NamedTuple):
    process: str
    protocol: str
    address: str
    port: int


def tree_of(root: int) -> list[int]:
    """A process and all its descendants."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    found = [root]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def listeners_of(root: int) -> set[Listener]:
    """Open TCP and UDP ports of a tree of processes, IPv4 addresses that are written in IPv6 as IPv4."""
    ports = {}
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in _lines(root, protocol):
            _, local, _, state, *_, inode = line.split()[:10]
            if protocol.startswith("udp") or state == LISTENS:
                address, _, port = local.partition(":")
                ports[inode] = (protocol, _address(address), int(port, 16))
    return {Listener(name, *ports[inode]) for name, inode in _sockets_of(root) if inode in ports}


def unix_sockets_of(root: int) -> set[tuple[str, str]]:
    """Process and name of each named Unix socket of a tree of processes; `@` in front of those outside the file system."""
    names = {fields[6]: fields[7] for fields in map(str.split, _lines(root, "unix")) if len(fields) > 7}
    return {(name, names[inode]) for name, inode in _sockets_of(root) if inode in names}


def _lines(pid: int, table: str) -> list[str]:
    return Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]


def _sockets_of(root: int) -> list[tuple[str, str]]:
    """Name of the process and inode of each socket."""
    found = []
    for pid in tree_of(root):
        with contextlib.suppress(OSError):
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            for file in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    found += [(name, inode) for inode in re.findall(r"^socket:\[(\d+)\]$", os.readlink(file))]
    return found


def _address(digits: str) -> str:
    """An address as the kernel writes it: words of four bytes, each in the machine's order."""
    raw = b"".join(struct.pack("=I", int(digits[k : k + 8], 16)) for k in range(0, len(digits), 8))
    if len(raw) == 4:
        return socket.inet_ntoa(raw)
    return (
        socket.inet_ntoa(raw[12:])
        if raw.startswith(bytes(10) + b"\xff\xff")
        else socket.inet_ntop(socket.AF_INET6, raw)
    )
