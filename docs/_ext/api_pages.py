"""The programming interface from docstrings: one page a folder of the package, written anew at each build."""

import pkgutil
import re
from importlib import import_module
from pathlib import Path

PACKAGE = "rgs_mi"
ELSEWHERE = ("rgs_mi.plugins",)  # has a reference of its own
_HEADER = re.compile(r"(Args|Arguments|Returns|Raises|Attributes|Yields|Note):?$")
_TABLE = re.compile(r"[\w, ]*\w:? {2,}\S")  # a name, and what is aligned behind it


def folders() -> dict[str, list[str]]:
    """name of each package -> names of its modules, itself first where it says anything."""
    found = {PACKAGE: [PACKAGE]}
    for module in pkgutil.walk_packages(import_module(PACKAGE).__path__, f"{PACKAGE}."):
        if module.name.startswith(ELSEWHERE) or module.name.endswith("__main__"):
            continue
        parent = module.name if module.ispkg else module.name.rpartition(".")[0]
        found.setdefault(parent, []).append(module.name)
    return found


def write_pages(app):
    """Write a page of `automodule` directives for each folder, and an index of them."""
    out = Path(app.srcdir) / "_generated" / "api"
    out.mkdir(parents=True, exist_ok=True)
    for stale in out.glob("*.rst"):
        stale.unlink()
    for package, modules in folders().items():
        parts = [_title(package, "=")]
        for name in modules:
            parts += [] if name == package else [_title(name.removeprefix(f"{package}."), "-")]
            parts.append(f".. automodule:: {name}\n   :members:\n   :undoc-members:\n   :ignore-module-all:\n")
        (out / f"{package}.rst").write_text("\n".join(parts))
    entries = "".join(f"   {package}\n" for package in folders())
    (out / "index.rst").write_text(
        f"{_title('Programming interface', '=')}\n"
        f"One page a folder of ``{PACKAGE}``, from its docstrings.\n\n"
        f".. toctree::\n   :maxdepth: 1\n\n{entries}"
    )


def _title(text, line):
    return f"{text}\n{line * len(text)}\n"


def tidy(app, what, name, obj, options, lines):
    """Make reStructuredText of a docstring: equations and tables become literal blocks, and bars stay bars."""
    out, literal = [], False
    for line in lines:
        text = line.strip()
        if literal and text and line[:1] != " " and not out[-1].strip():
            literal = False
        if text and not literal and _opens(out, line):
            out += ["::", ""]
            literal = True
        if text == "Attributes":
            line += ":"
        out.append(f" {line}" if literal else _escaped(line))
    lines[:] = out


def _opens(out, line):
    """Whether ``line`` begins a block that stands apart after ``out``: the first row of a table, or indented text that is not
    below a section's header."""
    if out and out[-1].strip():
        return False
    if _TABLE.match(line):
        return True
    before = next((line for line in reversed(out) if line.strip()), " ")
    return line[:1] == " " and before[:1] != " " and not before.startswith(("- ", "* ", "..")) and not _HEADER.match(before)


def _escaped(line):
    """``line`` with ``|`` and ``*`` escaped outside of backticks, and literals ended before a plural's s."""
    parts = re.split(r"(``[^`]*``|`[^`]*`)", line)
    text = "".join(part if i % 2 else re.sub(r"([|]|[*](?=\S))", r"\\\1", part) for i, part in enumerate(parts))
    return re.sub(r"(``[^`]+``)(?=\w)", r"\1\\ ", text)


def setup(app):
    """Register with Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", tidy, priority=400)  # before napoleon
    return {"parallel_read_safe": True}
