# SPDX-License-Identifier: MIT
"""Write files whole or not at all, never over a file that is read, by one process at a time."""
