"""Help of a verb that fits a screen: rare options only by name, under their panel, and in full with --help-all."""

from textwrap import wrap
from typing import Any

from typer.core import TyperCommand

FULL = "--help-all"


class Command(TyperCommand):
    """A verb whose options with a `rich_help_panel` are rare."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take --help-all for --help, with the rare options described."""
        ctx.meta[FULL] = FULL in args
        return super().parse_args(ctx, ["--help"] if FULL in args else args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, and a line of names for each panel of rare options."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        panels: dict[str, list[str]] = {}
        for each in self.get_params(ctx):
            record = each.get_help_record(ctx)
            panel = getattr(each, "rich_help_panel", None)
            if record and panel and each.param_type_name == "option" and not ctx.meta[FULL]:
                panels.setdefault(panel, []).append(each.opts[0])
            elif record:
                sections["Arguments" if each.param_type_name == "argument" else "Options"].append(record)
        more = sections[f"More options, which {FULL} describes"] = []
        for name, options in panels.items():
            lines = wrap(", ".join(options), 76, break_on_hyphens=False)
            more += zip((name, *[""] * len(lines)), lines, strict=False)
        for title, rows in sections.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
