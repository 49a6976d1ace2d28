"""Rooms import only from rooms above them."""

import ast
from pathlib import Path

VISION = Path(__file__).parents[1] / "vision"
# rooms in order; a room may use itself and those before it
ROOMS = [
    "errors",
    "numeric",
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
]
SHOWING = {"run", "report", "review"}


def room_of(parts):
    return parts[1].removesuffix(".py") if len(parts) > 1 else ""


def imports_of(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def allowed(room, other):
    if room == other or other in {"", "errors", "numeric", "data", "sample"}:
        return True
    if room == "command":
        return True
    if room in SHOWING:
        return other != "command"
    return other in ROOMS and room in ROOMS and ROOMS.index(other) < ROOMS.index(room)


def test_rooms_import_only_from_rooms_above_them():
    """A failure means that a lower layer has come to depend on a higher one."""
    wrong = [
        f"{path.relative_to(VISION.parent)} imports {module}"
        for path in sorted(VISION.rglob("*.py"))
        for module in imports_of(path)
        if module.split(".")[0] == "vision"
        and path != VISION / "__init__.py"
        and not allowed(room_of(path.relative_to(VISION.parent).parts), room_of((*module.split("."), "")[:2]))
    ]
    assert wrong == []


def test_the_rule_itself_can_fail():
    """The check must notice a forbidden import, or it proves nothing."""
    assert not allowed("video", "sheets")
    assert not allowed("run", "command")
    assert not allowed("sheets", "run")
    assert allowed("sheets", "video")
