# SPDX-License-Identifier: MIT
"""The network's launches and the buffers between them."""

from stss_cl.network.network import PRECISIONS, Network, Precision

__all__ = ["PRECISIONS", "Network", "Precision"]
