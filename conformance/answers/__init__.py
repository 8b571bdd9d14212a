# SPDX-License-Identifier: MIT
"""The right answers: for each stage's inputs the reference's answer, and the allowed error of a port."""
