# SPDX-License-Identifier: MIT
"""Files that are written: whole or not at all, never over a file that is read, by one process at a time."""
