# SPDX-License-Identifier: MIT
"""``stss bench``: times and errors beside those of other engines, and with ``--pareto`` of every setting."""
