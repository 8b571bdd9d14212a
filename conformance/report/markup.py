# SPDX-License-Identifier: MIT
"""Parts of the judge's pages: tables of tests, failures with their pictures."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path

from conformance.judging.findings import TestResult


def table_of(caption: str, words: Sequence[str], numbers: Sequence[str], rows: str, *, stack: bool = False) -> str:
    """Markup of a table that scrolls by itself where the page is narrower; ``stack``: its rows become paragraphs there."""
    head = "".join(
        [*(f'<th scope="col">{name}</th>' for name in words), *(f'<th scope="col" class="n">{name}</th>' for name in numbers)]
    )
    kind = ' class="stack"' if stack else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{caption}"><table{kind}><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def row_of(r: TestResult) -> str:
    """The row of a test: its id, property and outcome, its cases and the largest error / bound of each output."""
    worst = "<br>".join(f"{html.escape(name.split('.')[-1])} {number_of(ratio)}" for name, ratio in r.record.worst.items())
    cells = f'<td><code>{html.escape(r.id)}</code><td class="words">{html.escape(r.property)}<td class="{r.outcome}">{r.outcome}'
    numbers = {"cases": r.record.cases or "", "error / bound": worst}
    figures = "".join(f'<td class="n" data-label="{name}">{cell}</td>' for name, cell in numbers.items())
    return f"<tr>{cells}</td>{figures}</tr>"


def failure_of(r: TestResult, folder: Path | None) -> str:
    """A failure: the text and the picture of its folder, or its message alone."""
    picture = folder / "picture.png" if folder else None
    picture_html = ""
    if picture is not None and picture.exists():
        picture_html = (
            f'<p><img alt="port, expected, error" src="data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}">'
        )
    again = (
        f"<pre>{html.escape((folder / 'README.txt').read_text(encoding='utf-8'))}</pre>"
        if folder
        else f"<p>{html.escape(r.message)}"
    )
    return f'<h2 class="failed" id="{html.escape(r.id)}"><code>{html.escape(r.id)}</code></h2>{again}{picture_html}'


def number_of(ratio: float) -> str:
    """An error / bound in two digits."""
    return "wrong" if math.isinf(ratio) else f"{ratio:.2g}"
