# SPDX-License-Identifier: MIT
"""Shader nodes for a described material, with the AOVs basecolor, metallic and roughness. Needs bpy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
from bitmaps import picture
from looks import CUTOUTS, PICTURES, PROCEDURAL

AOVS = {"basecolor": "COLOR", "metallic": "VALUE", "roughness": "VALUE"}
AMBIENT_BELOW = 0.4
"""Light from the sky on a face that looks down / light on a face that looks up."""


class Nodes:
    """The nodes of a material, made and linked in one step each."""

    def __init__(self, tree: Any):
        self.tree = tree
        tree.nodes.clear()

    def add(self, kind: str, inputs: Mapping[str | int, Any] | None = None, **settings: Any) -> Any:
        """Add a node; an input is a value or another node's output."""
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def math(self, operation: str, a: Any, b: Any) -> Any:
        """``a operation b`` of two numbers."""
        return self.add("Math", {0: a, 1: b}, operation=operation).outputs[0]

    def span(self, factor: Any, low: float, high: float) -> Any:
        """A number that goes from `low` to `high` as the factor goes from 0 to 1."""
        return self.add("MapRange", {"Value": factor, "To Min": low, "To Max": high}).outputs["Result"]

    def blend(self, factor: Any, a: list[float], b: list[float]) -> Any:
        """A colour that goes from `a` to `b` as the factor goes from 0 to 1."""
        colours = {"Factor": factor, 6: (*a, 1.0), 7: (*b, 1.0)}
        return self.add("Mix", colours, data_type="RGBA").outputs[2]


def _image(look: Mapping[str, Any]) -> Any:
    pixels = picture(look["texture"], look["seed"])
    image = bpy.data.images.new(look["texture"], pixels.shape[1], pixels.shape[0], alpha=True, float_buffer=False)
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    return image


def _texture(nodes: Nodes, look: Mapping[str, Any]) -> tuple[Any, Any]:
    """The factor between the two colours, and the opacity (None: opaque)."""
    kind, where = look["texture"], nodes.add("TexCoord")
    if kind in CUTOUTS or kind in PICTURES:
        # Cards and bushes have texture coordinates; solids show the picture on each side, with a width in metres.
        flat = look.get("flat", kind in CUTOUTS)
        scale = 1.0 if flat else min(1.0, 0.4 * look["scale"])
        vector = nodes.add("Mapping", {"Vector": where.outputs["UV" if flat else "Object"], "Scale": (scale,) * 3})
        node = nodes.add("TexImage", {"Vector": vector.outputs[0]}, image=_image(look), projection="FLAT" if flat else "BOX")
        red = nodes.add("SeparateColor", {0: node.outputs["Color"]}).outputs[0]
        return red, nodes.math("GREATER_THAN", node.outputs["Alpha"], 0.5) if kind in CUTOUTS else None
    if kind not in PROCEDURAL:
        return 0.0, None
    # Shifted, since the faces of a cube would otherwise lie just between two squares of a checkerboard.
    vector = nodes.add("Mapping", {"Vector": where.outputs["Object"], "Location": (0.137, 0.211, 0.173)}).outputs[0]
    node = nodes.add(f"Tex{kind.capitalize()}", {"Vector": vector, "Scale": look["scale"]})
    if kind == "brick":
        node.inputs["Color1"].default_value, node.inputs["Color2"].default_value = (0.9, 0.9, 0.9, 1), (0.5, 0.5, 0.5, 1)
        node.inputs["Mortar"].default_value = (0, 0, 0, 1)
        return nodes.add("SeparateColor", {0: node.outputs["Color"]}).outputs[0], None
    if kind == "wave":
        node.wave_type, node.bands_direction = ("BANDS", "RINGS")[look["seed"] % 2], "XYZ"[look["seed"] // 2 % 3]
        node.inputs["Distortion"].default_value = 1.5 * (look["seed"] // 6 % 3)
    if kind == "noise":
        node.inputs["Detail"].default_value = 6.0
        return nodes.span(node.outputs[0], -1.0, 2.0), None
    # Outputs by number, since "Factor" was "Fac" before Blender 5.
    return node.outputs[0 if kind == "voronoi" else 1], None


def _write_aovs(nodes: Nodes, values: Mapping[str, Any], opacity: Any) -> None:
    """Write the AOVs that the G-buffer needs.

    Cycles adds up the AOVs of all surfaces that a ray goes through, so transparent parts must write 0.
    """
    for name, value in values.items():
        node = nodes.add("OutputAOV", aov_name=name)
        if AOVS[name] == "COLOR":
            if opacity is not None:
                value = nodes.add("VectorMath", {0: value, "Scale": opacity}, operation="SCALE").outputs[0]  # noqa: PLW2901
            nodes.tree.links.new(value, node.inputs["Color"])
        else:
            nodes.tree.links.new(value if opacity is None else nodes.math("MULTIPLY", value, opacity), node.inputs["Value"])


def _ambient(nodes: Nodes, amount: float, metallic: Any, glow: float) -> Any:
    """Light from the sky as a glow of the surface: without rays, so without noise."""
    up = nodes.add("SeparateXYZ", {0: nodes.add("NewGeometry").outputs["Normal"]}).outputs[2]
    share = nodes.add("MapRange", {"Value": up, "From Min": -1.0, "To Min": AMBIENT_BELOW * amount, "To Max": amount}).outputs[0]
    shine = nodes.math("ADD", nodes.math("MULTIPLY", share, nodes.math("SUBTRACT", 1.0, metallic)), glow)
    # Diffuse rays do not see it, since so few rays would only give noise.
    return nodes.math("MULTIPLY", shine, nodes.math("SUBTRACT", 1.0, nodes.add("LightPath").outputs["Is Diffuse Ray"]))


def build_material(look: Mapping[str, Any], ambient: float) -> Any:
    """Make a material.

    Args:
        look: the material in the scene's description.
        ambient: brightness of the light from the sky, which the surface glows with instead of sending rays.
    """
    made = bpy.data.materials.new(look["texture"])
    made.use_nodes = True
    made.cycles.emission_sampling = "NONE"  # the glow is visible but lights nothing, so that it adds no noise
    nodes = Nodes(made.node_tree)
    factor, opacity = _texture(nodes, look)
    colour = nodes.blend(factor, look["b"], look["a"])
    metallic, roughness = nodes.span(factor, *look["metallic"]), nodes.span(factor, *look["roughness"])
    inputs: dict[str | int, Any] = {"Base Color": colour, "Metallic": metallic, "Roughness": roughness}
    inputs |= {"Emission Color": colour, "Emission Strength": _ambient(nodes, ambient, metallic, look["glow"])}
    if opacity is not None:
        inputs["Alpha"] = opacity
    if not look["gloss"]:
        inputs["Specular IOR Level"] = 0.0
    if look["bump"]:
        inputs["Normal"] = nodes.add("Bump", {"Height": factor, "Strength": look["bump"], "Distance": 0.05}).outputs[0]
    shader = nodes.add("BsdfPrincipled", inputs)
    nodes.add("OutputMaterial", {"Surface": shader.outputs[0]})
    _write_aovs(nodes, {"basecolor": colour, "metallic": metallic, "roughness": roughness}, opacity)
    return made


def build_sky(sky: Mapping[str, Any], tree: Any, *, dome: bool) -> None:
    """Build a sky: a gradient from the horizon up, and on a dome clouds in front of it."""
    nodes = Nodes(tree)
    where = nodes.add("TexCoord").outputs["Generated"]
    up = nodes.add("SeparateXYZ", {0: where}).outputs[2]
    height = nodes.add("MapRange", {"Value": up, "From Min": 0.5 if dome else 0.0, "From Max": 0.8 if dome else 0.7}).outputs[0]
    colour = nodes.blend(height, sky["horizon"], sky["zenith"])
    if not dome:
        nodes.add("OutputWorld", {"Surface": nodes.add("Background", {"Color": colour}).outputs[0]})
        return
    noise = nodes.add("TexNoise", {"Vector": where, "Scale": 4 * sky["clouds"], "Detail": 5.0}).outputs[0]
    cloud = nodes.add("MapRange", {"Value": noise, "From Min": 0.5, "From Max": 0.65}).outputs[0]
    white = 1.1 * max(sky["horizon"])
    mixed = nodes.add("Mix", {"Factor": cloud, 6: colour, 7: (white, white, white, 1.0)}, data_type="RGBA").outputs[2]
    nodes.add("OutputMaterial", {"Surface": nodes.add("Emission", {"Color": mixed}).outputs[0]})
    black, one = nodes.blend(0.0, [0.0] * 3, [0.0] * 3), nodes.span(0.0, 1.0, 1.0)
    _write_aovs(nodes, {"basecolor": black, "metallic": nodes.span(0.0, 0.0, 0.0), "roughness": one}, None)
