"""Fixtures that tests in this folder may ask for."""

from tests.disk_faults import unflushed

__all__ = ["unflushed"]
