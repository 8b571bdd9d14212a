# SPDX-License-Identifier: MIT
"""EXR and PNG files, their transfer functions, and pictures made for the eye."""
