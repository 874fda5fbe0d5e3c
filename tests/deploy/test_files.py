"""The files of deploy/ as files: the token on every node, and no port open that need not be."""

import json
import re
from pathlib import Path

import jsonschema
import pytest
import ray
import yaml

from services.run.progress import Meter, Tally
from tests.kit.containers import ROOT

DEPLOY = ROOT / "deploy"
COMPOSE = ROOT / "docker-compose.yml"
RAY_JOB = DEPLOY / "kuberay" / "rayjob.yaml"

# ------------------------------------------------------------------------------------------------ Ray's launcher

CLUSTERS = {path.name: yaml.safe_load(path.read_text()) for path in sorted(DEPLOY.glob("cluster*.yaml"))}


def test_there_is_a_file_for_machines_of_ones_own_and_for_two_clouds_that_rays_own_schema_takes():
    assert [tree["provider"]["type"] for tree in CLUSTERS.values()] == ["aws", "gcp", "local"]
    schema = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
    for name, tree in CLUSTERS.items():
        jsonschema.validate(tree, schema)
        sources = [source for source in tree["file_mounts"].values() if not source.startswith("~") and source != "dist"]
        assert [source for source in sources if not (ROOT / source).exists()] == [], name


@pytest.mark.parametrize("name", CLUSTERS)
def test_every_shell_on_every_node_has_the_token_and_the_dashboard_listens_on_loopback_alone(name):
    tree = CLUSTERS[name]
    assert tree["file_mounts"]["~/verso/token"] == "~/.verso-token"
    env = (ROOT / tree["file_mounts"]["~/verso/env"]).read_text()
    assert "export RAY_AUTH_MODE=token\n" in env and 'export RAY_AUTH_TOKEN_PATH="$HOME/verso/token"\n' in env
    for command in (*tree["head_start_ray_commands"], *tree["worker_start_ray_commands"]):
        assert command.startswith(". ~/verso/env; ray ")
    assert any("chmod 600 ~/verso/token" in command for command in tree["setup_commands"])
    assert "--dashboard-host=127.0.0.1" in tree["head_start_ray_commands"][-1]
    assert "0.0.0.0" not in (DEPLOY / name).read_text()


def test_in_the_clouds_workers_are_spot_the_head_is_not_and_one_network_alone_reaches_ssh():
    aws, gcp = (CLUSTERS[f"cluster-{cloud}.yaml"]["available_node_types"] for cloud in ("aws", "gcp"))
    assert aws["worker"]["node_config"]["InstanceMarketOptions"]["MarketType"] == "spot"
    assert gcp["worker"]["node_config"]["scheduling"][0]["provisioningModel"] == "SPOT"
    assert "InstanceMarketOptions" not in aws["head"]["node_config"] and "scheduling" not in gcp["head"]["node_config"]
    assert all(types["worker"]["min_workers"] >= 1 for types in (aws, gcp)), "a run refuses a cluster without a core"
    (rule,) = CLUSTERS["cluster-aws.yaml"]["provider"]["security_group"]["IpPermissions"]
    assert (rule["FromPort"], rule["ToPort"]) == (22, 22)
    assert all(network["CidrIp"] != "0.0.0.0/0" for network in rule["IpRanges"])


# ------------------------------------------------------------------------------------------------ KubeRay

DOCUMENTS = {document["kind"]: document for document in yaml.safe_load_all(RAY_JOB.read_text())}
JOB = DOCUMENTS["RayJob"]["spec"]
PODS = {
    "submitter": JOB["submitterPodTemplate"]["spec"],
    "head": JOB["rayClusterSpec"]["headGroupSpec"]["template"]["spec"],
    "worker": JOB["rayClusterSpec"]["workerGroupSpecs"][0]["template"]["spec"],
}


def test_every_pod_is_closed_and_calls_need_a_token_that_is_not_in_the_file():
    assert DOCUMENTS["RayJob"]["apiVersion"] == "ray.io/v1"
    assert f"\nray=={JOB['rayClusterSpec']['rayVersion']} " in (ROOT / "requirements.lock").read_text()
    assert JOB["rayClusterSpec"]["authOptions"] == {"mode": "token"} and "RAY_AUTH" not in RAY_JOB.read_text()
    for name, pod in PODS.items():
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        assert pod["automountServiceAccountToken"] is False, name
        (container,) = pod["containers"]
        closed = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
        assert container["securityContext"] == closed, name
        mounted = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert {mounted["tmp"], mounted["home"]} == {"/tmp", "/home/verso"}, name
        assert set(mounted) == {volume["name"] for volume in pod["volumes"]}, name


def test_workers_may_be_taken_away_let_their_ranges_end_first_and_the_head_is_kept():
    tolerated = {toleration["key"] for toleration in PODS["worker"]["tolerations"]}
    assert {"cloud.google.com/gke-spot", "kubernetes.azure.com/scalesetpriority"} <= tolerated
    preferred = PODS["worker"]["affinity"]["nodeAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    required = PODS["head"]["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
    (avoided,) = required["nodeSelectorTerms"]
    wanted = {(term["key"], *term["values"]) for one in preferred for term in one["preference"]["matchExpressions"]}
    assert {(term["key"], *term["values"]) for term in avoided["matchExpressions"]} == wanted
    assert "tolerations" not in PODS["head"]
    (worker,) = PODS["worker"]["containers"]
    assert worker["lifecycle"]["preStop"]["exec"]["command"] == ["/opt/verso/deploy/entrypoint", "drain"]
    (waits,) = re.findall(r"RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=(\d+)", (DEPLOY / "Dockerfile").read_text())
    assert PODS["worker"]["terminationGracePeriodSeconds"] >= int(waits) + 5


def test_the_run_uses_the_cluster_and_the_volume():
    words = JOB["entrypoint"].split()
    assert words[:2] == ["verso", "run"] and (ROOT / words[2].removeprefix("/opt/verso/")).exists()
    assert words[words.index("--address") + 1] == "auto"
    claim = DOCUMENTS["PersistentVolumeClaim"]
    assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
    for name in ("head", "worker"):
        (mount,) = (one for one in PODS[name]["containers"][0]["volumeMounts"] if one["name"] == "data")
        assert words[words.index("--out") + 1].startswith(f"{mount['mountPath']}/")
        (volume,) = (one for one in PODS[name]["volumes"] if one["name"] == "data")
        assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]


# ------------------------------------------------------------------------------------------------ compose

TREE = yaml.safe_load(COMPOSE.read_text())
SERVICES = TREE["services"]


def test_no_service_may_write_gain_rights_or_be_reached():
    assert set(SERVICES) == {"head", "worker", "job"} and set(SERVICES["job"]["depends_on"]) == {"head", "worker"}
    for name, service in SERVICES.items():
        assert service["read_only"] is True and service["init"] is True, name
        assert service["cap_drop"] == ["ALL"] and "no-new-privileges:true" in service["security_opt"], name
        assert service["networks"] == ["cluster"], name
        assert not {"ports", "expose", "network_mode", "privileged", "pid", "ipc", "devices"} & set(service), name
    assert TREE["networks"]["cluster"]["internal"] is True
    assert "--dashboard-host=127.0.0.1" in SERVICES["head"]["command"]


def test_the_token_is_kept_in_memory_and_only_the_head_may_write_it():
    for service in SERVICES.values():
        environ = service["environment"]
        assert environ["RAY_AUTH_MODE"] == "token" and "RAY_AUTH_TOKEN" not in environ
        assert environ["RAY_AUTH_TOKEN_PATH"].startswith("/run/verso/")
    assert re.search(r"[0-9a-f]{16}", COMPOSE.read_text()) is None
    assert TREE["volumes"]["token"]["driver_opts"]["type"] == "tmpfs"
    assert "token:/run/verso" in SERVICES["head"]["volumes"]
    assert all("token:/run/verso:ro" in SERVICES[name]["volumes"] for name in ("worker", "job"))


def test_readme_and_launcher_say_what_the_file_says():
    def plain(line: str) -> str:
        """The words of a command, without remarks and without --build, which is for the first time."""
        return " ".join(line.partition("  ")[0].replace("--build ", "").split())

    printed = set(re.findall(r"^# +(docker compose .*)$", COMPOSE.read_text(), re.M))
    assert "docker compose up --build --exit-code-from job" in printed
    for name in ("README.md", "verso"):
        said = re.findall(r"docker compose (?:up|run|down)[^`\"\n]*", (ROOT / name).read_text())
        assert said and {plain(line) for line in said} <= {plain(line) for line in printed}, name


# ------------------------------------------------------------------------------------------------ monitoring

BOARD = json.loads((DEPLOY / "monitoring" / "grafana-dashboard.json").read_text())
QUESTIONS = [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]
"""Every PromQL expression of the dashboard."""


def test_the_dashboard_asks_for_every_metric_that_a_run_serves_and_for_no_other():
    meter = Meter("mugs")
    meter.show({**Tally(1).counts(1), "failed": {"a": 1}, "lost": {"b": 1}, "seconds": {"c": 1.0}})
    served = {sample.name: set(sample.labels) for family in meter.collect() for sample in family.samples}
    for expression in QUESTIONS:
        asked = re.findall(r"(verso_\w+)(?:\{(\w+))?", expression)
        assert asked and all(not label or label in served[name] for name, label in asked), expression
        known = set().union(*(served[name] for name, _ in asked))
        for labels in re.findall(r"by \(([^)]*)\)", expression):
            assert set(re.split(r",\s*", labels)) <= known, expression
        assert all(expression.count(a) == expression.count(b) for a, b in ("()", "[]", "{}")), expression
    assert [name for name in served if name not in " ".join(QUESTIONS)] == []


def test_the_scrape_keeps_the_label_of_the_job():
    """Prometheus has a label `job` of its own, and renames ours unless told otherwise."""
    (scrape,) = yaml.safe_load((DEPLOY / "monitoring" / "prometheus.yml").read_text())["scrape_configs"]
    (only,) = scrape["static_configs"]
    assert scrape["honor_labels"] is True and re.fullmatch(r"[\d.]+:\d+", only["targets"][0])
