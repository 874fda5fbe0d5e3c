"""A copy of the launcher with an interpreter and package tools that only log what they are asked to do."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = ("pathtraced", "study")
LOCKS = ("requirements.lock", *(f"requirements-{name}.lock" for name in (*EXTRAS, "dev")))

# Answers the launcher's probe, makes a `.venv` that links back to itself, and logs every call of pip. PyBullet has no wheel.
# Files named after what should go wrong, in the folder $FAULTS, make it go wrong; one named after a program says what it is.
FAKE_PYTHON = r"""#!/bin/bash
log() { echo "$*" >>"$FAULTS/log"; }
self="$(readlink -f "$0")"
name="${self##*/}"
case "$*" in
  "-I -") cat >/dev/null; cat "$FAULTS/$name" 2>/dev/null || echo "${name#python} $self" ;;
  "-I -c import os, sysconfig;"*) [ ! -e "$FAULTS/no-headers" ] ;;
  "-I -c import ensurepip, venv") [ ! -e "$FAULTS/no-ensurepip" ] ;;
  "-I -m venv "*) log "venv"; mkdir -p "${!#}/bin"; ln -s "$(readlink -f "$0")" "${!#}/bin/python"
     printf '#!/bin/bash\necho layers\n' >"${!#}/bin/lint-imports"; chmod +x "${!#}/bin/lint-imports"; echo "chatter" ;;
  "-I -m pip --version") ;;
  "-I -m pip "*) log "$@"; echo "chatter"
     [ -e "$FAULTS/pip-fails" ] && exit 1
     [[ "$*" = *--only-binary*pybullet.lock && ! -e "$FAULTS/has-wheel" ]] && exit 1
     [ -e "$FAULTS/pip-hangs" ] && [[ "$*" = *"$(cat "$FAULTS/pip-hangs")"* ]] && { touch "$FAULTS/hanging"; sleep 60; }
     [ -e "$FAULTS/pip-is-slow" ] && sleep 0.5; true ;;
  "-P -m services.cli.environment") echo "OMP_NUM_THREADS=1" ;;
  "-m pytest "*) printf '%s|' pytest "${@:3}" "path=$PYTHONPATH" "threads=$OMP_NUM_THREADS" "in=$PWD"
     [ -z "${PYTHONDONTWRITEBYTECODE-}" ] || echo "compiles all anew"
     exit "$(cat "$FAULTS/pytest" 2>/dev/null || echo 0)" ;;
  "-m ruff "* | "-m mypy") echo "${@:2}"; [ ! -e "$FAULTS/$2-fails" ] ;;
  "-P -m services.cli.main"*) printf '%s|' "${@:4}" "path=${PYTHONPATH-}" "in=$PWD" "typed=$VERSO_TYPED"
     [ ! -e "$FAULTS/exit" ] || exit "$(cat "$FAULTS/exit")" ;;
  *) echo "unexpected: $*" >&2; exit 99 ;;
esac
"""

# There when $FAULTS/uv is; brings the interpreter whose path that file holds, once it was told to install it.
FAKE_UV = r"""#!/bin/bash
case "$*" in
  "--version") [ -e "$FAULTS/uv" ] ;;
  "python install 3.11") echo "uv $*" >>"$FAULTS/log"; [ -s "$FAULTS/uv" ] && touch "$FAULTS/uv-installed" ;;
  "python find --system --no-project 3.11") [ -e "$FAULTS/uv-installed" ] && cat "$FAULTS/uv" ;;
  *) exit 99 ;;
esac
"""

FAKES = {
    "python3.11": FAKE_PYTHON,
    "python3.12": FAKE_PYTHON,
    "python3.13": FAKE_PYTHON,
    "python3": FAKE_PYTHON,
    "uv": FAKE_UV,
    "g++": '#!/bin/bash\n[ ! -e "$FAULTS/no-compiler" ]\n',
    "dpkg-query": '#!/bin/bash\n[ -e "$FAULTS/no-$4" ] || echo "install ok installed"\n',
    "apt-get": '#!/bin/bash\necho "apt-get ${@: -3}" >>"$FAULTS/log"; [ ! -e "$FAULTS/apt-fails" ]\n',
    "id": '#!/bin/bash\n[ -e "$FAULTS/not-root" ] && echo 1000 || echo 0\n',
    "sudo": "#!/bin/bash\nexit 1\n",
}


class Checkout:
    """A copy of the launcher and its files, and the fakes it will find on the path."""

    def __init__(self, folder: Path) -> None:
        self.root, self.faults, self.bin = folder / "check out", folder / "faults", folder / "bin"
        for made in (self.root, self.faults, self.bin):
            made.mkdir()
        shutil.copy(ROOT / "verso", self.root)
        for name in (*LOCKS, "pyproject.toml"):
            (self.root / name).write_text(f"contents of {name}\n")
        for name, script in FAKES.items():
            (self.bin / name).write_text(script)
            (self.bin / name).chmod(0o755)
        self.venv = self.root / ".venv"
        self.environ: dict[str, str] = {}
        self.through: list[str] = []
        """What starts the launcher."""

    def start(self, *args: str, launcher: Path | None = None, cwd: Path | None = None) -> subprocess.Popen[str]:
        environ = {
            "PATH": f"{self.bin}:/usr/bin:/bin",
            "FAULTS": str(self.faults),
            "PYTHONPATH": "/opt/ros",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        environ |= {"HOME": str(self.faults.parent), **self.environ}
        command = [*self.through, str(launcher or self.root / "verso"), *args]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command, env=environ, cwd=cwd or self.faults, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )

    def run(self, *args: str, launcher: Path | None = None, cwd: Path | None = None) -> tuple[int, str, str]:
        process = self.start(*args, launcher=launcher, cwd=cwd)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err

    def fault(self, name: str, text: str = "") -> Path:
        file = self.faults / name
        file.write_text(text)
        return file

    def has(self, *versions: str) -> None:
        """Leaves these Pythons alone on the path."""
        for name in ("3.11", "3.12", "3.13", "3"):
            self.fault(f"python{name}", "is not Python 3" if name != "3" else "is CPython 3.10.9")
        for version in versions:
            (self.faults / f"python{version}").unlink()

    def kill_while_pip_hangs(self, *args: str, at: str = "") -> None:
        """Starts, and ends the launcher and its children once it is in a call of pip that has `at` in it."""
        fault = self.fault("pip-hangs", at)
        process = self.start(*args)
        for _ in range(400):
            if (self.faults / "hanging").exists():
                break
            time.sleep(0.05)
        else:
            pytest.fail("the launcher never came to pip")
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        fault.unlink()
        (self.faults / "hanging").unlink()
        self.calls()

    def calls(self) -> list[str]:
        """What was asked of pip, venv and apt-get since the last time."""
        log = self.faults / "log"
        lines = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        return [line.replace("-I -m pip install --quiet --no-deps ", "pip ") for line in lines]


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def locked(name: str, root: Path, *options: str) -> str:
    return " ".join(["pip --only-binary :all: --require-hashes", *options, f"-r {root}/{name}"])


def project(root: Path) -> str:
    return f"pip --no-index --no-build-isolation --config-settings editable_mode=compat --editable {root}"
