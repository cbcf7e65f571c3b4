"""The program `forgetmimic COMMAND`, also `python -m forgetmimic_jax COMMAND`: the modules beside this one.

The first line of a command's docstring is its line in the list.
"""

from __future__ import annotations

import ast
import pkgutil
import runpy
import sys
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError, nearest, run_command

PACKAGE = Path(__file__).parent
SINGULAR = {"robots": "robot"}  # `robot` is a folder of the package, so its command's module has another name


def commands() -> dict[str, str]:
    """What every command does, by its name; nothing is imported, so the list appears at once."""
    names = [module.name for module in pkgutil.iter_modules([str(PACKAGE)]) if not module.ispkg]
    return {_command(name): _summary(name) for name in names if name != "__main__"}


def main() -> None:
    """Run the command that the first argument names; without one, list the commands."""
    run_command(lambda: _run(sys.argv[1:]))


def _run(arguments: list[str]) -> None:
    known = commands()
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(map(len, known))
        print("usage: forgetmimic COMMAND [flags]\n")
        print("\n".join(f"  {name:<{width}}  {summary}" for name, summary in known.items()))
        print("\nforgetmimic COMMAND --help lists the flags of a command.")
        return
    name, *rest = arguments
    if name not in known:
        raise InputError(f"no command '{name}'; {nearest(name, known)}")
    sys.argv = [f"forgetmimic {name}", *rest]
    runpy.run_module(f"forgetmimic_jax.{module_of(name)}", run_name="__main__", alter_sys=True)


def module_of(command: str) -> str:
    """The module of a command."""
    return next((module for module, name in SINGULAR.items() if name == command), command.replace("-", "_"))


def _command(module: str) -> str:
    return SINGULAR.get(module, module.replace("_", "-"))


def _summary(module: str) -> str:
    docstring = ast.get_docstring(ast.parse((PACKAGE / f"{module}.py").read_text())) or ""
    return docstring.partition("\n")[0].partition(": `")[0].removesuffix(".")


if __name__ == "__main__":
    main()
