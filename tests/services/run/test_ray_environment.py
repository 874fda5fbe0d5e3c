"""The variables of a private Ray. What they do is asked of real ones in test_ray_cluster.py and test_ray_network.py."""

import subprocess
import sys

from services.run.ray_cluster import NOT_INHERITED, private_environment


def test_each_run_has_a_token_of_its_own_that_nobody_guesses():
    first, second = (private_environment()["RAY_AUTH_TOKEN"] for _ in range(2))
    assert first != second
    assert len(bytes.fromhex(first)) >= 32


def test_the_rest_is_the_same_for_every_run():
    first, second = ({**private_environment(), "RAY_AUTH_TOKEN": ""} for _ in range(2))
    assert first == second
    assert first["RAY_AUTH_MODE"] == "token"
    assert not set(NOT_INHERITED) & set(first)


def test_asking_for_it_does_not_import_ray():
    ask = "import sys; from services.run.ray_cluster import private_environment; private_environment()"
    subprocess.run([sys.executable, "-c", f"{ask}; assert 'ray' not in sys.modules"], check=True)
