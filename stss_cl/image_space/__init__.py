# SPDX-License-Identifier: MIT
"""Launches of the image-space stages: warping, holes, occlusion."""
