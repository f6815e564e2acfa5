"""Pages of results that stand alone: one style, tables sorted by a click, pictures inside."""

import base64
import html
from pathlib import Path

_HERE = Path(__file__)


def document(title, parts, style="", script=""):
    """Return an HTML page (a str) of parts, HTML each, with more style and script where given."""
    common = {kind: _HERE.with_suffix(kind).read_text(encoding="utf-8") for kind in (".css", ".js")}
    return "\n".join([
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{text(title)}</title>",
        f"<meta name=viewport content='width=device-width'><style>{common['.css']}{style}</style>", *parts,
        f"<script>{common['.js']}{script}</script>",
    ])  # fmt: skip


def table(head, rows, words=()):
    """Return a sortable table of rows, (cells, whether it is marked); columns numbered in `words` may break lines."""
    body = []
    for cells, marked in rows:
        inner = "".join(f"<td{' class=words' if k in words else ''}>{text(cell)}</td>" for k, cell in enumerate(cells))
        body.append(f"<tr{' class=grave' if marked else ''}>{inner}</tr>")
    titles = "".join(f"<th>{text(name)}</th>" for name in head)
    return f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def figure(content, words):
    """Return a figure of a PNG's bytes with words below it."""
    data = base64.b64encode(content).decode()
    return f"<figure><img src='data:image/png;base64,{data}' alt=''><figcaption>{text(words)}</figcaption></figure>"


def text(value):
    """Return a value as text that no markup can hide in."""
    return html.escape(str(value))
