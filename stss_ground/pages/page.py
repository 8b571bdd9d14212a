# SPDX-License-Identifier: MIT
"""A page as one file: style and scripts inside, and nothing that leads outside.

Text that is passed in comes from files of unknown origin: `table` and `page` escape it. Only a parameter called ``html`` is markup
already.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from stss_ground.terminal import printable

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data: file:; style-src 'unsafe-inline'; $scripts">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>$title</title>
<style>
$style</style>
</head>
<body>
$body
</body>
</html>
""")


def asset(package: str, name: str) -> str:
    """A file that lies in a package, as text."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def page(title: str, html: str, *, styles: Sequence[str] = (), scripts: Sequence[str] = (), data: Any = None) -> str:
    """Make a whole page that loads nothing: its policy forbids every request except for pictures beside it.

    Args:
        title: text.
        html: the body, markup.
        styles: further style sheets, after ``style.css``.
        scripts: their text; they run at the end of the body, in this order.
        data: JSON for scripts in the element ``data``; None: no such element.
    """
    hashes = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in scripts)
    body = [html]
    if data is not None:
        # "</script>" within a text would end the element.
        text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
        body.append(f'<script type="application/json" id="data">{text}</script>')
    body += [f"<script>{text}</script>" for text in scripts]
    return _PAGE.substitute(
        title=escape(printable(title)),
        style="".join((asset("stss_ground.pages", "style.css"), *styles)),
        body="\n".join(body),
        scripts="script-src " + (hashes or "'none'"),
    )


def table(caption: str, headings: Sequence[str], rows: Sequence[Sequence[str]], *, means: int = 0, words: int = 1) -> str:
    """Make a table that scrolls separately if the page is narrower.

    Args:
        caption: text above the table.
        headings: the columns' headings; a line break stays one.
        rows: cells as text; the first cell of each heads its row.
        means: number of last rows that are means.
        words: number of first columns that hold words; the others hold numbers.
    """
    kind = [' class="n"' if i >= words else "" for i in range(len(headings))]
    head = "".join(
        f'<th scope="col"{c}>{escape(name).strip().replace(chr(10), "<br>")}</th>' for c, name in zip(kind, headings, strict=True)
    )
    body: list[str] = []
    for i, row in enumerate(rows):
        first, *others = (escape(printable(cell)) for cell in row)
        cells = "".join(f"<td{c}>{cell}</td>" for c, cell in zip(kind[1:], others, strict=True))
        mean = ' class="mean"' if i >= len(rows) - means else ""
        body.append(f'<tr{mean}><th scope="row"{kind[0]}>{first}</th>{cells}</tr>')
    label = escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{label}"><table><caption>{label}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def fold(summary: str, html: str) -> str:
    """Markup that opens at a click on ``summary``, text."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"


def definitions(summary: str, terms: Sequence[tuple[str, str]]) -> str:
    """Make a list of terms and their meanings, which opens at a click."""
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(meaning)}</dd>" for term, meaning in terms)
    return fold(summary, f"<dl>{items}</dl>")
