"""docker-compose.yml as a file: known to compose 1.29 and 2, and closed to everyone who is not asked in."""

import re
from typing import Any

import jsonschema
import pytest
import yaml

from tests.json_shapes import TEXT, TRUTH, closed, each
from tests.kit.containers import ROOT, must, run

FILE = ROOT / "docker-compose.yml"

TEXTS = {"type": "array", "items": TEXT, "uniqueItems": True}


SERVICE = closed(
    build=closed(context=TEXT, dockerfile=TEXT),
    image=TEXT,
    platform=TEXT,
    user=TEXT,
    cap_add=TEXTS,
    cap_drop=TEXTS,
    security_opt=TEXTS,
    read_only=TRUTH,
    init=TRUTH,
    tmpfs=TEXTS,
    shm_size=TEXT,
    stop_grace_period=TEXT,
    cpus={"type": ["number", "string"]},
    environment=each(TEXT),
    networks=TEXTS,
    volumes=TEXTS,
    command=TEXT,
    depends_on=each(closed(condition={"enum": ["service_started", "service_healthy"]})),
    healthcheck=closed(test=TEXTS, interval=TEXT, timeout=TEXT, start_period=TEXT, retries={"type": "number"}),
)
"""What the compose specification defines and both compose 1.29 and compose 2 know, as far as this file uses it.

Written from the specification. The whole of its published schema is in the compose of this machine, which the last test asks.
"""

SCHEMA = {
    "type": "object",
    "properties": {
        "services": each(SERVICE),
        "networks": each(closed(internal=TRUTH, driver_opts=each(TEXT))),
        "volumes": each(closed(driver_opts=each(TEXT))),
    },
    "patternProperties": {"^x-": {}},
    "additionalProperties": False,
}


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return dict(yaml.safe_load(FILE.read_text()))


@pytest.fixture(scope="module")
def services(compose) -> dict[str, Any]:
    return dict(compose["services"])


def test_the_file_uses_what_both_versions_of_compose_know(compose):
    jsonschema.validate(compose, SCHEMA)


def test_a_word_that_compose_does_not_know_would_be_found(compose):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**compose, "services": {"head": {"read-only": True}}}, SCHEMA)


def test_there_are_a_head_workers_and_a_job(services):
    assert set(services) == {"head", "worker", "job"}
    assert set(services["job"]["depends_on"]) == {"head", "worker"}


def test_no_service_may_write_gain_rights_or_be_reached(compose, services):
    for name, service in services.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert service["init"] is True, name
        assert service["networks"] == ["cluster"], name
        assert not {"ports", "expose", "network_mode", "privileged", "pid", "ipc", "devices"} & set(service), name
    assert compose["networks"]["cluster"]["internal"] is True


def test_the_dashboard_listens_on_loopback_and_the_token_is_not_in_the_file(services):
    assert "--dashboard-host=127.0.0.1" in services["head"]["command"]
    for service in services.values():
        environ = service["environment"]
        assert environ["RAY_AUTH_MODE"] == "token"
        assert "RAY_AUTH_TOKEN" not in environ
        assert environ["RAY_AUTH_TOKEN_PATH"].startswith("/run/verso/")
    assert re.search(r"[0-9a-f]{16}", FILE.read_text()) is None


def test_the_token_is_kept_in_memory_and_only_the_head_may_write_it(compose, services):
    assert compose["volumes"]["token"]["driver_opts"]["type"] == "tmpfs"
    assert "token:/run/verso" in services["head"]["volumes"]
    for name in ("worker", "job"):
        assert "token:/run/verso:ro" in services[name]["volumes"]


def test_readme_and_launcher_say_what_the_file_says():
    printed = set(re.findall(r"^# +(docker compose .*)$", FILE.read_text(), re.M))
    assert "docker compose up --build --exit-code-from job" in printed
    for name in ("README.md", "verso"):
        said = re.findall(r"docker compose (?:up|run|down)[^`\"\n]*", (ROOT / name).read_text())
        assert said, name
        assert {_plain(line) for line in said} <= {_plain(line) for line in printed}, name


@pytest.mark.docker
def test_the_compose_of_this_machine_takes_the_file(tmp_path):
    (tmp_path / FILE.name).write_text(FILE.read_text())
    assert must(run("docker", "compose", "config", "--services", cwd=tmp_path)).split()
    (tmp_path / FILE.name).write_text(FILE.read_text().replace("read_only:", "read-only:"))
    assert run("docker", "compose", "config", "--quiet", cwd=tmp_path).returncode != 0  # it does look


def _plain(line: str) -> str:
    """The words of a command, without remarks and without --build, which is for the first time."""
    words = line.partition("  ")[0].replace("--build ", "")
    return " ".join(words.split())
