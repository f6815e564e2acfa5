"""A Sphinx directive that writes the command-line reference from the parser of `thermorender` itself."""

import re

from docutils import nodes
from docutils.parsers.rst import Directive


def _literal(text):
    return nodes.literal(text=text)


def _default(parameter):
    """The default of an option as text, or None where there is none to show."""
    value = parameter.default
    if callable(value) or value in (None, False, True, (), [], ""):
        return None
    return str(value)


def _prose(text):
    """Help text as one line."""
    return re.sub(r"\s+", " ", text or "").strip()


def _row(parameter):
    """(names as a paragraph, description as a paragraph) of one argument or option."""
    is_option = parameter.param_type_name == "option"
    names = nodes.paragraph()
    for number, name in enumerate(parameter.opts if is_option else [parameter.name.upper()]):
        if number:
            names += nodes.Text(", ")
        names += _literal(name)
    text = nodes.paragraph("", _prose(getattr(parameter, "help", "")))
    if parameter.required:
        text += nodes.Text(" Required.")
    if default := _default(parameter):
        text += nodes.Text(" Default: ")
        text += _literal(default)
        text += nodes.Text(".")
    return names, text


def _table(rows):
    table = nodes.table(classes=["options"])
    group = nodes.tgroup(cols=2)
    table += group
    group += nodes.colspec(colwidth=28)
    group += nodes.colspec(colwidth=72)
    body = nodes.tbody()
    group += body
    for cells in rows:
        row = nodes.row()
        for cell in cells:
            row += nodes.entry("", cell)
        body += row
    return table


def _section(name, command):
    """A section with the help of one verb, and sections of the verbs below it."""
    section = nodes.section(ids=[nodes.make_id(name)])
    section += nodes.title(text=name)
    section += nodes.paragraph("", _prose(command.help))
    rows = [_row(parameter) for parameter in command.params if "--help" not in parameter.opts]
    if rows:
        section += _table(rows)
    for below, child in sorted(getattr(command, "commands", {}).items()):
        section += _section(f"{name} {below}", child)
    return section


class CommandLine(Directive):
    """`.. command-line::` writes one section for each verb, in alphabetical order."""

    def run(self):
        """Return the sections."""
        from thermorender.cli.registry import command, verbs

        return [_section(f"thermorender {name}", command(name)) for name in verbs()]


def setup(app):
    """Register the directive."""
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True}
