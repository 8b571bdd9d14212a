# SPDX-License-Identifier: MIT
"""``stss methods`` and ``flicker``: the network beside methods without one."""
