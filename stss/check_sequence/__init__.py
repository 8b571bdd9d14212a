# SPDX-License-Identifier: MIT
"""``stss check``: the content of a sequence, and its usual mistakes."""
