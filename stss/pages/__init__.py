# SPDX-License-Identifier: MIT
"""Pages to look at: one HTML file that works from disk, without a network."""
