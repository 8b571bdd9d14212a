# SPDX-License-Identifier: MIT
"""A renderer's files as display frames: names, channels, conventions."""
