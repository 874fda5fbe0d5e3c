"""What a worker must have before its first shard, and the refusal of one that has not. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass

from schemas.environment import FOR_SPEED, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3
from schemas.errors import FingerprintError, MachineError, OutputError, VersoError
from services.run.sight import Sight

VARIABLES = (*STACK_ENVIRONMENT, *ON_X86_64_V3)
"""The variables that a worker must have as the driver has them."""


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


def worker_environment(environ: Mapping[str, str]) -> dict[str, str]:
    """The variables that a driver with this environment gives to the workers of a cluster."""
    own = {name: value for name, value in FOR_SPEED.items() if environ.get(name) == value}
    return own | {name: environ[name] for name in VARIABLES if name in environ}


def refusal_of(terms: WorkerTerms, node: Sight) -> VersoError | None:
    """The error that refuses a node; None where it may work."""
    return _processor(terms, node) or _code(terms, node) or _folder(terms, node)


def refusal_of_worker(terms: WorkerTerms, node: Sight) -> VersoError | None:
    """The same for a worker, whose environment counts too."""
    return _processor(terms, node) or _environment(terms, node) or _code(terms, node) or _folder(terms, node)


def _processor(terms: WorkerTerms, node: Sight) -> VersoError | None:
    missing = sorted(X86_64_V3 - node.flags)
    if not missing or not ON_X86_64_V3.items() <= set(terms.environment):
        return None
    return MachineError(
        f"the processor of {node.host} is below x86-64-v3 (no {', '.join(missing)}), and that of {terms.driver}, where the run "
        f"was started, is not: they do not make the same bytes. Take {node.host} out of the cluster, or use machines of one kind"
    )


def _environment(terms: WorkerTerms, node: Sight) -> VersoError | None:
    wrong = [(name, node.environment.get(name), value) for name, value in terms.environment]
    told = [f"{name} is {_quoted(found)} there and {value!r} here" for name, found, value in wrong if found != value]
    if not told:
        return None
    return FingerprintError(
        f"a worker on {node.host} has not the environment of the run on {terms.driver}, on which bytes depend: "
        f"{'; '.join(told)}. Set it for `ray start` on {node.host} (deploy/Dockerfile has the list), and see that nothing "
        "there changes it"
    )


def _quoted(value: str | None) -> str:
    return "not set" if value is None else repr(value)


def _code(terms: WorkerTerms, node: Sight) -> VersoError | None:
    if node.code == terms.code:
        return None
    have = f"has code {node.code[:12]}" if node.code else f"has no code of this project ({node.no_code})"
    return FingerprintError(
        f"{node.host} {have}, and {terms.driver}, where the run was started, has {terms.code[:12]}: install the same wheel "
        "or image on every node, then start Ray there again"
    )


def _folder(terms: WorkerTerms, node: Sight) -> VersoError | None:
    if not node.folder:
        return None
    return OutputError(
        f"{node.host} does not share the output folder {terms.out} with {terms.driver}, where the run was started: "
        f"{node.folder}. Give --out a folder that every node mounts at the same path (NFS), or an object store "
        "(--out s3://BUCKET/NAME --set output.layout=tar); nothing was made"
    )
