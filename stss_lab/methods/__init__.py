# SPDX-License-Identifier: MIT
"""``stss methods``: the network beside methods without one."""
