"""Retargeting is used by `motions retarget` and by nothing else."""

import ast
from pathlib import Path

import forgetmimic_jax

PACKAGE = Path(forgetmimic_jax.__file__).parent


def imports(file: Path) -> set[tuple[str, bool]]:
    """Modules that a file imports, and whether at its top."""
    tree, found = ast.parse(file.read_text()), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {(f"{node.module}.{name.name}", node in tree.body) for name in node.names}
        elif isinstance(node, ast.Import):
            found |= {(name.name, node in tree.body) for name in node.names}
    return found


def test_only_the_command_imports_it_and_only_when_it_runs():
    users = {
        (file.relative_to(PACKAGE).as_posix(), at_top)
        for file in PACKAGE.rglob("*.py")
        if file.parent.name != "retarget"
        for module, at_top in imports(file)
        if module.startswith("forgetmimic_jax.retarget")
    }
    assert users == {("motions.py", False)}


def test_mink_is_needed_for_it_alone():
    users = {file.parent.name for file in PACKAGE.rglob("*.py") if ("mink", True) in imports(file)}
    assert users == {"retarget"}
