# SPDX-License-Identifier: MIT
"""The command line: options and one function a command; all work is done elsewhere."""
