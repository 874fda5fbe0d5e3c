"""The image as KubeRay starts it: its start commands, its probes, its submitter, the hook before SIGTERM.

Containers stand in for pods, with the security settings of deploy/kuberay/rayjob.yaml. What KubeRay runs in them is taken
from its operator (common/pod.go and common/job.go, releases 1.1 to 1.7).
"""

import json
import secrets
import time
from pathlib import Path

import pytest

from tests.kit.containers import IMAGE, JOB, SCENES, Done, digest_of, docker, must, wait_for

pytestmark = [pytest.mark.docker, pytest.mark.slow, pytest.mark.timeout(600)]

NETWORK = f"{IMAGE}-pods"
HEAD = f"{NETWORK}-head"
WORKER = f"{NETWORK}-worker"

BLOCK = "--metrics-export-port=8080 --block --dashboard-agent-listen-port=52365"
START_HEAD = f"ray start --head --dashboard-host=0.0.0.0 --num-cpus=0 --object-store-memory=134217728 {BLOCK}"
START_WORKER = f"ray start --address={HEAD}:6379 --num-cpus=2 --object-store-memory=134217728 {BLOCK}"

RAYLET = "wget --tries 1 -T 2 -q -O- http://localhost:52365/api/local_raylet_healthz | grep success"
GCS = "wget --tries 1 -T 10 -q -O- http://localhost:8265/api/gcs_healthz | grep success"
"""The probes of operators that know Ray before 2.53; later ones ask /api/healthz of the agent over HTTP."""


@pytest.fixture(scope="module")
def token() -> str:
    return secrets.token_hex(32)


@pytest.fixture(scope="module")
def pods(image, token, tmp_path_factory):
    """A head and a worker that are ready; the folder in the place of the volume."""
    volume = tmp_path_factory.mktemp("volume")
    volume.chmod(0o777)
    try:
        must(docker("network", "create", "--internal", NETWORK))
        _start(HEAD, volume, token, "-c", f"ulimit -n 65536; {START_HEAD}")
        wait_for(lambda: not _bash(HEAD, f"{RAYLET} && {GCS}").returncode, 60, "probes of the head")
        # Operators before 1.2 start a login shell, whose PATH is its own.
        _start(WORKER, volume, token, "-lc", f"ulimit -n 65536; {START_WORKER}")
        wait_for(lambda: not _bash(WORKER, RAYLET).returncode, 60, "probes of the worker")
        yield volume
    finally:
        docker("rm", "--force", HEAD, WORKER)
        docker("network", "rm", NETWORK)


@pytest.mark.parametrize(("asker", "asked"), [(WORKER, HEAD), (HEAD, WORKER)])
def test_the_probe_over_http_is_answered_without_the_token(pods, asker, asked):
    url = f"http://{asked}:52365/api/healthz"
    answer = must(docker("exec", "-e", "RAY_AUTH_TOKEN=", asker, "wget", "-q", "-T", "5", "-O-", url))
    assert "raylet: success" in answer


def test_a_job_without_the_token_is_refused_and_does_not_run(pods, token):
    refused = _submit("wrong", "without-token", f"touch {pods}/ran")
    assert refused.returncode != 0
    assert "token" in (refused.stdout + refused.stderr).lower()
    asks = ("ray", "job", "list", "--address", f"http://{HEAD}:8265")
    listing = must(docker("exec", "-e", f"RAY_AUTH_TOKEN={token}", HEAD, *asks))
    assert "without-token" not in listing
    assert not (pods / "ran").exists()


def test_a_job_that_is_submitted_as_kuberay_does_it_makes_the_same_bytes(pods, token, expected_digest):
    entrypoint = f"verso run /opt/verso/{JOB} --scenes {SCENES} --address auto --out /data/tabletop --json"
    done = _submit(token, "verso", f"{entrypoint} --shard-size 1 --set run.range_size=2")
    assert "succeeded" in must(done)
    assert digest_of(pods / "tabletop") == expected_digest


def test_the_hook_before_sigterm_ends_the_node(pods):
    begun = time.monotonic()
    docker("exec", WORKER, "/opt/verso/deploy/entrypoint", "drain")
    wait_for(lambda: _state(WORKER)["Status"] == "exited", 30, "the worker's end")
    assert time.monotonic() - begun < 25
    assert _state(WORKER)["OOMKilled"] is False
    asks = ("ray", "list", "nodes", "--format", "json", "--detail", "--filter", "is_head_node=False")
    (node,) = json.loads(must(docker("exec", HEAD, *asks)))
    assert node["state"] == "DEAD"
    assert "Terminated due to preemption" in node["state_message"]  # it said good-bye, and was not lost


def _start(name: str, volume: Path, token: str, *bash: str) -> None:
    """A container with a pod's settings: not root, nothing writable but memory and the volume, no capability."""
    closed = ("--user", "1000:1000", "--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges")
    memory = ("--tmpfs", "/tmp:mode=1777,exec", "--tmpfs", "/home/verso:mode=1777", "--shm-size", "512m")
    environ = ("-e", "RAY_AUTH_MODE=token", "-e", f"RAY_AUTH_TOKEN={token}")
    place = ("--network", NETWORK, "--hostname", name, "-v", f"{volume}:/data")
    must(
        docker("run", "-d", "--name", name, *place, *closed, *memory, *environ, "--entrypoint=/bin/bash", IMAGE, *bash)
    )


def _bash(name: str, command: str) -> Done:
    return docker("exec", name, "bash", "-c", command)


def _submit(token: str, job: str, entrypoint: str) -> Done:
    """The script of KubeRay's submitter, in a container of its own; follows the job to its end."""
    address = f"--address http://{HEAD}:8265"
    script = (
        f"if ! ray job status {address} {job} >/dev/null 2>&1 ; "
        f"then ray job submit {address} --no-wait --submission-id {job} -- {entrypoint} ; fi ; "
        f"ray job logs {address} --follow {job}"
    )
    environ = ("-e", "RAY_AUTH_MODE=token", "-e", f"RAY_AUTH_TOKEN={token}")
    return docker("run", "--rm", "--network", NETWORK, *environ, "--entrypoint=/bin/bash", IMAGE, "-ec", script)


def _state(name: str) -> dict[str, object]:
    return dict(json.loads(must(docker("inspect", "--format", "{{json .State}}", name))))
