# SPDX-License-Identifier: MIT
"""Launches of the image-space stages: warping, holes, occlusion."""

from stss_cl.image_space.prepare import Prepare
from stss_cl.image_space.stages import ImageStages

__all__ = ["ImageStages", "Prepare"]
