# SPDX-License-Identifier: MIT
"""EXR and PNG files, and pictures made for the eye."""
