"""The image's entry point with stand-ins for `ray` and `verso`: what it starts, and what it does with a signal."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

ENTRYPOINT = Path(__file__).resolve().parents[2] / "deploy" / "entrypoint"

VERSO = """#!/bin/sh
echo verso "$@"
"""

RAY = """#!/bin/sh
echo ray "$@" >>{calls}
case " $* " in *" --address=nowhere"*) echo "no GCS there" >&2; exit 7 ;; esac
case " $* " in *" --block "*) ;; *) exit 0 ;; esac
trap 'echo told to end, drain file: $(ls {drain}) >>{calls}; exit 1' TERM
echo started >>{calls}
while :; do sleep 0.05; done
"""


class Stage:
    """A folder with the stand-ins, and the environment that finds them."""

    def __init__(self, folder: Path) -> None:
        self.calls = folder / "calls"
        self.drain = folder / "drain"
        stands_in = folder / "bin"
        stands_in.mkdir()
        for name, text in (("ray", RAY.format(calls=self.calls, drain=self.drain)), ("verso", VERSO)):
            (stands_in / name).write_text(text)
            (stands_in / name).chmod(0o755)
        self.environ = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "VERSO_"))},
            "PATH": f"{stands_in}:{os.environ['PATH']}",
            "VERSO_DRAIN": str(self.drain),
            "VERSO_NODE_LOG": str(folder / "ray.log"),
            "VERSO_OWNER": "0",  # root stays root here
        }

    def start(self, *args: str, **environ: str) -> subprocess.Popen[str]:
        pipe, environ = subprocess.PIPE, {**self.environ, **environ}
        # A shell cannot trap a signal that was ignored when it began, as Ctrl-C is behind `nohup ... &`.
        command = ["env", "--default-signal=INT", str(ENTRYPOINT), *args]
        return subprocess.Popen(command, env=environ, stdout=pipe, stderr=pipe, text=True)

    def __call__(self, *args: str, **environ: str) -> tuple[int, str, str]:
        with self.start(*args, **environ) as process:
            out, said = process.communicate(timeout=20)
        return process.returncode, out, said

    def called(self) -> list[str]:
        return self.calls.read_text().splitlines() if self.calls.exists() else []


@pytest.fixture
def stage(tmp_path) -> Stage:
    return Stage(tmp_path)


def test_without_a_cluster_or_a_need_for_one_the_arguments_go_to_verso_as_they_are(stage):
    for args in (("status", "data/a b"), ("--help",), ("run", "a job.yaml", "--out", "s3://b/c")):
        assert stage(*args) == (0, f"verso {' '.join(args)}\n", "")
    for option in ("--address=other:6379", "--dry-run", "--help"):
        assert stage("run", "job.yaml", option, VERSO_ADDRESS="head:6379")[1] == f"verso run job.yaml {option}\n"
    assert stage.called() == []


def test_a_run_joins_the_cluster_of_its_network_with_a_node_that_takes_no_work(stage):
    code, out, _ = stage("run", "job.yaml", VERSO_ADDRESS="head:6379")
    assert (code, out) == (0, "verso run job.yaml --address head:6379\n")
    (call,) = stage.called()
    assert call.endswith(" --address=head:6379 --num-cpus=0")
    assert "--node-ip-address=" in call


def test_a_cluster_that_is_not_there_or_a_node_that_ends_is_told_with_what_ray_said(stage):
    code, out, said = stage("run", "job.yaml", VERSO_ADDRESS="nowhere:6379")
    assert (code, out) == (1, "")
    assert "no GCS there" in said and "no cluster could be joined at nowhere:6379" in said
    code, _, said = stage("ray", "start", "--address=nowhere:6379")
    assert code == 1 and "no GCS there" in said and "ended by itself (exit 7)" in said


def test_a_token_that_is_not_there_is_told_with_the_remedy(stage, tmp_path):
    code, _, said = stage("ray", "start", "--address=head:6379", RAY_AUTH_TOKEN_PATH=str(tmp_path / "token"))
    assert code == 1
    assert "docker compose up -d head worker" in said
    assert stage.called() == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_node_that_is_told_to_end_tells_its_workers_before_ray(stage, number):
    stage.drain.touch()  # of a node that was here before
    with stage.start("ray", "start", "--address=head:6379") as node:
        end = time.monotonic() + 10
        while "started" not in stage.called():
            assert time.monotonic() < end, stage.called()
            time.sleep(0.05)
        assert not stage.drain.exists()
        node.send_signal(number)
        node.communicate(timeout=20)
    assert node.returncode == 0
    assert stage.called()[-1] == f"told to end, drain file: {stage.drain}"
