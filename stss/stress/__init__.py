# SPDX-License-Identifier: MIT
"""``stss stress``: what each stage loses against float64."""
