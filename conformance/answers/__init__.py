# SPDX-License-Identifier: MIT
"""What is right: for each stage's inputs the reference's answer, and how far a port may lie from it."""
