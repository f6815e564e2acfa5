"""HTML pages of results in one file: shared style, sortable tables, embedded pictures."""

import base64
import html
from collections.abc import Collection, Iterable
from pathlib import Path

_HERE = Path(__file__)


def document(title: str, parts: Iterable[str], style: str = "", script: str = "") -> str:
    """Return an HTML page of parts (HTML each); `style` and `script` are added to the shared ones."""
    common = {kind: _HERE.with_suffix(kind).read_text(encoding="utf-8") for kind in (".css", ".js")}
    return "\n".join([
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{text(title)}</title>",
        f"<meta name=viewport content='width=device-width'><style>{common['.css']}{style}</style>", *parts,
        f"<script>{common['.js']}{script}</script>",
    ])  # fmt: skip


def table(head: Iterable[object], rows: Iterable[tuple[Iterable[object], bool]], words: Collection[int] = ()) -> str:
    """Return a sortable table of rows (cells, marked in red); the columns numbered in `words` may break lines."""

    def line(tag: str, cells: Iterable[str]) -> str:
        return "".join(f"<{tag}{' class=words' if k in words else ''}>{cell}</{tag}>" for k, cell in enumerate(cells))

    body = [f"<tr{' class=grave' if marked else ''}>{line('td', map(text, cells))}</tr>" for cells, marked in rows]
    # A head such as paint_black may break after the underscore.
    titles = line("th", (text(name).replace("_", "_<wbr>") for name in head))
    return f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def figure(content: bytes, words: str) -> str:
    """Return a figure of the bytes of a PNG, JPEG or SVG with a caption."""
    kinds = ((b"\x89PNG", "png"), (b"<?xml", "svg+xml"))
    kind, data = (
        next((name for start, name in kinds if content.startswith(start)), "jpeg"),
        base64.b64encode(content).decode(),
    )
    return f"<figure><img src='data:image/{kind};base64,{data}' alt=''><figcaption>{text(words)}</figcaption></figure>"


def text(value: object) -> str:
    """Return a value as text with its markup escaped."""
    return html.escape(str(value))
