# SPDX-License-Identifier: MIT
"""``make lowest``: the oldest versions that pyproject.toml allows, as requirements of pip, one a line."""

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
EXTRAS = ("conform",)


def lowest(requirement):
    """``a>=1.2; marker`` as ``a==1.2.*; marker``."""
    match = re.fullmatch(r"([\w.\[\]-]+)>=([\d.]+)(;.*)?", requirement.replace(" ;", ";"))
    if not match:
        raise ValueError(f"{requirement!r}: expected name>=version")
    name, version, marker = match.groups()
    return f"{name}=={version}.*{marker or ''}"


def requirements():
    """Of the default install, and of what the judge and its tests need."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"], *(line for extra in EXTRAS for line in project["optional-dependencies"][extra])]
    return [lowest(requirement) for requirement in requirements]


if __name__ == "__main__":
    sys.stdout.write("\n".join(requirements()) + "\n")
