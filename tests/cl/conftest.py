"""Fixtures of the tests that need an OpenCL device."""

import pytest

from stss_cl.device.discovery import Device, DeviceError, open_device


@pytest.fixture(scope="session")
def device() -> Device:
    """The device that the backend chooses by itself, or the one that ``$STSS_DEVICE`` names."""
    try:
        return open_device()
    except DeviceError as error:
        pytest.skip(str(error))
