import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("common", "actor", "learner", "curriculum", "deploy")
FORBIDDEN = {
    "common": {"actor", "learner", "curriculum", "deploy", "tests"},
    "actor": {"learner", "curriculum", "deploy", "tests"},
    "learner": {"actor", "curriculum", "deploy", "tests"},
    "curriculum": {"actor", "learner", "deploy", "tests"},
    "deploy": {"tests"},
}


def imported(source: str, package: str = "") -> set[str]:
    """Top-level packages that a module imports anywhere in its text; relative ones belong to `package`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(package if node.level else (node.module or "").split(".")[0])
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            found |= {
                arg.value.split(".")[0]
                for arg in node.args
                if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
            }
    return found


def test_the_reader_of_imports_sees_every_form():
    source = (
        "import a.b, c\nfrom d.e import f\nfrom . import g\n"
        "def h():\n    from i import j\n    import_module('k.l')\n    importlib.import_module('m')\n"
    )
    assert imported(source, "own") == {"a", "c", "d", "own", "i", "k", "m"}


def test_common_is_seen_to_import_itself_only():
    ours = {
        name
        for path in (ROOT / "common").rglob("*.py")
        for name in imported(path.read_text(), "common")
        if name in ROOMS
    }
    assert ours == {"common"}


def test_algorithms_of_the_curriculum_know_neither_files_nor_the_bus():
    files = sorted((ROOT / "curriculum" / "algorithms").glob("*.py"))
    assert len(files) > 5
    modules = {
        node.module
        for path in files
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
    }
    forbidden = {"curriculum.database", "curriculum.service", "curriculum.curriculum", "pathlib"}
    forbidden |= {f"common.{name}" for name in ("bus", "delivery", "files", "link")}
    assert "curriculum.success_network" in modules
    assert not modules & forbidden
    assert not {"os", "sqlite3", "zenoh"} & {name for path in files for name in imported(path.read_text())}


@pytest.mark.parametrize("room", ROOMS)
def test_dependencies_run_one_way(room):
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    wrong = {
        str(path.relative_to(ROOT)): sorted(bad)
        for path in files
        if (bad := imported(path.read_text(), room) & FORBIDDEN[room])
    }
    assert wrong == {}
