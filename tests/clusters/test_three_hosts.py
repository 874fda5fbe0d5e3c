"""A cluster of three hosts on this machine that `ray up` starts: the dataset is the local one, whatever host is lost."""

import contextlib
import json
import os
import re
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from tests.datasets import LOOK, SMALL

ROOT = Path(__file__).resolve().parents[2]
HOSTS = ROOT.parent / "shared" / "tools" / "hosts"
FOLDER = Path("/tmp/hosts")
BIN = Path(sys.executable).parent


def hosts(*words: str, check: bool = True) -> str:
    """What the tool says."""
    done = subprocess.run([str(HOSTS), *words], capture_output=True, text=True, check=False, timeout=120)
    assert not check or done.returncode == 0, f"hosts {' '.join(words)}: {done.stdout}{done.stderr}"
    return done.stdout


@contextlib.contextmanager
def three_hosts() -> Iterator[None]:
    """Hosts 1 to 3 at 10.77.0.1 to .3; this machine's files are theirs too."""
    hosts("up", "3")
    try:
        yield
    finally:
        hosts("down")


@dataclass(frozen=True)
class Cluster:
    """deploy/cluster.yaml, filled in for the hosts; host 1 is the head, and the launcher runs there too."""

    folder: Path
    file: Path

    @property
    def storage(self) -> Path:
        """What VERSO_STORAGE names."""
        return self.folder / "storage"

    def ray(self, *words: str, timeout: float = 800) -> "subprocess.CompletedProcess[str]":
        """A command of Ray's launcher, from the root of the checkout as the file says."""
        return subprocess.run(self._command(*words), capture_output=True, text=True, check=False, timeout=timeout)

    def start(self, *words: str) -> "subprocess.Popen[str]":
        """The same, running."""
        pipe = subprocess.PIPE
        return subprocess.Popen(self._command(*words), stdout=pipe, stderr=subprocess.STDOUT, text=True)

    def _command(self, *words: str) -> list[str]:
        enter = [str(HOSTS), "run", "1", "env", "-i", f"PATH={BIN}:{os.environ['PATH']}", f"HOME={self.folder}"]
        enter += ["RAY_UP_enable_autoscaler_v2=0", "TERM=dumb", "sh", "-c", f'cd {ROOT} && exec "$@"', "sh"]
        yes = ["-y"] if words[0] in ("up", "down") else []
        return [*enter, str(BIN / "ray"), words[0], *yes, str(self.file), *words[1:]]

    def submit(self, *words: str) -> "subprocess.CompletedProcess[str]":
        """`ray submit deploy/cluster.yaml deploy/submit.py ...`."""
        return self.ray("submit", str(ROOT / "deploy" / "submit.py"), *words)

    def nodes(self) -> int:
        """How many nodes the head counts, 0 where there is no head."""
        if hosts("run", "1", "bash", "-c", "exec 3<>/dev/tcp/10.77.0.1/6379 && echo open", check=False) != "open\n":
            return 0
        environ = ["env", f"PATH={BIN}:{os.environ['PATH']}", "RAY_AUTH_MODE=token"]
        environ += [f"RAY_AUTH_TOKEN={(self.folder / '.verso-token').read_text().strip()}"]
        ask = "import ray; ray.init('10.77.0.1:6379', log_to_driver=False); print('alive', sum(n['Alive'] for n in ray.nodes()))"
        said = hosts("run", "1", *environ, sys.executable, "-c", ask, check=False)
        return int((re.findall(r"alive (\d+)", said) or ["0"])[0])

    def up(self, nodes: int = 3) -> float:
        """Starts the cluster, and waits for its nodes; the seconds that it took."""
        begun = time.monotonic()
        done = self.ray("up")
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        while (count := self.nodes()) < nodes:
            assert time.monotonic() < begun + 200, f"{count} nodes of {nodes}: {done.stdout[-2000:]}"
            time.sleep(1.0)
        return time.monotonic() - begun


QUICK = "export RAY_health_check_period_ms=1000 RAY_health_check_timeout_ms=1000 RAY_health_check_failure_threshold=5\n"
"""The head counts a host that was cut off as lost after about 10 s; by default it does so after about a minute."""


def filled_in(folder: Path) -> Cluster:
    """deploy/cluster.yaml with the hosts' addresses, without what installs: the hosts see this machine's Python and code."""
    tree = yaml.safe_load((ROOT / "deploy" / "cluster.yaml").read_text())
    tree["provider"] |= {"head_ip": "10.77.0.1", "worker_ips": ["10.77.0.2", "10.77.0.3"]}
    tree["auth"] = {"ssh_user": "root", "ssh_private_key": str(FOLDER / "key")}
    (folder / "storage").mkdir()
    (folder / ".verso-token").write_text(secrets.token_hex(32))
    env = (ROOT / "deploy" / "cluster.env").read_text()
    env = env.replace("/mnt/verso", str(folder / "storage")).replace("$HOME/verso/venv/bin", str(BIN))
    (folder / "env").write_text(f"{env}export PYTHONPATH={ROOT}\n{QUICK}")
    mounts = tree["file_mounts"]
    del mounts["~/verso/dist"]
    mounts |= {"~/verso/env": str(folder / "env"), "~/verso/token": str(folder / ".verso-token")}
    tree["setup_commands"] = [line for line in tree["setup_commands"] if "verso/venv" not in line]
    tree["worker_start_ray_commands"][-1] += " --num-cpus=1"
    tree["head_start_ray_commands"][-1] += " --num-cpus=1"
    file = folder / "cluster.yaml"
    file.write_text(yaml.safe_dump(tree))
    return Cluster(folder, file)


VERSO = (sys.executable, "-P", "-m", "services.cli.main")
pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not HOSTS.exists(), reason="no ../shared/tools/hosts beside the checkout"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cluster")


@pytest.fixture(scope="module")
def cluster(folder) -> Iterator[Cluster]:
    with three_hosts():
        started = filled_in(folder)
        print(f"\nray up: {started.up():.0f} s")
        yield started


@pytest.fixture(scope="module")
def job(folder) -> Path:
    """48 scenes with small pictures, in ranges of two."""
    file = folder / "small.yaml"
    file.write_text(json.dumps({**SMALL, "seed": 2024, "scenes": 48, "run": {"range_size": 2}}))
    return file


def digest_in(said: str) -> str:
    return (re.findall(r"dataset digest (\w{64})", said) or [said])[0]


def here(*words: str) -> str:
    """What a command prints on this machine alone."""
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run([*VERSO, *words], cwd="/", env=environ, capture_output=True, text=True, check=True).stdout


def run_here(job: Path, out: Path, *words: str) -> str:
    """The digest of a run on this machine alone."""
    return digest_in(here("run", str(job), "--out", str(out), *words))


@pytest.fixture(scope="module")
def local(job) -> str:
    return run_here(job, job.parent / "local")


@pytest.fixture(scope="module")
def packed(job) -> str:
    return here("pack", str(job)).strip()


def await_commits(out: Path, count: int, process: "subprocess.Popen[str]") -> None:
    deadline = time.monotonic() + 180
    while len(list(out.glob("manifest/_commits/*.json"))) < count:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline, f"{out} has not {count} commits"
        time.sleep(0.1)


def events(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "_logs" / "verso.jsonl").read_text().splitlines()]


def made_in_vain(out: Path) -> int:
    """Scenes that were begun by workers that were lost before they committed."""
    lost = [event for event in events(out) if event["event"] == "worker lost"]
    return sum(event["scene"] - event["range"] + 1 for event in lost if event["scene"] is not None)


def lose_two_hosts(cluster: Cluster, job: str, out: Path, *words: str) -> str:
    """What `ray submit` says of a job during which host 2 is killed and host 3 is cut off."""
    begun = time.monotonic()
    process = cluster.start("submit", str(ROOT / "deploy" / "submit.py"), job, "--out", out.name, *words)
    try:
        await_commits(out, 3, process)
        hosts("kill", "2", check=False)
        hosts("cut", "3")
        said = process.communicate(timeout=800)[0]
    finally:
        process.kill()
        hosts("join", "3")
        hosts("boot", "2")
    assert process.returncode == 0, said
    print(f"\ntwo of three hosts lost: {time.monotonic() - begun:.0f} s, {made_in_vain(out)} scenes made in vain")
    return said


def lose_the_head(cluster: Cluster, job: str, out: Path, *words: str) -> str:
    """What `ray submit` says of a job after its head was killed and brought back."""
    process = cluster.start("submit", str(ROOT / "deploy" / "submit.py"), job, "--out", out.name, *words)
    await_commits(out, 3, process)
    hosts("kill", "1", check=False)
    process.communicate(timeout=60)
    kept = len(list(out.glob("manifest/_commits/*.json")))
    hosts("boot", "1")
    up, begun = cluster.up(nodes=2), time.monotonic()
    done = cluster.submit(job, "--out", out.name, *words)
    assert done.returncode == 0, done.stdout[-3000:]
    print(f"\nhead killed with {kept} ranges: up again {up:.0f} s, the rest {time.monotonic() - begun:.0f} s")
    assert kept >= 3
    return done.stdout


def test_a_worker_host_killed_and_one_cut_off_under_way_change_no_byte(cluster, packed, local):
    out = cluster.storage / "disturbed"
    assert digest_in(lose_two_hosts(cluster, packed, out)) == local
    assert made_in_vain(out) <= 2 * 2 * 2, "at most the ranges that the two hosts had"


def test_a_killed_head_that_is_brought_back_and_asked_again_makes_the_same_dataset(cluster, packed, local):
    assert digest_in(lose_the_head(cluster, packed, cluster.storage / "headless")) == local


MORE = [{"name": "around", "ring": {"count": 3, "radius_m": [1.0, 2.0]}}, {"name": "side", "beside": "input"}]
CHANGES = {
    "rings": {"scene": "studio", "cameras": {**SMALL["cameras"], "more": MORE}},
    "look": {"look": LOOK},
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_job_is_the_same_where_hosts_are_lost_and_where_it_is_extended(cluster, folder, name):
    file = folder / f"{name}.yaml"
    for scenes in (20, 48):
        file.write_text(json.dumps({**SMALL, **CHANGES[name], "run": {"range_size": 2}, "scenes": scenes}))
        extended = run_here(file, folder / f"{name}_extended")
    packed = here("pack", str(file)).strip()
    assert digest_in(lose_two_hosts(cluster, packed, cluster.storage / name)) == extended
