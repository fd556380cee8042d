"""The plugins' reference from the docstrings of their files, which have the format of Mitsuba's own plugins."""

import ast
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive

#: What docstrings abbreviate, |int| and the like, as Mitsuba's documentation does.
_TYPES = ("int", "bool", "float", "string", "transform", "tensor", "bsdf", "emitter", "texture")
_FLAGS = {
    "exposed": "exposed",
    "differentiable": "differentiable",
    "discontinuous": "discontinuous",
    "true": "``true``",
    "false": "``false``",
}
_HEADER = ("Parameter", "Type", "Description", "Flags")


class PluginParameters(Directive):
    """``.. pluginparameters::``: a list of lists (name, type, description, perhaps flags) as a table."""

    has_content = True

    def run(self):
        holder = nodes.container()
        self.state.nested_parse(self.content, self.content_offset, holder)
        rows = [
            [cell.children for cell in row.children[0].children]
            for item in holder.findall(nodes.bullet_list)
            if item.parent is holder or isinstance(item.parent, nodes.block_quote)
            for row in item.children
        ]
        return [table(_HEADER[: max(map(len, rows))], rows)]


def table(header, rows):
    """A docutils table of a ``header`` (strings) and ``rows`` of cells, each a list of nodes; short rows are filled."""
    group = nodes.tgroup(cols=len(header))
    group += [nodes.colspec(colwidth=1) for _ in header]
    group += nodes.thead("", _row([[nodes.paragraph(text=name)] for name in header]))
    group += nodes.tbody("", *(_row([*row, *[[]] * (len(header) - len(row))]) for row in rows))
    return nodes.table("", group, classes=["colwidths-auto"])


def _row(cells):
    return nodes.row("", *(nodes.entry("", *(node.deepcopy() for node in cell)) for cell in cells))


def monosp(name, rawtext, text, lineno, inliner, options=None, content=None):
    """The role ``:monosp:``: a name in fixed width."""
    return [nodes.literal(rawtext, text)], []


def write_page(app):
    """Write one page with the docstring of every plugin's file that registers something."""
    import rgs_mi.plugins

    parts = [f".. |{name}| replace:: *{name}*" for name in _TYPES]
    parts += [f".. |{name}| replace:: {text}" for name, text in _FLAGS.items()]
    parts += ["", "Mitsuba plugins", "===============", "", "They are known to Mitsuba once ``rgs_mi`` is imported.", ""]
    for path in sorted(Path(rgs_mi.plugins.__file__).parent.glob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "\nmi.register_" in text:
            parts += [ast.get_docstring(ast.parse(text)), ""]
    out = Path(app.srcdir) / "_generated"
    out.mkdir(exist_ok=True)
    (out / "plugins.rst").write_text("\n".join(parts), encoding="utf-8")


def setup(app):
    """Register with Sphinx."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_role("monosp", monosp)
    app.connect("builder-inited", write_page)
    return {"parallel_read_safe": True}
