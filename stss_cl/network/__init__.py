# SPDX-License-Identifier: MIT
"""The network's launches and the buffers between them."""
