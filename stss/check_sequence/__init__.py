# SPDX-License-Identifier: MIT
"""``stss check``: what a sequence has, and what usually goes wrong with it."""
