# SPDX-License-Identifier: MIT
"""Analytic scenes with exact truth: a small ray caster, NumPy only, that knows no port.

`render` gives a frame with its exact G-buffer or its supersampled truth, `look` single rays, `SCENES` the scenes by
name.
"""

from conformance.scenes.library import DEMO, SCENES
from conformance.scenes.render import Rendered, look, render
from conformance.scenes.scene import Camera, Light, Object, Scene

__all__ = ["DEMO", "SCENES", "Camera", "Light", "Object", "Rendered", "Scene", "look", "render"]
