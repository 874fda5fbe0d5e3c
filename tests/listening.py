"""What the processes of a tree listen on, as the kernel tells it."""

import contextlib
import os
import re
import socket
import struct
from pathlib import Path
from typing import NamedTuple

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
