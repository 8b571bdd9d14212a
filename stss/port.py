# SPDX-License-Identifier: MIT
"""Our backends as ports, under the name that ``stss conform --port stss.port:OpenCLPort`` takes."""

from stss.conform.own_ports import OpenCLPort, ReferencePort, cl_direct, cl_half

__all__ = ["OpenCLPort", "ReferencePort", "cl_direct", "cl_half"]
