# SPDX-License-Identifier: MIT
"""How a port is asked: the stages, their arrays, a port as an object, a port as a program."""
