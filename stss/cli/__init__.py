# SPDX-License-Identifier: MIT
"""The command line: options, and one function for each command. The work is done in the room of the command's name."""
