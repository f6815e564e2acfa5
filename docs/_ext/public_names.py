"""A Sphinx extension that fails where the built Python reference lacks a public name."""

from pathlib import Path

from sphinx.errors import SphinxError

import thermorender


def _check(app, exception):
    page = Path(app.outdir, "reference", "python.html")
    if exception or app.builder.name != "html":
        return
    html = page.read_text(encoding="utf-8")
    ids = {name: f"thermorender.{name}" for name in thermorender.__all__}
    # A module has its entry under its own name.
    ids["link"] = f"module-{thermorender.link.__name__}"
    missing = [name for name, place in ids.items() if f'id="{place}"' not in html]
    if missing:
        raise SphinxError(f"{page} lacks {', '.join(missing)}; give each a directive in docs/reference/python.md")


def setup(app):
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True}
