# SPDX-License-Identifier: MIT
"""The judge: it draws cases, asks a port, and compares its answers."""
