"""Ray's job API where it cannot be used; a real one is in test_real_queue.py."""

import socket

import pytest

from schemas.errors import MachineError
from services.queue.drivers import RayDrivers


def test_an_address_where_nothing_answers_is_told_in_one_line():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{unused.getsockname()[1]}"
        drivers = RayDrivers(address)
        for ask in (
            drivers.states,
            lambda: drivers.stop("verso-j00000001-1"),
            lambda: drivers.log("verso-j00000001-1"),
        ):
            with pytest.raises(
                MachineError, match=rf"^--address {address}: Ray's job API does not answer there[^\n]*$"
            ):
                ask()
