"""What holds for the whole package: every public signature is annotated."""

import ast

import pytest

from runs import ROOT

FILES = sorted([*(ROOT / "rgs_mi").rglob("*.py"), *(ROOT / "plugins").glob("*.py")])
SPECIAL = ("__init__", "__call__", "__getitem__")


def public_functions(node, prefix=""):
    """(name, function) of every public function and method below a module or class."""
    for child in node.body:
        public = not child.name.startswith("_") if isinstance(child, ast.ClassDef | ast.FunctionDef) else False
        if isinstance(child, ast.ClassDef) and public:
            yield from public_functions(child, f"{child.name}.")
        elif isinstance(child, ast.FunctionDef) and (public or child.name in SPECIAL):
            yield prefix + child.name, child


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_public_signatures_are_annotated(path):
    lacking = []
    for name, function in public_functions(ast.parse(path.read_text("utf-8"))):
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
        if bare or function.returns is None:
            lacking.append((name, *bare))
    assert lacking == []
