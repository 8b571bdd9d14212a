# SPDX-License-Identifier: MIT
"""``stss badge``: draw a certificate as a small picture, or write the JSON from which shields.io draws one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from conformance.run_suite import SUITE
from stss.conform.certificate import read_certificate
from stss_ground.errors import InputError
from stss_ground.output.write_whole import write_named

WIDE = 6.6
"""Approximate width of a letter at size 11, pixels; the picture states the length of each text, so that any font fits."""
WHOLE, PART = ("#2f7d32", "green"), ("#7a6a00", "yellowgreen")
"""Colour in the picture and its name for shields.io, for a certificate of all stages and of some."""
_SVG = """<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="20" role="img" aria-label="{label}: {message}">
<title>{label}: {message}</title>
<clipPath id="r"><rect width="{width}" height="20" rx="3"/></clipPath>
<g clip-path="url(#r)"><rect width="{left}" height="20" fill="#444"/>\
<rect x="{left}" width="{right}" height="20" fill="{color}"/></g>
<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">\
<text x="6" y="14" textLength="{left_text}" lengthAdjust="spacingAndGlyphs">{label}</text>\
<text x="{start}" y="14" textLength="{right_text}" lengthAdjust="spacingAndGlyphs">{message}</text></g>
</svg>
"""


def write_badge(certificate: Path, out: Path) -> str:
    """Make a badge of a certificate.

    Args:
        certificate: a file that ``stss conform --certificate`` wrote.
        out: file to write: ``.svg`` for a picture, ``.json`` for an endpoint of shields.io.

    Returns:
        The text of the badge.

    Raises:
        InputError: ``certificate`` is no certificate, ``out`` has another suffix, or a file cannot be read or written.
    """
    if out.suffix not in (".svg", ".json"):
        raise InputError(f"{out}: expected a name that ends with .svg or .json")
    label, message, whole = words(read_certificate(certificate))
    color = WHOLE if whole else PART
    if out.suffix == ".svg":
        write_named(out, _svg(label, message, color[0]))
    else:
        endpoint = {"schemaVersion": 1, "label": label, "message": message, "color": color[1]}
        write_named(out, json.dumps(endpoint, indent=1) + "\n")
    return f"{label}: {message}"


def words(certificate: Mapping[str, Any]) -> tuple[str, str, bool]:
    """The text of the left side, the text of the right side, and whether all stages were judged."""
    stages = certificate["stages"]
    whole = set(stages) == set(SUITE)
    count = "all stages" if whole else f"{len(stages)} of {len(SUITE)}" if len(stages) > 3 else ", ".join(stages)
    arithmetic = certificate["dtype"] + (", Winograd" if certificate.get("winograd") is True else "")
    return f"stss spec {certificate['versions']['specification']}", f"{count}, {arithmetic}, {certificate['tier']}", whole


def _svg(label: str, message: str, color: str) -> str:
    texts = [round(len(text) * WIDE) for text in (label, message)]
    left, right = (text + 12 for text in texts)
    return _SVG.format(
        width=left + right, left=left, right=right, color=color, left_text=texts[0], right_text=texts[1],
        start=left + 6, label=label, message=message,
    )  # fmt: skip
