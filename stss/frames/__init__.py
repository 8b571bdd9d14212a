# SPDX-License-Identifier: MIT
"""Display frames as arrays, the input of a backend, and the backends."""
