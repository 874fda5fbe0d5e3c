"""The files for Ray's launcher: valid by Ray's own schema, the token on every node, no port open that need not be."""

import json
from pathlib import Path

import jsonschema
import pytest
import ray
import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
FILES = sorted(path.name for path in DEPLOY.glob("cluster*.yaml"))
SCHEMA = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())


def tree_of(name: str) -> dict:
    return yaml.safe_load((DEPLOY / name).read_text())


def test_there_is_a_file_for_machines_of_ones_own_and_for_two_clouds():
    assert [tree_of(name)["provider"]["type"] for name in FILES] == ["aws", "gcp", "local"]


@pytest.mark.parametrize("name", FILES)
def test_rays_own_schema_takes_the_file(name):
    jsonschema.validate(tree_of(name), SCHEMA)


@pytest.mark.parametrize("name", FILES)
def test_every_shell_on_every_node_has_the_token_and_ray_asks_for_it(name):
    tree = tree_of(name)
    assert tree["file_mounts"]["~/verso/token"] == "~/.verso-token"
    env = (DEPLOY.parent / tree["file_mounts"]["~/verso/env"]).read_text()
    assert "export RAY_AUTH_MODE=token\n" in env and 'export RAY_AUTH_TOKEN_PATH="$HOME/verso/token"\n' in env
    for command in (*tree["head_start_ray_commands"], *tree["worker_start_ray_commands"]):
        assert command.startswith(". ~/verso/env; ray ")
    assert any("chmod 600 ~/verso/token" in command for command in tree["setup_commands"])


@pytest.mark.parametrize("name", FILES)
def test_the_dashboard_listens_on_loopback_alone(name):
    start = tree_of(name)["head_start_ray_commands"][-1]
    assert "--dashboard-host=127.0.0.1" in start and "0.0.0.0" not in (DEPLOY / name).read_text()


def test_in_the_clouds_workers_are_spot_and_the_head_is_not():
    aws, gcp = (tree_of(f"cluster-{cloud}.yaml")["available_node_types"] for cloud in ("aws", "gcp"))
    assert aws["worker"]["node_config"]["InstanceMarketOptions"]["MarketType"] == "spot"
    assert gcp["worker"]["node_config"]["scheduling"][0]["provisioningModel"] == "SPOT"
    assert "InstanceMarketOptions" not in aws["head"]["node_config"] and "scheduling" not in gcp["head"]["node_config"]
    assert all(types["worker"]["min_workers"] >= 1 for types in (aws, gcp)), "a run refuses a cluster without a core"


def test_on_aws_one_network_alone_reaches_ssh_and_nothing_else_is_open():
    (rule,) = tree_of("cluster-aws.yaml")["provider"]["security_group"]["IpPermissions"]
    assert (rule["FromPort"], rule["ToPort"]) == (22, 22)
    assert all(network["CidrIp"] != "0.0.0.0/0" for network in rule["IpRanges"])


@pytest.mark.parametrize("name", FILES)
def test_what_is_mounted_from_the_checkout_is_there(name):
    sources = [source for source in tree_of(name)["file_mounts"].values() if not source.startswith("~")]
    assert [source for source in sources if source != "dist" and not (DEPLOY.parent / source).exists()] == []
