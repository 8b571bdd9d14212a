# SPDX-License-Identifier: MIT
"""Tables of pages that a command writes."""

END = "<!-- end -->"


def put_between(text, command, table):
    """A page's text with a table between ``<!-- written by COMMAND -->`` and the next ``<!-- end -->``."""
    first = f"<!-- written by {command} -->"
    head, rest = text.split(first)
    return f"{head}{first}\n\n{table}\n\n{END}{rest.split(END, 1)[1]}"


def write_between(page, command, table):
    """Put it into the page; in an installed copy there is none."""
    if page.exists():
        page.write_text(put_between(page.read_text(encoding="utf-8"), command, table), encoding="utf-8")
