# SPDX-License-Identifier: MIT
"""Tables of pages that a command writes."""

END = "<!-- end -->"


def write_between(page, command, table):
    """Put a table between ``<!-- written by COMMAND -->`` and the next ``<!-- end -->``; in an installed copy there is no page."""
    if page.exists():
        first = f"<!-- written by {command} -->"
        head, rest = page.read_text(encoding="utf-8").split(first)
        page.write_text(f"{head}{first}\n\n{table}\n\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")
