# SPDX-License-Identifier: MIT
"""``stss bench``: times beside errors, against other engines; ``--pareto``."""
