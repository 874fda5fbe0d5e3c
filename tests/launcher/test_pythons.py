"""Which Python the launcher takes, what it says of others, and PyBullet where it has no wheel for the one it takes."""

import hashlib
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from tests.launcher.conftest import ROOT, Checkout, locked, project

LOCK = """\
numpy==2 \\
    --hash=sha256:a
pybullet==3 \\
    --hash=sha256:b \\
    --hash=sha256:c
scipy==1 \\
    --hash=sha256:d
"""


def taken(checkout: Checkout) -> str:
    """The name of the interpreter that `.venv` is made with."""
    return (checkout.venv / "bin" / "python").readlink().name


# ------------------------------------------------------------------------------------------------ the choice


@pytest.mark.parametrize(
    ("there", "chosen"),
    [
        (("3.11", "3.12", "3.13"), "python3.11"),
        (("3.13", "3.12"), "python3.12"),
        (("3.13",), "python3.13"),
    ],
)
def test_it_takes_the_oldest_python_that_it_can_and_names_it_once(checkout, there, chosen):
    checkout.has(*there)
    checkout.fault("has-wheel")
    _, _, err = checkout.run("--version")
    assert taken(checkout) == chosen and f"first start: making .venv with {checkout.bin}/{chosen} (" in err
    assert checkout.run("--version")[2] == ""


def test_the_python_of_an_environment_is_kept_until_another_one_is_asked_for(checkout):
    checkout.has("3.12")
    checkout.fault("has-wheel")
    checkout.run("--version")
    checkout.has("3.11", "3.12", "3.13")
    (checkout.root / "pyproject.toml").write_text("something else\n")
    assert "bringing .venv up to date" in checkout.run("--version")[2] and taken(checkout) == "python3.12"
    checkout.environ["VERSO_PYTHON"] = "python3.13"
    assert "anew" in checkout.run("--version")[2] and taken(checkout) == "python3.13"
    for asked in ("", "python3.13", str(checkout.bin / "python3.13")):
        checkout.environ["VERSO_PYTHON"] = asked
        assert checkout.run("--version")[2] == ""


@pytest.mark.parametrize(
    ("asked", "wrong"),
    [
        ("nosuch", "there is no such program"),
        ("/bin", "there is no such program"),
        ("/bin/ls", "is not Python 3"),
        ("python3", "is CPython 3.10.9"),
    ],
)
def test_a_python_that_is_asked_for_and_does_not_fit_is_refused_and_no_other_taken(checkout, asked, wrong):
    checkout.has("3.11")
    checkout.environ["VERSO_PYTHON"] = asked
    code, out, err = checkout.run("--version")
    assert (code, out, err.count("\n")) == (1, "", 1) and f"VERSO_PYTHON={asked}" in err and wrong in err
    assert "CPython 3.11, 3.12 or 3.13" in err and not checkout.venv.exists()
    del checkout.environ["VERSO_PYTHON"]
    assert checkout.run("--version")[0] == 0


ACT = """
import os, platform, runpy, struct, sys, sysconfig
{act}
sys.stdin = open(0)
exec(sys.stdin.read())
"""


@pytest.mark.parametrize(
    ("act", "wrong"),
    [
        ("", None),
        ("sys.implementation.name = 'pypy'; platform.python_implementation = lambda: 'PyPy'", "is PyPy"),
        ("sys.version_info = (3, 14, 2); platform.python_version = lambda: '3.14.2'", "is CPython 3.14.2"),
        ("sysconfig.get_config_var = lambda name: name == 'Py_GIL_DISABLED'", "is free-threaded"),
        ("struct.calcsize = lambda what: 4", "is a 32-bit program"),
        ("platform.machine = lambda: 'aarch64'", "runs on linux aarch64"),
        ("platform.libc_ver = lambda: ('musl', '1.2.5')", "runs with another C library"),
        ("platform.libc_ver = lambda: ('', '')", "runs with another C library"),
        ("platform.libc_ver = lambda: ('glibc', '2.17')", "runs with glibc 2.17"),
    ],
)
def test_the_probe_tells_what_is_wrong_with_an_interpreter(checkout, tmp_path, act, wrong):
    (tmp_path / "act.py").write_text(ACT.format(act=act))
    (checkout.bin / "python3.12").write_text(f"#!/bin/bash\nexec {sys.executable} -I {tmp_path}/act.py\n")
    checkout.environ["VERSO_PYTHON"] = "python3.12"
    (checkout.venv / "theirs").mkdir(parents=True)
    code, _, err = checkout.run("--version")
    assert code == 1 and (f"VERSO_PYTHON=python3.12 {wrong}" if wrong else "was not made by this launcher") in err, err


def test_without_a_python_it_takes_one_of_uv_or_else_names_three_ways_on(checkout):
    checkout.has()
    for told in ("python3 is CPython 3.10.9", "uv could not"):
        code, out, err = checkout.run("--version")
        assert (code, out) == (1, "") and told in err and not checkout.venv.exists()
        ways = ("put uv on the path", "apt-get install python3.11", "docker compose up")
        assert [way for way in ways if way in err] == list(ways)
        assert sorted(err.find(way) for way in ways) == [err.find(way) for way in ways]
        checkout.fault("uv")  # which is there, and has no network
    managed = checkout.bin.parent / "python3.11"
    shutil.copy(checkout.bin / "python3.11", managed)
    (checkout.faults / "python3.11").unlink()
    (checkout.bin / "python3.11").write_text("#!/bin/bash\nexit 127\n")
    checkout.fault("uv", str(managed))
    checkout.calls()
    code, _, err = checkout.run("--version")
    assert code == 0 and "installing CPython 3.11 with uv" in err and taken(checkout) == "python3.11"
    assert checkout.calls()[0] == "uv python install 3.11"


# ------------------------------------------------------------------------------------------------ PyBullet


def from_source(checkout: Checkout) -> str:
    how = "--no-build-isolation --use-pep517 --require-hashes"
    return f"pip {how} --cache-dir {checkout.faults.parent}/.cache/verso/pybullet-o3 -r {checkout.venv}/verso-pybullet.lock"


def test_pybullet_alone_is_compiled_where_it_has_no_wheel_and_after_all_else(checkout):
    checkout.has("3.12")
    (checkout.root / "requirements.lock").write_text(LOCK)
    tried = locked(".venv/verso-pybullet.lock", checkout.root)
    rest = locked(".venv/verso-wheels.lock", checkout.root)
    code, _, err = checkout.run("--version")
    assert code == 0 and "no wheel for Python 3.12: compiling it" in err
    assert checkout.calls() == ["venv", tried, rest, from_source(checkout), project(checkout.root)]
    parts = [(checkout.venv / f"verso-{part}.lock").read_text() for part in ("wheels", "pybullet")]
    numpy, pybullet, scipy = LOCK.replace("\npy", "\n|py").replace("\nsc", "\n|sc").split("|")
    assert parts == [numpy + scipy, pybullet]
    checkout.fault("has-wheel")
    shutil.rmtree(checkout.venv)
    assert "compiling" not in checkout.run("--version")[2]
    assert checkout.calls() == ["venv", tried, rest, project(checkout.root)]


def test_what_it_is_compiled_with_is_installed_or_else_asked_for_before_anything_large_is_loaded(checkout):
    checkout.has("3.13")
    (checkout.root / "requirements.lock").write_text(LOCK)
    tools = [checkout.fault(name) for name in ("no-compiler", "no-headers")]
    denied = checkout.fault("not-root")
    code, _, err = checkout.run("--version")
    assert code == 1 and "apt-get install g++ python3.13-dev" in err and "or with Python 3.11" in err
    tried = locked(".venv/verso-pybullet.lock", checkout.root)
    assert checkout.calls() == ["venv", tried]
    denied.unlink()
    checkout.run("--version")
    assert checkout.calls()[0] == "apt-get --no-install-recommends g++ python3.13-dev"
    for tool in tools:
        tool.unlink()
    assert checkout.run("--version")[0] == 0


def test_a_killed_compilation_is_begun_again_by_the_next_start(checkout):
    checkout.has("3.12")
    (checkout.root / "requirements.lock").write_text(LOCK)
    checkout.kill_while_pip_hangs("--version", at="--use-pep517")
    code, _, err = checkout.run("--version")
    assert code == 0 and "did not finish" in err and from_source(checkout) in checkout.calls()


# A backend that writes one module, after it has said that it runs and waited to be told to go on.
BACKEND = """
import os, pathlib, time, zipfile

def build_wheel(folder, settings=None, metadata=None, name="{name}"):
    place = pathlib.Path("{place}")
    with open(place / "built", "a") as log:
        log.write(name + " " + os.environ.get("CXXFLAGS", "") + "|")
    while (place / "wait").exists():
        (place / "hanging").touch()
        time.sleep(0.05)
    with zipfile.ZipFile(os.path.join(folder, name + "-1.0-py3-none-any.whl"), "w") as wheel:
        info = name + "-1.0.dist-info/"
        wheel.writestr(name + ".py", "")
        wheel.writestr(name + ".pth", os.getcwd() if name == "verso" else "")  # as an editable installation
        wheel.writestr(info + "METADATA", "Metadata-Version: 2.1\\nName: " + name + "\\nVersion: 1.0\\n")
        wheel.writestr(info + "WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr(info + "RECORD", "")
    return name + "-1.0-py3-none-any.whl"

build_editable = build_wheel
"""
BUILD = '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n# '


def add_source(checkout: Checkout, remark: str) -> str:
    """A source of `pybullet` for pip to find; its SHA-256."""
    backend = BACKEND.format(name="pybullet", place=checkout.faults)
    meta = "Metadata-Version: 2.1\nName: pybullet\nVersion: 1.0\n"
    path = checkout.faults / "pybullet-1.0.tar.gz"
    with tarfile.open(path, "w:gz") as archive:
        for name, text in (("PKG-INFO", meta), ("pyproject.toml", BUILD + remark), ("backend.py", backend)):
            member = tarfile.TarInfo(f"pybullet-1.0/{name}")
            member.size = len(text)
            archive.addfile(member, io.BytesIO(text.encode()))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_compiled_pybullet_is_kept_by_its_sources_hash_and_half_of_one_never(checkout):
    """With pip itself: the interpreter says that it is another one than it is."""
    checkout.has("3.12")
    base = os.path.realpath(sys._base_executable)
    (checkout.bin / "python3.12").write_text(
        f'#!/bin/bash\n[ "$*" != "-I -" ] || exec echo "3.12 {base}"\nexec {base} "$@"\n'
    )
    checkout.environ |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(checkout.faults), "CXXFLAGS": "-ffast-math"}
    ours = BACKEND.format(name="verso", place=checkout.faults)
    (checkout.root / "backend.py").write_text(ours)
    (checkout.root / "pyproject.toml").write_text(BUILD)
    (checkout.root / "services" / "cli").mkdir(parents=True)
    (checkout.root / "services" / "cli" / "main.py").write_text("import numpy, pybullet; print('started')")
    exec(ours, made := {})
    wheel = checkout.faults / made["build_wheel"](checkout.faults, name="numpy")
    numpy = hashlib.sha256(wheel.read_bytes()).hexdigest()

    def start(*, expect: str) -> None:
        (checkout.faults / "built").unlink(missing_ok=True)
        shutil.rmtree(checkout.venv, ignore_errors=True)
        done = checkout.run("--version")
        assert done[:2] == (0, "started\n"), done[2]
        assert (checkout.faults / "built").read_text() == expect

    def pin(digest: str) -> None:
        text = f"numpy==1.0 \\\n    --hash=sha256:{numpy}\npybullet==1.0 \\\n    --hash=sha256:{digest}\n"
        (checkout.root / "requirements.lock").write_text(text)

    pin(add_source(checkout, "one"))
    wait = checkout.fault("wait")
    checkout.kill_while_pip_hangs("--version")
    wait.unlink()
    compiled = "pybullet -O3 -DNDEBUG -fwrapv|"  # not with the user's flags
    start(expect=f"{compiled}verso -ffast-math|")
    start(expect="verso -ffast-math|")
    pin(add_source(checkout, "another"))
    start(expect=f"{compiled}verso -ffast-math|")


# ------------------------------------------------------------------------------------------------ the same bytes


def installed(minor: int) -> str:
    """A CPython 3.`minor` of this machine for which PyBullet is compiled, or has a wheel; else the test is skipped."""
    name, home = f"python3.{minor}", Path.home()
    managed = (*home.glob(f".pyenv/versions/3.{minor}.*"), *home.glob(f".local/share/uv/python/cpython-3.{minor}.*"))
    ready = minor == 11 or any((home / ".cache/verso/pybullet-o3").rglob(f"pybullet-*-cp3{minor}-*.whl"))
    for path in (shutil.which(name), *(folder / "bin" / name for folder in managed)):
        if ready and path and subprocess.run([path, "-V"], capture_output=True, check=False).returncode == 0:
            return str(path)
    pytest.skip(f"no CPython 3.{minor} with a compiled PyBullet is here")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("minor", [minor for minor in (11, 12, 13) if minor != sys.version_info.minor])
def test_another_python_makes_the_same_dataset_and_verifies_it(tmp_path, minor):
    def digest(*command: str, **environ: str) -> str:
        words = (*command, "run", "deploy/jobs/tabletop.yaml", "--scenes", "16", "--out", f"{tmp_path}/{len(environ)}")
        out = subprocess.run(
            words, cwd=ROOT, check=True, capture_output=True, text=True, env=os.environ | environ
        ).stdout
        return re.findall("dataset digest (.*)", out)[0]

    python = installed(minor)
    left_out = shutil.ignore_patterns(".*", "data", "docs", "tests", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, tmp_path / "checkout", ignore=left_out)
    launcher = str(tmp_path / "checkout" / "verso")
    ours = digest(sys.executable, "-P", "-m", "services.cli.main", PYTHONPATH=str(ROOT))
    assert digest(launcher, VERSO_PYTHON=python, PYTHONPATH="") == ours
    subprocess.run([launcher, "verify", str(tmp_path / "2")], check=True, capture_output=True)
