# SPDX-License-Identifier: MIT
"""The cases of the suite: strategies that draw the inputs of every stage, and cases that are made."""
