"""Pages of which a part is written by a command: what stands between two marks."""

from __future__ import annotations


def renewed(page: str, content: str, marks: tuple[str, str]) -> str:
    """The page with ``content`` between its marks, or after its end where it has none.

    >>> renewed("a\\n<!-- x -->\\nold\\n<!-- y -->\\nb", "new", ("<!-- x -->", "<!-- y -->"))
    'a\\n<!-- x -->\\n\\nnew\\n\\n<!-- y -->\\nb'
    """
    before, begin, rest = page.partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not begin or not end:
        before, after = page.rstrip() + "\n\n" * bool(page.strip()), "\n"
    return f"{before}{marks[0]}\n\n{content}\n\n{marks[1]}{after}"
