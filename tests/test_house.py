"""The structure of the package: which folder may import from which, and what stands at the top."""

import ast
import itertools
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import forgetmimic_jax

PACKAGE = Path(forgetmimic_jax.__file__).parent
# From the bottom to the top; a folder imports from itself and from the folders before it.
FOLDERS = [
    *("basics", "settings", "robot", "motion", "physics", "policy", "tracking", "ppo", "unlearning"),
    *("evaluation", "training", "attacks", "exchange", "viewing", "reporting", "retarget", "studies"),
]
MODULES = sorted(PACKAGE.rglob("*.py"))


def folder(path: Path) -> str:
    """The folder of a module, `commands` at the top of the package."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else "commands"


def imported(path: Path) -> set[str]:
    """The package's modules that a module imports, at its top or inside its functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "forgetmimic_jax":
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith("forgetmimic_jax.")}
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_folder_imports_from_the_folders_below_it(path):
    here = folder(path)
    if here == "commands":
        return
    below = FOLDERS[: FOLDERS.index(here) + 1]
    for name in imported(path):
        parts = name.split(".")
        there = parts[1] if (PACKAGE / parts[1]).is_dir() else "commands"
        assert there in below, f"{here} imports {name}"


def test_modules_import_each_other_in_no_circle():
    graph = {}
    for path in MODULES:
        name = ".".join(("forgetmimic_jax", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")
        graph[name] = {found for found in imported(path)} | {found.rpartition(".")[0] for found in imported(path)}
    graph = {name: sorted(found & graph.keys() - {name}) for name, found in graph.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, f"a circle: {' → '.join((*trail, name))}"
        if name not in done:
            for other in graph[name]:
                visit(other, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_the_top_of_the_package_is_the_list_of_commands():
    for path in PACKAGE.glob("*.py"):
        assert path.name == "__init__.py" or "__main__" in path.read_text(), f"{path.name} is no command"


def test_every_folder_says_what_is_in_it_and_what_is_not():
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert folders == set(FOLDERS)
    for name in folders:
        text = ast.get_docstring(ast.parse((PACKAGE / name / "__init__.py").read_text())) or ""
        assert text.count(".") >= 2, f"{name}/__init__.py: two sentences, what is there and what is not"


def test_every_package_that_is_imported_is_a_dependency():
    """An environment that has more than the dependencies would hide one that is missing."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    extras = itertools.chain(*(project["optional-dependencies"][name] for name in ("cluster", "warp")))
    declared = {re.split(r"[^\w.-]", name)[0].lower().replace("_", "-") for name in (*project["dependencies"], *extras)}
    declared.add("warp-lang")  # of mujoco-mjx[warp]
    homes = packages_distributions()
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            for top in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {PACKAGE.name}:
                packages = {home.lower().replace("_", "-") for home in homes.get(top, [top])}
                assert packages & declared, f"{path}: {top} is in none of the dependencies"
