"""The environment variables that make a process's bytes the same everywhere, and one for speed.

numpy, OpenBLAS, Mesa and Python's hashing read them once, while they load. services/cli/environment.py restarts a command
that has others, before anything heavy is imported. deploy/Dockerfile repeats them as ENV lines for processes that
are started without this project's commands (`ray start`); a test compares the two.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

STACK_ENVIRONMENT: Final[Mapping[str, str]] = MappingProxyType(
    {
        # numpy's exp and arctan give other bits with AVX-512. These are the groups above AVX2 that numpy 2.4 switches at
        # run time; it ignores those that the machine lacks, and warns about unknown ones.
        "NPY_DISABLE_CPU_FEATURES": "X86_V4,AVX512_ICL,AVX512_SPR",
        # llvmpipe takes the widest vectors it finds otherwise, and its interpolation rounds differently with them.
        "LP_NATIVE_VECTOR_WIDTH": "256",
        # llvmpipe renders on the caller's thread: one worker, one core.
        "LP_NUM_THREADS": "0",
        # `import pyrender` imports pyglet's window, which wants X libraries unless told that there is no display.
        "PYGLET_HEADLESS": "1",
        "PYOPENGL_PLATFORM": "egl",
        "RAY_USAGE_STATS_ENABLED": "0",
        # Parallelism is by scene: threads inside a scene compete for cores and change the order of sums.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        # The order of a set of strings must be the same in every process.
        "PYTHONHASHSEED": "0",
    }
)

# The level x86-64-v3 of the psABI, by the names of /proc/cpuinfo, but for flags that every processor with these has.
X86_64_V3: Final = frozenset({"abm", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})

ON_X86_64_V3: Final[Mapping[str, str]] = MappingProxyType(
    {
        # OpenBLAS picks kernels by processor; inverses, SVDs and products of 50 x 50 differ in the last bits between its
        # AVX-512 and AVX2 kernels. It does not check the variable, which must not be set on a lesser processor.
        "OPENBLAS_CORETYPE": "Haswell",
        # Loops that numba compiled on one machine, as in the image, serve on all: it keeps them by processor and features. As
        # fast as with the processor's own.
        "NUMBA_CPU_NAME": "x86-64-v3",
        "NUMBA_CPU_FEATURES": "+avx2",
    }
)

# For speed alone, where the user has not set it. The heap lies in pages of 2 MiB where the kernel gives them to who asks (its
# setting `madvise`, which most distributions have): images and Bullet's pools are megabytes, and a scene takes 3 % less time.
# glibc before 2.35 ignores it.
FOR_SPEED: Final[Mapping[str, str]] = MappingProxyType({"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"})

# Set to 1, the environment stays as it is: for comparing stacks.
KEEP: Final = "VERSO_KEEP_ENV"


def stack_environment(flags: frozenset[str]) -> dict[str, str]:
    """The variables that a process on a processor with these flags should have."""
    return {**STACK_ENVIRONMENT, **(ON_X86_64_V3 if flags >= X86_64_V3 else {})}


def settings_to_change(environ: Mapping[str, str], flags: frozenset[str]) -> dict[str, str]:
    """The variables in which `environ` differs from the stack's, and those for speed that it lacks.

    None where the user asked to keep it.
    """
    if environ.get(KEEP) == "1":
        return {}
    missing = {name: value for name, value in FOR_SPEED.items() if name not in environ}
    return missing | {name: value for name, value in stack_environment(flags).items() if environ.get(name) != value}


def cache_folder(name: str) -> Path | None:
    """The user's folder for what is kept between runs, `~/.cache/verso/<name>`; None for a user without a home."""
    try:
        return Path.home() / ".cache" / "verso" / name
    except RuntimeError:
        return None
