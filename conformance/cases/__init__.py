# SPDX-License-Identifier: MIT
"""What the suite asks: strategies for the inputs of every stage."""
