"""What is refused before Ray is asked; runs on a real Ray are in test_step.py."""

import socket

import pytest

from schemas.errors import MachineError
from services.run.ray_cluster import open_ray


@pytest.mark.parametrize("address", ["head", "head:", ":6379", "ray://head", "head:port"])
def test_an_address_without_a_port_is_refused_with_its_form(address):
    with pytest.raises(MachineError, match="write it as HOST:PORT"), open_ray(address, None):
        pass


def test_an_address_where_nothing_answers_is_refused_at_once():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(MachineError, match=f"{address}: no Ray answers there"), open_ray(address, None):
            pass
