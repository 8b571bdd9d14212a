"""Build the wheel without `stss_lab`, its instruments: ``STSS_LAB=0 pip wheel .`` (a hook of hatchling)."""

import os
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WithoutLab(BuildHookInterface[Any]):
    """Leaves the package and its entry point out where the environment says so."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling: called before files are chosen."""
        del version, build_data
        if os.environ.get("STSS_LAB") == "0":
            self.build_config.target_config["packages"] = [name for name in self.build_config.packages if name != "stss_lab"]
            self.build_config.__dict__.pop("packages", None)
            self.metadata.core.entry_points.pop("stss.commands", None)
