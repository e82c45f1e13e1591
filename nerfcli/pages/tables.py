"""Tables of a page."""

from collections.abc import Collection, Sequence
from html import escape


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Collection[int] = ()) -> str:
    """Return a table that scrolls sideways where the window is too narrow; all cells are plain text.

    Args:
        rows: each with as many cells.
        numbers: indices of the columns that are aligned to the right.
    """

    def line(tag: str, cells: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=number' if index in numbers else ''}>{escape(cell)}</{tag}>"
            for index, cell in enumerate(cells)
        )

    head = f"<thead><tr>{line('th', columns)}</tr></thead>"
    body = "\n".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table>{head}<tbody>{body}</tbody></table></div>'
