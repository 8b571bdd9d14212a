# SPDX-License-Identifier: MIT
"""The network's launches and the buffers between them."""

from stss_cl.network.network import Network
from stss_cl.options import PRECISIONS, Precision

__all__ = ["PRECISIONS", "Network", "Precision"]
