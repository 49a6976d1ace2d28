"""Packages import only from those above them, at the top of the module."""

import ast
from pathlib import Path

VISION = Path(__file__).parents[1] / "vision"
# In order: each may import itself and those before it. docs/architecture.md shows the same list.
LAYERS = (
    "errors",
    "files",
    "memory",
    "numeric",
    "words",
    "signals",
    "locks",
    "folder",
    "data",
    "sample",
    "video",
    "sheets",
    "spacetime",
    "force",
    "clock",
    "deformation",
    "models",
    "shells",
    "experiment",
    "figures",
    "systematics",
    "checks",
    "summary",
    "pipeline",
    "report",
    "run",
    "comparison",
    "certify",
    "review",
    "campaign",
    "command",
)
# Commands import the module that does their work when they are called, so that `track --help` answers at
# once and Ctrl-C meanwhile ends it in one line, and the review serves its page before it has imported what
# reads the run.
DEFERRED = ("vision/command/main.py", "vision/command/__init__.py")
# matplotlib is imported by a module of the first alone, and only once something is drawn; FFmpeg by the
# second, and only for films that it decodes.
DEFERRED_MODULES = ("vision.figures", "vision.video.encoded")


def layer_of(module):
    return module.split(".")[1] if "." in module else ""


def imports_of(tree):
    """(module, whether at the top) of each import of this package."""
    top = {id(node) for node in tree.body}
    for node in tree.body:
        if isinstance(node, ast.If):  # TYPE_CHECKING
            top |= {id(inner) for inner in node.body}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, id(node) in top
        elif isinstance(node, ast.Import):
            yield from ((name.name, id(node) in top) for name in node.names)


def allowed(layer, other):
    if not other:
        return True
    return other in LAYERS and layer in LAYERS and LAYERS.index(other) <= LAYERS.index(layer)


def each_import():
    for path in sorted(VISION.rglob("*.py")):
        if path == VISION / "__init__.py":
            continue
        layer = path.relative_to(VISION).parts[0].removesuffix(".py")
        for module, at_top in imports_of(ast.parse(path.read_text(encoding="utf-8"))):
            if module.split(".")[0] == "vision":
                yield path.relative_to(VISION.parent), layer, module, at_top


def test_packages_import_only_from_those_above_them():
    """A failure means that a lower layer has come to depend on a higher one."""
    wrong = [
        f"{path} imports {module}"
        for path, layer, module, _ in each_import()
        if not allowed(layer, layer_of(module))
    ]
    assert wrong == []


def test_imports_stand_at_the_top_of_the_module():
    """A failure means that a dependency is hidden inside a function."""
    hidden = [
        f"{path} imports {module} inside a function"
        for path, _, module, at_top in each_import()
        if not at_top and path.as_posix() not in DEFERRED and module not in DEFERRED_MODULES
    ]
    assert hidden == []


def test_the_rule_itself_can_fail():
    """The check must notice a forbidden import, or it proves nothing."""
    assert not allowed("video", "sheets")
    assert not allowed("run", "command")
    assert not allowed("sheets", "run")
    assert allowed("sheets", "video")
    tree = ast.parse("import vision.a\ndef f():\n    import vision.b")
    assert list(imports_of(tree)) == [("vision.a", True), ("vision.b", False)]
