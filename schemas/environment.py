"""The environment variables that a process must have for its bytes to be the same everywhere.

numpy, OpenBLAS, Mesa and Python's own hashing read these variables once, while they load; setting them later does
nothing. services/cli/environment.py restarts a command that finds another environment, before anything heavy is imported.
deploy/Dockerfile repeats the table as ENV lines, because there it must also hold for what is started without this
project's commands (`ray start`); a test keeps the two alike.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

STACK_ENVIRONMENT: Final[Mapping[str, str]] = MappingProxyType(
    {
        # numpy's exp and arctan give other bits with AVX-512. These are the groups that numpy 2.4 can switch at run
        # time and has no use for below AVX-512; it is silent about those the machine lacks, and warns about others.
        "NPY_DISABLE_CPU_FEATURES": "X86_V4,AVX512_ICL,AVX512_SPR",
        # llvmpipe otherwise takes the widest vectors it finds, and its interpolation rounds differently with them.
        "LP_NATIVE_VECTOR_WIDTH": "256",
        # llvmpipe renders on the caller's thread: one worker, one core.
        "LP_NUM_THREADS": "0",
        # `import pyrender` imports pyglet's window, which wants X libraries unless told that there is no display.
        "PYGLET_HEADLESS": "1",
        "PYOPENGL_PLATFORM": "egl",
        "RAY_USAGE_STATS_ENABLED": "0",
        # Parallelism is by scene. Threads inside a scene only fight over the cores, and change the order of sums.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        # The order of a set of strings must not differ from one process to the next.
        "PYTHONHASHSEED": "0",
    }
)

# OpenBLAS picks its kernels by processor: inverses, SVDs and products of 50 x 50 differ in the last bits between its
# AVX-512 and its AVX2 kernels. It does not check what it is told, so a processor without AVX2 must not be told this.
WITH_AVX2: Final[Mapping[str, str]] = MappingProxyType({"OPENBLAS_CORETYPE": "Haswell"})

# A user who compares stacks sets this to 1 and keeps the environment as it is.
KEEP: Final = "VERSO_KEEP_ENV"


def stack_environment(flags: frozenset[str]) -> dict[str, str]:
    """The variables that a process on a processor with these flags should have."""
    return {**STACK_ENVIRONMENT, **(WITH_AVX2 if "avx2" in flags else {})}


def settings_to_change(environ: Mapping[str, str], flags: frozenset[str]) -> dict[str, str]:
    """The variables in which `environ` differs from the stack's; none where the user asked to keep it."""
    if environ.get(KEEP) == "1":
        return {}
    return {name: value for name, value in stack_environment(flags).items() if environ.get(name) != value}
