"""Every test of the backend runs on its device twice: treated as a processor, and as a GPU."""

import pytest

from stss_cl.device.discovery import CLASSES, DeviceError, open_device


@pytest.fixture(scope="session", params=CLASSES)
def device(request):
    """The device that is chosen, or that ``$STSS_DEVICE`` names, with the host code, work-groups and tuning row of a class."""
    return opened_as(request.param)


@pytest.fixture(scope="session")
def processor():
    """The same, treated as a processor, for what only the kernels of processors know: tile sizes of Winograd, vectors."""
    return opened_as("cpu")


def opened_as(device_class):
    try:
        opened = open_device(device_class=device_class)
    except DeviceError as error:
        pytest.skip(str(error))
    if device_class == "cpu" and opened.kind != "CPU":
        pytest.skip(f"{opened.name} is no processor")
    return opened
