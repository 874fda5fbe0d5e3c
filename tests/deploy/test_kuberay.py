"""deploy/kuberay/rayjob.yaml as a file: fields that KubeRay knows, Ray's version, and what its pods may do.

KubeRay's published schema is a megabyte of YAML that no Python package brings. So the fields are checked here as its
reference of the ray.io/v1 API lists them (KubeRay 1.5.1 to 1.7), and a pod's as the core/v1 API does, as far as they are used.
"""

import re
from typing import Any

import jsonschema
import pytest
import yaml

from tests.json_shapes import TEXT, TRUTH, closed, each
from tests.kit.containers import ROOT

FILE = ROOT / "deploy" / "kuberay" / "rayjob.yaml"

COUNT = {"type": "integer", "minimum": 0}
QUANTITY = {"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)?(m|[KMGT]i)?$"}
TEXT_MAP = each(TEXT)
"""rayStartParams and the like: a number that is not quoted is refused."""


def many(value: Any) -> dict[str, Any]:
    return {"type": "array", "items": value, "minItems": 1}


EXPRESSION = closed(
    "key", "operator", key=TEXT, operator={"enum": ["In", "NotIn", "Exists", "DoesNotExist"]}, values=many(TEXT)
)
TERM = closed(matchExpressions=many(EXPRESSION))
RESOURCES = each(QUANTITY)
CONTAINER = closed(
    "name",
    "image",
    name=TEXT,
    image=TEXT,
    securityContext=closed(
        allowPrivilegeEscalation=TRUTH, readOnlyRootFilesystem=TRUTH, capabilities=closed(drop=many(TEXT))
    ),
    resources=closed(requests=RESOURCES, limits=RESOURCES),
    ports=many(closed("containerPort", name=TEXT, containerPort=COUNT)),
    envFrom=many(closed(secretRef=closed("name", name=TEXT, optional=TRUTH))),
    lifecycle=closed(preStop=closed(exec=closed("command", command=many(TEXT)))),
    volumeMounts=many(closed("name", "mountPath", name=TEXT, mountPath=TEXT, readOnly=TRUTH)),
)
POD = closed(
    "spec",
    spec=closed(
        "containers",
        containers=many(CONTAINER),
        restartPolicy={"enum": ["Never", "OnFailure", "Always"]},
        automountServiceAccountToken=TRUTH,
        enableServiceLinks=TRUTH,
        terminationGracePeriodSeconds=COUNT,
        securityContext=closed(
            runAsNonRoot=TRUTH,
            runAsUser=COUNT,
            runAsGroup=COUNT,
            fsGroup=COUNT,
            seccompProfile=closed("type", type=TEXT),
        ),
        tolerations=many(
            closed(key=TEXT, operator={"enum": ["Exists", "Equal"]}, value=TEXT, effect={"enum": ["NoSchedule"]})
        ),
        affinity=closed(
            nodeAffinity=closed(
                requiredDuringSchedulingIgnoredDuringExecution=closed(
                    "nodeSelectorTerms", nodeSelectorTerms=many(TERM)
                ),
                preferredDuringSchedulingIgnoredDuringExecution=many(
                    closed(
                        "weight",
                        "preference",
                        weight={"type": "integer", "minimum": 1, "maximum": 100},
                        preference=TERM,
                    )
                ),
            )
        ),
        volumes=many(
            closed(
                "name",
                name=TEXT,
                emptyDir=closed(sizeLimit=QUANTITY, medium=TEXT),
                persistentVolumeClaim=closed("claimName", claimName=TEXT),
                configMap=closed("name", name=TEXT, optional=TRUTH),
            )
        ),
    ),
)
RAY_JOB = closed(
    "rayClusterSpec",
    "entrypoint",
    entrypoint=TEXT,
    backoffLimit=COUNT,
    shutdownAfterJobFinishes=TRUTH,
    ttlSecondsAfterFinished=COUNT,
    submitterPodTemplate=POD,
    rayClusterSpec=closed(
        "headGroupSpec",
        rayVersion=TEXT,
        authOptions=closed(mode={"enum": ["disabled", "token"]}),
        headGroupSpec=closed("template", "rayStartParams", rayStartParams=TEXT_MAP, template=POD),
        workerGroupSpecs=many(
            closed(
                "groupName",
                "minReplicas",
                "maxReplicas",
                "rayStartParams",
                "template",
                groupName=TEXT,
                replicas=COUNT,
                minReplicas=COUNT,
                maxReplicas=COUNT,
                rayStartParams=TEXT_MAP,
                template=POD,
            )
        ),
    ),
)


@pytest.fixture(scope="module")
def documents() -> dict[str, Any]:
    return {document["kind"]: document for document in yaml.safe_load_all(FILE.read_text())}


@pytest.fixture(scope="module")
def job(documents) -> dict[str, Any]:
    return dict(documents["RayJob"]["spec"])


@pytest.fixture(scope="module")
def pods(job) -> dict[str, Any]:
    cluster = job["rayClusterSpec"]
    (workers,) = cluster["workerGroupSpecs"]
    templates = {
        "submitter": job["submitterPodTemplate"],
        "head": cluster["headGroupSpec"]["template"],
        "worker": workers["template"],
    }
    return {name: template["spec"] for name, template in templates.items()}


def test_the_manifest_has_the_fields_that_kuberay_knows(documents, job):
    assert documents["RayJob"]["apiVersion"] == "ray.io/v1"
    jsonschema.validate(job, RAY_JOB)


def test_a_field_that_kuberay_does_not_know_would_be_found(job):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**job, "submitterPodTemplates": {}}, RAY_JOB)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**job, "rayClusterSpec": {"headGroupSpec": {"rayStartParams": {"num-cpus": 0}}}}, RAY_JOB)


def test_rays_version_is_that_of_the_lock(job):
    locked = re.search(r"^ray==(\S+)", (ROOT / "requirements.lock").read_text(), re.M)
    assert locked is not None
    assert job["rayClusterSpec"]["rayVersion"] == locked[1]


def test_every_pod_is_closed(pods):
    for name, pod in pods.items():
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        assert pod["automountServiceAccountToken"] is False, name
        (container,) = pod["containers"]
        closed_container = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True}
        assert container["securityContext"] == {**closed_container, "capabilities": {"drop": ["ALL"]}}, name
        mounted = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert {mounted["tmp"], mounted["home"]} == {"/tmp", "/home/verso"}, name
        assert set(mounted) == {volume["name"] for volume in pod["volumes"]}, name


def test_calls_need_a_token_that_is_not_in_the_file(job):
    assert job["rayClusterSpec"]["authOptions"] == {"mode": "token"}
    assert "RAY_AUTH" not in FILE.read_text()


def test_workers_may_be_taken_away_and_the_head_is_kept(pods):
    tolerated = {toleration["key"] for toleration in pods["worker"]["tolerations"]}
    assert {"cloud.google.com/gke-spot", "kubernetes.azure.com/scalesetpriority"} <= tolerated
    preferred = pods["worker"]["affinity"]["nodeAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    (avoided,) = pods["head"]["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"][
        "nodeSelectorTerms"
    ]
    wanted = {(term["key"], *term["values"]) for one in preferred for term in one["preference"]["matchExpressions"]}
    assert {(term["key"], *term["values"]) for term in avoided["matchExpressions"]} == wanted
    assert "tolerations" not in pods["head"]


def test_a_worker_lets_its_ranges_end_before_its_time_is_up(pods):
    (worker,) = pods["worker"]["containers"]
    assert worker["lifecycle"]["preStop"]["exec"]["command"] == ["/opt/verso/deploy/entrypoint", "drain"]
    waits = re.search(r"RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=(\d+)", (ROOT / "deploy" / "Dockerfile").read_text())
    assert waits is not None
    assert pods["worker"]["terminationGracePeriodSeconds"] >= int(waits[1]) + 5


def test_the_run_uses_the_cluster_and_the_volume(documents, job, pods):
    words = job["entrypoint"].split()
    assert words[:2] == ["verso", "run"]
    assert (ROOT / words[2].removeprefix("/opt/verso/")).exists()
    assert words[words.index("--address") + 1] == "auto"
    claim = documents["PersistentVolumeClaim"]
    assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
    for name in ("head", "worker"):
        (mount,) = (one for one in pods[name]["containers"][0]["volumeMounts"] if one["name"] == "data")
        assert words[words.index("--out") + 1].startswith(f"{mount['mountPath']}/")
        (volume,) = (one for one in pods[name]["volumes"] if one["name"] == "data")
        assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
