"""A Sphinx directive that documents the public names of a module, so that the reference follows the code."""

import inspect

from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

import thermorender


def _lines(module, name):
    """reStructuredText that documents one public name."""
    value = getattr(module, name)
    if inspect.isclass(value):
        members = [] if issubclass(value, BaseException) else ["   :members:"]
        return [f".. autoclass:: {module.__name__}.{name}", *members, ""]
    return [f".. autofunction:: {module.__name__}.{name}", ""]


class PublicApi(Directive):
    """`.. public-api::` documents names of `thermorender`, in the order of its lines."""

    has_content = True

    def run(self):
        """Return the nodes of the documented names."""
        lines = [line for name in " ".join(self.content).split() for line in _lines(thermorender, name)]
        return self.state_machine and self._parsed(lines)

    def _parsed(self, lines):
        from docutils import nodes

        node = nodes.Element()
        node.document = self.state.document
        self.state.nested_parse(StringList(lines, source="thermorender.__all__"), self.content_offset, node)
        return node.children


def setup(app):
    """Register the directive."""
    app.add_directive("public-api", PublicApi)
    return {"parallel_read_safe": True}
