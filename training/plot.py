# SPDX-License-Identifier: MIT
"""Draw the curves of a run's log, if matplotlib is installed."""

from __future__ import annotations

import json
from pathlib import Path

from stss_ground.errors import InputError
from stss_ground.optional import require


def plot(log: Path, picture: Path) -> None:
    """Draw the loss, and the PSNR of SF and EF beside bilinear's; without matplotlib, do nothing."""
    try:
        figure = require("matplotlib.figure").Figure(figsize=(9, 7), layout="constrained")
    except InputError:
        return
    records = [json.loads(line) for line in log.read_text().splitlines()]
    top, bottom = figure.subplots(2, 1, sharex=True)
    losses = [(r["step"], r["loss"]) for r in records if "loss" in r]
    top.plot([s for s, _ in losses], [v for _, v in losses], linewidth=1)
    top.set_ylabel("loss")
    top.set_yscale("log")
    start = next((r["bilinear"] for r in records if "bilinear" in r), {})
    scored = [r for r in records if "validation" in r]
    for kind, color in (("SF", "tab:blue"), ("EF", "tab:red"), ("EF holes", "tab:orange")):
        shown = [(r["step"], r["validation"][kind]) for r in scored if kind in r["validation"]]
        bottom.plot([s for s, _ in shown], [v for _, v in shown], color=color, label=kind)
        if kind in start:
            bottom.axhline(start[kind], color=color, linestyle=":", label=f"{kind}, bilinear")
    bottom.set_ylabel("PSNR over RGB, dB, validation")
    bottom.set_xlabel("step")
    bottom.legend(ncols=3)
    figure.savefig(picture, dpi=100)
