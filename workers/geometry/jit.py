"""Compilation by numba of loops that numpy could write only as many passes over memory.

Without `fastmath`, so that sums are added in the order that is written, on every machine.

**Kept on disk.** Compiled loops lie in a folder named by the digest of all code that a loop may be made of: numba compiles loops
and constants of other files into a loop, but looks for changes in the loop's own file alone. Changed code has another folder.

**Compiled together.** A loop may name the types that scenes call it with. Processes that start at once share these
(`compile_planned`), each taking one file's loops at a time. All else is compiled when it is first called. Either way a file's
loops are compiled by one process at a time, under the file's lock: of two at once, numba may keep the one's code as the other's.
"""

import fcntl
import gc
import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import numba
from numba.core import config, event

from schemas.environment import cache_folder
from workers.source import MADE_WITH_THE_CODE, folder_name

Loop = TypeVar("Loop", bound=Callable[..., object])

_config: Any = config
_njit: Any = numba.njit
_modules: set[str] = set()
_planned: dict[str, list[tuple[Any, str]]] = {}


def _open_folder() -> Path | None:
    """The folder of loops of this code, in `NUMBA_CACHE_DIR` or the user's cache; None where it cannot be written to."""
    above = Path(_config.CACHE_DIR) if _config.CACHE_DIR else cache_folder("loops")
    if above is None:
        return None
    folder = above / folder_name()
    made = MADE_WITH_THE_CODE / folder.name
    try:
        if made.is_dir() and not folder.exists():
            shutil.copytree(made, folder, dirs_exist_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "writable").touch()
    except OSError:
        return None
    _config.CACHE_DIR = str(folder)
    return folder


_folder = _open_folder()


class _FileLocks(event.Listener):
    """The locks of files with loops: one is held from where a loop of the file is compiled until that is kept.

    numba tells where compiling starts, and saves before it leaves its own lock.
    """

    def __init__(self) -> None:
        self._held: dict[str, IO[str]] = {}
        self._depth = 0

    def on_start(self, event: Any) -> None:
        """Something is compiled or read, or, inside of that, compiled."""
        if event.kind == "numba:compiler_lock":
            self._depth += 1
        else:
            self.acquire(event.data["dispatcher"].py_func.__module__, wait=True)

    def on_end(self, event: Any) -> None:
        """The end of the same."""
        if event.kind == "numba:compiler_lock":
            self._depth -= 1
            if self._depth == 0:
                self.release()

    def acquire(self, module: str, wait: bool) -> bool:
        """Lock the file of a module until all are released; False where another process has it and this does not `wait`.

        numba's own modules, which are not kept, need no lock.
        """
        if _folder is None or module in self._held or module not in _modules:
            return True
        file = open(_folder / f"{module}.lock", "w")  # noqa: SIM115
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            file.close()
            return False
        self._held[module] = file
        return True

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Release nothing before the end of the block, and then all."""
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            self.release()

    def release(self) -> None:
        """Let go of all."""
        while self._held:
            self._held.popitem()[1].close()


_locks = _FileLocks()
event.register("numba:compile", _locks)
event.register("numba:compiler_lock", _locks)


def compiled(loop: Loop) -> Loop:
    """The function compiled at its first call, and kept on disk for the next process where there is a place to write."""
    # `no_cfunc_wrapper`: what C code would call by a pointer, which none does, is a tenth of compiling
    kept = _folder is not None and Path(loop.__code__.co_filename).exists()
    _modules.add(loop.__module__)
    return cast(Loop, _njit(error_model="numpy", no_cfunc_wrapper=True, cache=kept)(loop))


def compiled_for(*types: str) -> Callable[[Loop], Loop]:
    """The same for a loop that scenes call with these types of arguments, in numba's notation.

    `const(...)` is an array that cannot be written to; a loop that gets both kinds names both.
    """

    def plan(loop: Loop) -> Loop:
        dispatcher = compiled(loop)
        _planned.setdefault(loop.__module__, []).extend((dispatcher, each) for each in types)
        return dispatcher

    return plan


def compile_planned() -> int:
    """Compile what the imported loops name types for; returns how many this process compiled. All are kept afterwards.

    Takes none where all are kept already, or where none could be kept.
    """
    if _folder is None:
        return 0
    taken = 0
    collects = gc.isenabled()
    gc.disable()  # compiling takes 0.83 of the time without, and 2 MB more for each loop until it runs again
    try:
        for wait in (False, True):
            for module, planned in _planned.items():
                if not _kept(module).exists() and _locks.acquire(module, wait):
                    taken += _compile_module(module, planned)
    finally:
        if collects:
            gc.enable()
    return taken


def _compile_module(module: str, planned: list[tuple[Any, str]]) -> int:
    """Compile a locked module's planned loops unless another process did since; how many."""
    if _kept(module).exists():
        _locks.release()
        return 0
    with _locks.hold():
        for loop, types in planned:
            loop.compile(_types_of(types))
        _kept(module).touch()  # before another process gets the lock
    return len(planned)


def _types_of(text: str) -> Any:
    """A tuple of numba's types, from `compiled_for`'s notation."""
    names = {**vars(numba.types), "const": lambda array: array.copy(readonly=True)}
    return eval(f"({text},)", names)


def _kept(module: str) -> Path:
    """The file that says that a module's planned loops are kept, for this processor and numba."""
    what = "\n".join((numba.__version__, str(_config.CPU_NAME), str(_config.CPU_FEATURES)))
    return cast(Path, _folder) / f"{module}-{hashlib.sha256(what.encode()).hexdigest()[:8]}.kept"
