# SPDX-License-Identifier: MIT
"""``stss conform`` and ``stss port``: run the judge on a port, and our backends as ports."""
