# SPDX-License-Identifier: MIT
"""``stss stress``: the digits that each stage loses, compared with float64."""
