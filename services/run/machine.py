"""This machine: processes found and ended, a container's share of the cores, and folders that go with their owner. Edge.

The folders are those of private Rays: closed to other users, with names short enough for sockets.
"""

import contextlib
import ctypes
import math
import os
import signal
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.errors import MachineError

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36

GRACE_S = 3.0
"""Time that a process gets to end by itself after SIGTERM."""

KILL_S = 5.0
"""Time that the kernel gets to remove processes after SIGKILL; one that hangs in a driver or on NFS stays longer."""

_POLL_S = 0.02


@dataclass(frozen=True)
class Process:
    """A process of this machine; `born` is its start in ticks since boot, because process ids are used again."""

    pid: int
    parent: int
    born: str
    state: str
    """One letter of proc(5): `T` is stopped, `Z` has ended and waits for its parent."""
    name: str

    @property
    def ended(self) -> bool:
        """Whether only its exit status is left."""
        return self.state in "ZX"

    @property
    def stopped(self) -> bool:
        """Whether a signal stopped it, as SIGSTOP does."""
        return self.state in "Tt"


def read_process(pid: int) -> Process | None:
    """The process with this id, None where there is none."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    head, _, tail = stat.rpartition(")")
    state, parent, *rest = tail.split()
    return Process(pid, int(parent), rest[17], state, head.partition("(")[2])


def descendants(pid: int) -> list[Process]:
    """Children of a process, their children and so on; those that have ended are left out.

    Parents first, and of one generation's the older first.
    """
    children: defaultdict[int, list[Process]] = defaultdict(list)
    for process in _processes():
        children[process.parent].append(process)
    family, level = [], children[pid]
    while level:
        family += sorted(level, key=lambda process: int(process.born))
        level = [child for process in level for child in children[process.pid]]
    return [process for process in family if not process.ended]


def _processes() -> Iterator[Process]:
    """All processes of this machine."""
    for entry in os.listdir("/proc"):
        if entry.isdigit() and (process := read_process(int(entry))) is not None:
            yield process


def send(process: Process, number: int) -> None:
    """Sends a signal to exactly this process; nothing where it is gone, even if its id was given out again."""
    with contextlib.suppress(OSError), open(os.pidfd_open(process.pid), "rb", buffering=0) as descriptor:
        now = read_process(process.pid)
        if now is not None and now.born == process.born:
            signal.pidfd_send_signal(descriptor.fileno(), number)


def marked(mark: str) -> Iterator[Process]:
    """Processes whose environment, as they were started, has the line `mark`; without this one."""
    for process in _processes():
        with contextlib.suppress(OSError):
            has_line = mark.encode() in Path(f"/proc/{process.pid}/environ").read_bytes().split(b"\0")
            if has_line and not process.ended and process.pid != os.getpid():
                yield process


def end_all(find: Callable[[], Iterable[Process]]) -> list[Process]:
    """Ends what `find` finds, until it finds nothing more: SIGTERM, then SIGKILL. Returns what even that did not end."""
    for number, patience_s in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, KILL_S)):
        deadline, sent = time.monotonic() + patience_s, set[tuple[int, str]]()
        while left := list(find()):
            for process in left:
                if (process.pid, process.born) not in sent:
                    sent.add((process.pid, process.born))
                    send(process, number)
            reap()
            if time.monotonic() > deadline:
                break
            time.sleep(_POLL_S)
        else:
            break
    reap()
    return left


def reap() -> dict[int, int]:
    """Wait statuses of the children that have ended, by process id."""
    statuses: dict[int, int] = {}
    with contextlib.suppress(ChildProcessError):
        while (child := os.waitpid(-1, os.WNOHANG))[0]:
            statuses[child[0]] = child[1]
    return statuses


def adopt_orphans() -> None:
    """From now on, descendants of this process whose parents end become its own children."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int, number: int) -> None:
    """From now on, the end of this process's parent, `parent`, sends it this signal."""
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it ended before we asked
        os.kill(os.getpid(), number)


def _prctl(option: int, value: int) -> None:
    if ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"prctl {option}")


def usable_cores(proc: Path = Path("/proc/self/cgroup"), cgroups: Path = Path("/sys/fs/cgroup")) -> int:
    """The smaller of the cores it may be scheduled on and its control groups' quota, at least 1.

    A quota is rounded up: one worker would waste half a core of 1.5, two share them.
    """
    cores = len(os.sched_getaffinity(0))
    quota = min((_quota(folder) for folder in _control_groups(proc, cgroups)), default=math.inf)
    return math.ceil(quota) if quota < cores else cores


def _control_groups(proc: Path, cgroups: Path) -> Iterator[Path]:
    """The folders whose limits apply to this process: its own group and all above it, in either version's layout."""
    for line in proc.read_text().splitlines() if proc.exists() else ():
        _, controllers, path = line.split(":", 2)
        if not controllers or "cpu" in controllers.split(","):
            top = cgroups / "cpu" if controllers else cgroups
            group = top / path.lstrip("/")
            # Inside a container the path may be the host's, of which only the top is mounted here.
            yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(top))


def _quota(folder: Path) -> float:
    """Cores that one control group grants, by version 2's `cpu.max` or version 1's pair of files; inf where unlimited."""
    try:
        if (both := folder / "cpu.max").exists():
            granted, period = both.read_text().split()
        else:
            granted, period = ((folder / f"cpu.cfs_{part}_us").read_text().strip() for part in ("quota", "period"))
    except OSError:
        return math.inf
    return math.inf if granted in ("max", "-1") else int(granted) / int(period)


# ------------------------------------------------------------------------------------------------ private folders

PREFIX = "vr-"

SOCKET_BYTES = 107
"""The longest name of a Unix socket on Linux."""

SESSION_BYTES = len("/session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store")
"""What Ray puts behind the name of its folder; 4194304 is the largest process id."""

MAX_BASE_BYTES = SOCKET_BYTES - SESSION_BYTES - len(f"/{PREFIX}12345678/r")
"""The longest temporary folder that has room for a private Ray's."""

OTHERS = (Path("/tmp"), Path("/var/tmp"), Path("/dev/shm"))
"""Where to go when the user's temporary folder has too long a name."""


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """An empty folder that no other user can enter; removed when the block ends.

    Folders of processes that are gone are removed first. Raises MachineError where no place has a name short enough.
    """
    from workers.store.file_system import owned_folder  # loads models, which a supervisor does without

    living_folders()
    errors = []
    with contextlib.ExitStack() as stack:
        for place in _places():
            try:
                folder = stack.enter_context(owned_folder(place, PREFIX))
                break
            except OSError as error:
                errors.append(f"{place} ({error.strerror or error})")
        else:
            wanted = tempfile.gettempdir()
            tried = f"; cannot be written: {', '.join(errors)}" if errors else ""
            raise MachineError(
                f"no place for Ray's sockets: the name of {wanted} has {len(os.fsencode(wanted))} bytes, at most "
                f"{MAX_BASE_BYTES} fit{tried}: set TMPDIR to a writable folder with a short name"
            )
        yield folder


def living_folders() -> list[Path]:
    """This user's private folders on this machine, those of processes that are gone removed first."""
    from workers.store.file_system import INNER, owned_folders

    return [folder / INNER for place in _places() for folder in owned_folders(place, PREFIX)]


def _places() -> list[Path]:
    """The user's temporary folder if its name is short enough, then the others. Raises MachineError if none exists."""
    try:
        wanted = Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        raise MachineError(f"{error.strerror}: set TMPDIR to one that can be written") from error
    places = [place for place in (wanted, *OTHERS) if len(os.fsencode(place)) <= MAX_BASE_BYTES]
    return list(dict.fromkeys(places))
