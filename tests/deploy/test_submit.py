"""deploy/submit.py on the head of a real cluster that was started in a bare shell."""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from schemas.environment import cache_folder
from schemas.errors import MachineError
from services.job.job_file import load_job
from services.queue import drivers
from tests.datasets import run_here
from tests.kit.ray_head import ROOT, BareCluster, bare_cluster

SUBMIT = str(ROOT / "deploy" / "submit.py")
JOB = "name: shapes\nseed: 2024\nscenes: 4\ncategories: [box, can]\nrun: {range_size: 2}\n"
ODD = "a b;touch x $(touch y) `touch z` 'q' \"r\" && |"


@dataclass(frozen=True)
class Head:
    """A home on the head, as deploy/cluster.yaml leaves it: jobs, storage and a token."""

    home: Path
    cluster: BareCluster

    def start(self, *words: str, **more: str) -> "subprocess.Popen[str]":
        shell = {**self.cluster.shell, "PYTHONPATH": str(ROOT), "HOME": str(self.home)}
        shell |= {"RAY_API_SERVER_ADDRESS": self.cluster.dashboard, "VERSO_STORAGE": str(self.home / "storage")}
        shell |= {"NUMBA_CACHE_DIR": str(cache_folder("loops")), **more}  # a new home has no compiled loops
        pipe = subprocess.PIPE
        run = [sys.executable, SUBMIT, *words]
        return subprocess.Popen(run, cwd=self.home, env=shell, stdout=pipe, stderr=pipe, text=True)

    def submit(self, *words: str, **more: str) -> tuple[int, str, str]:
        process = self.start(*words, **more)
        out, err = process.communicate(timeout=200)
        return process.returncode, out, err


@pytest.fixture(scope="module")
def head(tmp_path_factory) -> Iterator[Head]:
    home = tmp_path_factory.mktemp("head")
    (home / "verso" / "jobs").mkdir(parents=True)
    (home / "verso" / "jobs" / "shapes.yaml").write_text(JOB)
    (home / "storage").mkdir()
    with bare_cluster(dashboard=True) as cluster:
        yield Head(home, cluster)


def starting(times: int, said: str) -> list[tuple[str, str]]:
    """(submission, command line) of what a head is asked for which refuses so many times."""
    asked: list[tuple[str, str]] = []

    class Api:
        def submit_job(self, entrypoint: str, submission_id: str) -> None:
            asked.append((submission_id, entrypoint))
            if len(asked) <= times:
                raise RuntimeError(f"Request failed with status code 500: {said}")

        def list_jobs(self) -> list[Any]:
            return []

    handing = drivers.RayDrivers("http://127.0.0.1:1")
    vars(handing)["_client"] = Api()
    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(MachineError):
        patch.setattr(time, "sleep", lambda _: None)
        handing.hand_over("verso-a-1", ["verso", "run", ODD])
    return asked


def test_a_head_that_has_just_started_is_asked_again_for_the_same_job_and_no_other_refusal_is(monkeypatch):
    """Ray's dashboard answers before its agent does."""
    agent = "No available agent to submit job, please try again later.."
    assert len(starting(2, agent)) == 3 and len(set(starting(2, agent))) == 1
    assert shlex.split(starting(0, "")[0][1]) == ["verso", "run", ODD]
    assert len(starting(9, "the submission is refused")) == 1
    monkeypatch.setattr(drivers, "STARTS_S", -1.0)
    assert len(starting(9, agent)) == 1


@pytest.mark.ray
@pytest.mark.minute
def test_a_job_is_made_on_the_cluster_and_its_exit_code_comes_back(head):
    code, out, err = head.submit("shapes.yaml", "--out", "made", "--scenes", "4")
    assert code == 0, out + err
    assert "submit: job verso-shapes-" in err
    job = head.home / "verso" / "jobs" / "shapes.yaml"
    _, digest = run_here(load_job(job), head.home / "here")
    assert re.findall(r"dataset digest (\w{64})", out) == [digest]
    assert (head.home / "storage" / "made" / "_SUCCESS").exists()
    assert (head.home / "storage" / "made" / "manifest" / "_fingerprint.json").exists()
    code, out, err = head.submit("shapes.yaml", "--out", "made", "--scenes", "2")
    assert code == 2 and "fewer scenes than committed" in out + err, "the job's own exit code and words"


@pytest.mark.ray
@pytest.mark.minute
@pytest.mark.slow
def test_words_with_shell_characters_are_text(head):
    """In the name of the job, the output folder and a setting: nothing of it is run, and the dataset says it as written."""
    pack = [sys.executable, "-P", "-m", "services.cli.main", "pack"]
    job = head.home / "odd.yaml"
    job.write_text(JOB + f"# {ODD}\n")
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    packed = subprocess.run([*pack, str(job)], env=environ, capture_output=True, text=True, check=True).stdout.strip()
    code, out, err = head.submit(packed, "--out", ODD, "--scenes", "2", "--set", "categories=[box]")
    assert code == 0, out + err
    assert (head.home / "storage" / ODD / "_SUCCESS").exists()
    code, out, err = head.submit(packed, "--out", "other", "--set", f"name={ODD}")
    assert code == 2 and "name" in out + err and "submit: job" not in err, "refused before it is queued"
    code, _, err = head.submit(packed, "--out", "two\nlines")
    assert code == 2 and "'two\\nlines' has characters that are no part of a name" in err
    left = [path for folder in (head.home, Path("/tmp/ray")) for path in folder.rglob("*")]
    assert not {"x", "y", "z"} & {path.name for path in left}  # what a shell would have made of ODD


@pytest.mark.ray
@pytest.mark.minute
@pytest.mark.slow
def test_a_job_outlives_the_one_who_follows_it_and_can_be_followed_and_stopped(head):
    process = head.start("shapes.yaml", "--out", "left", "--scenes", "60")
    deadline = time.monotonic() + 90
    left = head.home / "storage" / "left" / "manifest" / "_commits"
    while not any(left.glob("*.json")) and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGHUP)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 128 + signal.SIGHUP, said
    job = re.findall("submit: job (verso-.*)", said)[0]
    assert f"--follow {job}" in said and f"--stop {job}" in said
    then = len(list(left.glob("*.json")))
    while len(list(left.glob("*.json"))) <= then:
        assert time.monotonic() < deadline, "the job goes on"
        time.sleep(0.2)
    code, _, err = head.submit("--stop", job)
    assert code == 0 and "is being stopped" in err
    code, _, err = head.submit("--follow", job)
    assert code == 1 and "what is committed is kept" in err


@pytest.mark.ray
@pytest.mark.minute
def test_without_the_token_nobody_submits(head):
    code, _, err = head.submit("shapes.yaml", "--out", "none", RAY_AUTH_TOKEN="f" * 64)
    assert code == 1 and "oken" in err and "Traceback" not in err
    code, _, err = head.submit("shapes.yaml", "--out", "none", RAY_AUTH_TOKEN="")
    assert code == 2 and "no token: set RAY_AUTH_TOKEN" in err
    body = b'{"entrypoint": "touch /tmp/x"}'
    for headers in ({}, {"Authorization": "Bearer " + "f" * 64}):
        asked = urllib.request.Request(f"{head.cluster.dashboard}/api/jobs/", body, headers)
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(asked, timeout=20)
        assert refused.value.code in (401, 403)
        refused.value.close()
    assert not (head.home / "storage" / "none").exists()


@pytest.mark.ray
@pytest.mark.minute
def test_wrong_words_are_refused_in_a_line(head):
    for words, told in (
        ((), "what it takes"),
        (("--out", "x"), "what it takes"),
        (("nothing.yaml", "--out", "x"), "no job 'nothing.yaml': "),
        (("shapes.yaml",), "--out is missing"),
        (("shapes.yaml", "--out", "x", "--address", "auto"), "--address is this cluster's"),
        (("--follow", "nobody"), "nobody"),
        (("--follow",), "what it takes"),
        (("shapes.yaml", "--out", "x", "surplus"), "unrecognized arguments: surplus"),
    ):
        code, _, err = head.submit(*words)
        assert code == 2 and told in err and "Traceback" not in err
