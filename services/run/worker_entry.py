"""Where a shard's task enters a worker: looks at the node, refuses one that would make other bytes, then loads what makes scenes.

What it is given is packed, so that Ray unpacks bytes and text alone: nothing heavy of this project loads before the check, and
a node with other code is told as that. Ray itself loads numpy to unpack any argument, so what is checked is the environment
that the process was started with. `see` needs the standard library alone: it also runs on nodes that may lack this project.
"""

import json
import os
import pickle
import socket
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.environment import FOR_SPEED, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3
from schemas.errors import FingerprintError, MachineError, OutputError, VersoError

if TYPE_CHECKING:
    from schemas.dataset.shard import ShardOrder, ShardReport
    from workers.assets.catalogue import Catalogue

LOOK_S = 3.0
"""Time for a file that was just written to be seen through a network file system."""


@dataclass(frozen=True)
class Sight:
    """A node as one of its processes saw it."""

    host: str
    flags: frozenset[str]
    """Feature flags of its processor."""
    environment: dict[str, str]
    """Of the variables that were asked about, those that the process was started with."""
    code: str
    """Digest of the project's code there; empty where it cannot be imported."""
    no_code: str = ""
    """Why it cannot."""
    folder: str = ""
    """What is wrong with the output folder there; empty where nothing is."""


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Feature flags of this machine's first core, from Linux; empty where it does not list them."""
    try:
        with cpuinfo.open() as lines:
            first = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        return frozenset()
    return frozenset(first.partition(":")[2].split())


def start_environment(names: Iterable[str], environ: Path = Path("/proc/self/environ")) -> dict[str, str]:
    """Of these variables, those that this process was started with: what libraries read that load before our code."""
    lines = (line.decode(errors="replace").partition("=") for line in environ.read_bytes().split(b"\0"))
    started = {name: value for name, _, value in lines}
    return {name: started[name] for name in names if name in started}


def look_at_folder(proof: str, token: str, patience_s: float = LOOK_S) -> str:
    """What is wrong with the folder of the file `proof`, which holds `token` for every node that sees it; or nothing."""
    folder, deadline = os.path.dirname(proof), time.monotonic() + patience_s
    while (there := _token_in(proof)) != token:
        if time.monotonic() > deadline:
            if not os.path.isdir(folder):
                return "there is no such folder"
            return "it is another folder" if there is None else "it holds the lock of another run"
        time.sleep(0.1)
    scratch = os.path.join(folder, "_staging", "_tmp", f"node-{uuid.uuid4().hex}")
    try:
        os.makedirs(os.path.dirname(scratch), exist_ok=True)
        os.close(os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
        os.unlink(scratch)
    except OSError as error:
        return f"it cannot be written ({error.strerror})"
    return ""


def _token_in(proof: str) -> str | None:
    try:
        return str(json.loads(Path(proof).read_bytes())["token"])
    except (OSError, ValueError, KeyError, TypeError):  # a file that is just being replaced, too
        return None


def see(names: Iterable[str], proof: str, token: str) -> Sight:
    """This process's node; `proof` is empty where the output is no folder."""
    code = no_code = ""
    try:
        from workers.source import code_digest

        code = code_digest()
    except ImportError as error:
        no_code = str(error)
    folder = look_at_folder(proof, token) if proof else ""
    return Sight(socket.gethostname(), processor_flags(), start_environment(names), code, no_code, folder)


@dataclass(frozen=True)
class WorkerTerms:
    """What every worker of a run must have: the driver's environment, code and output folder."""

    environment: tuple[tuple[str, str], ...]
    code: str
    driver: str
    """The driver's host."""
    out: str = ""
    proof: str = ""
    """A file that only a node which sees the driver's output folder can read `token` from; empty for an object store."""
    token: str = ""


@dataclass(frozen=True)
class Pattern:
    """An order without ranges, the assets, and what its worker must have.

    `env_vars` are set for the workers of a cluster; those of a private Ray inherit them.
    """

    order: "ShardOrder"
    catalogue: "Catalogue"
    terms: WorkerTerms
    env_vars: Mapping[str, str] = field(default_factory=dict)


def terms_of_driver(environ: Mapping[str, str] = os.environ) -> WorkerTerms:  # noqa: TID251 - workers are to have the same
    """What workers must have: this process's code and, of its environment, the variables of the stack."""
    from workers.source import code_digest

    environment = {name: value for name, value in FOR_SPEED.items() if environ.get(name) == value}
    environment |= {name: environ[name] for name in (*STACK_ENVIRONMENT, *ON_X86_64_V3) if name in environ}
    return WorkerTerms(tuple(sorted(environment.items())), code_digest(), socket.gethostname())


def refusal_of(terms: WorkerTerms, node: Sight, is_worker: bool = False) -> VersoError | None:
    """The error that refuses a node, or a worker, whose environment counts too; None where it may work."""
    driver = f"{terms.driver}, where the run was started,"
    missing = sorted(X86_64_V3 - node.flags)
    if missing and ON_X86_64_V3.items() <= set(terms.environment):
        return MachineError(
            f"the processor of {node.host} is below x86-64-v3 (no {', '.join(missing)}), and that of {driver} is not: they do "
            f"not make the same bytes. Take {node.host} out of the cluster, or use machines of one kind"
        )
    if is_worker and (differing := "; ".join(_differences(terms, node))):
        return FingerprintError(
            f"a worker on {node.host} has not the environment of the run on {terms.driver}, on which bytes depend: "
            f"{differing}. Set it for `ray start` on {node.host} (deploy/Dockerfile has the list), and see that nothing "
            "there changes it"
        )
    if node.code != terms.code:
        code = f"has code {node.code[:12]}" if node.code else f"has no code of this project ({node.no_code})"
        return FingerprintError(
            f"{node.host} {code}, and {driver} has {terms.code[:12]}: install the same wheel or image on every node, then start "
            "Ray there again"
        )
    if node.folder:
        return OutputError(
            f"{node.host} does not share the output folder {terms.out} with {driver.rstrip(',')}: {node.folder}. Give --out a "
            "folder that every node mounts at the same path (NFS), or an object store (--out s3://BUCKET/NAME --set "
            "output.layout=tar); nothing was made"
        )
    return None


def _differences(terms: WorkerTerms, node: Sight) -> Iterator[str]:
    for name, value in terms.environment:
        if (there := node.environment.get(name)) != value:
            yield f"{name} is {'not set' if there is None else repr(there)} there and {value!r} here"


DRAIN = "VERSO_DRAIN"
"""The variable that names a file which exists once this node is to end: no range is begun then."""

DRAINED_PAUSE_S = 1.0
"""How long a node that is to end keeps a shard that it does not begin: Ray would hand it out there again and again."""


def enter_shard(terms: WorkerTerms, order: bytes, catalogue: bytes) -> "ShardReport":
    """The report of the shard whose order and catalogue are pickled. Raises VersoError where this worker is refused."""
    if is_draining():
        time.sleep(DRAINED_PAUSE_S)
    check_worker(terms)
    from workers.shard.run_shard import run_shard

    return run_shard(pickle.loads(order), pickle.loads(catalogue), is_draining)


@cache
def check_worker(terms: WorkerTerms) -> None:
    """Raises the refusal of this process; asked once in a process and run."""
    sight = see([name for name, _ in terms.environment], terms.proof, terms.token)
    if (refusal := refusal_of(terms, sight, is_worker=True)) is not None:
        raise refusal


def is_draining() -> bool:
    """Whether this node is to end, and so begins no range."""
    marker = os.environ.get(DRAIN)  # noqa: TID251 - the node's own, which no command line reaches
    return bool(marker) and os.path.exists(str(marker))
