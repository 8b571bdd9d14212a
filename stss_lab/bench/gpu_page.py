# SPDX-License-Identifier: MIT
"""The page of ``stss gpu-report``: what is wrong, the steps and the machine."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def page(folder: Path, report: Mapping[str, Any]) -> str:
    """The page as Markdown.

    Args:
        folder: has the files that the steps wrote.
        report: ``tiny``, ``machine`` and ``steps``, see ``stss_lab.bench.gpu_report``.
    """
    machine, steps = report["machine"], report["steps"]
    wrong = [*_faults(steps), *_slower(_read(folder / "bench.json"))]
    parts = [
        f"# {machine['device']}\n",
        *(["Small sizes, which show that every step runs. **The figures mean nothing.**\n"] if report["tiny"] else []),
        "## What is wrong\n",
        "\n".join(f"- {line}" for line in wrong) or "Nothing that was looked for.",
        "\n## Steps\n",
        _table(
            ("step", "outcome", "s", "last line"), ((s["name"], s["outcome"], s["seconds"], _cell(s["last_line"])) for s in steps)
        ),
        "\n## Machine\n",
        _table(("what", "which"), machine.items()),
    ]
    return "\n".join(parts) + "\n"


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _faults(steps: Iterable[Mapping[str, Any]]) -> list[str]:
    bad = [step for step in steps if step["outcome"] not in ("passed", "skipped")]
    return [f"**{s['name']}** {s['outcome']}, see `logs/{s['name']}.txt`: {_cell(s['last_line']) or 'no output'}" for s in bad]


def _slower(bench: Any) -> list[str]:
    """Contenders that failed, and peers of the same precision that are faster than the network."""
    if not bench:
        return []
    rows = bench["sizes"][0]["rows"]
    found = [f"{row['name']}: {_cell(row['fault'])}" for row in rows if row.get("fault") and not row["peer"]]
    ours = {row["details"].get("precision"): row for row in rows if row["name"] in ("cl", "cl-half") and not row.get("fault")}
    for row in rows:
        same = ours.get({"float16": "half"}.get(row["details"].get("precision"), row["details"].get("precision")))
        if row["peer"] and same and not row.get("fault") and row["minimum_ms"] < same["minimum_ms"]:
            found.append(f"{row['name']} takes {row['minimum_ms']:.2f} ms, {same['name']} {same['minimum_ms']:.2f} ms")
    return found


def _table(titles: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    titles = list(titles)
    lines = [titles, ["---"] * len(titles), *([str(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(text: str) -> str:
    return text.replace("|", "/")[:200]
