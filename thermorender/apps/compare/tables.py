"""Tables of text: one for the terminal, a page and Markdown, and how numbers read in them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from thermorender.output.flight_pages import html


@dataclass(frozen=True)
class Table:
    """A table of text."""

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    marked: Collection[int] = ()  # Numbers of the rows in red
    words: Collection[int] = ()  # Numbers of the columns that may break lines

    def html(self) -> str:
        """Return a sortable table of a page."""
        return html.table(self.head, [(row, k in self.marked) for k, row in enumerate(self.rows)], self.words)

    def markdown(self, left: int = 1) -> str:
        """Return the table in Markdown, with the first `left` columns aligned left."""
        rule = "|---" * left + "|--:" * (len(self.head) - left) + "|"
        return "\n".join([_line(self.head), rule, *map(_line, self.rows)])


def number(value: float | None, form: str = ".3f", none: str = "") -> str:
    """Return a number in a format, or `none`."""
    return none if value is None else format(int(value) if form == "d" else value, form)


def interval(ends: Sequence[float] | None, form: str = ".2f") -> str:
    """Return an interval as low…high, or nothing."""
    return "" if ends is None else "…".join(format(end, form) for end in ends)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
