"""Fixtures that tests in this folder may ask for."""

from tests.kit.faults import unflushed

__all__ = ["unflushed"]
