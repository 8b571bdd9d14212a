"""Every test of the backend runs on its device twice: treated as a processor, and as a GPU."""

import pytest

from stss_cl.device.discovery import CLASSES, DeviceError, open_device


@pytest.fixture(scope="session", params=CLASSES)
def device(request):
    """The device that is chosen, or that ``$STSS_DEVICE`` names, with the host code, work-groups and tuning row of a class."""
    try:
        opened = open_device(device_class=request.param)
    except DeviceError as error:
        pytest.skip(str(error))
    if request.param == "cpu" and opened.kind != "CPU":
        pytest.skip(f"{opened.name} is no processor")
    return opened
