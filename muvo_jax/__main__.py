"""python -m muvo_jax, or muvo: lists the commands; muvo COMMAND calls one."""

from __future__ import annotations

import ast
import difflib
import importlib
import pathlib
import sys

from muvo_jax import command_line

COMMANDS = ("train", "estimate", "evaluate", "dream", "train_agent", "drive", "doctor", "voxelize", "pack",
            "record_carla", "export_muvo", "convert", "export", "interop.export_torch", "interop.parity")


def describe(command: str) -> tuple[str, str]:
    """How a command is called and what it does, from the first line of its module; nothing is imported."""
    path = pathlib.Path(__file__).parent.joinpath(*command.split("."))
    path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    call, _, purpose = docstring.splitlines()[0].partition(": ")
    return call, purpose


def main() -> int:
    """Calls the command that the first argument names (train, record_carla or record-carla), or lists them all.

    Returns:
      The exit code, 2 where there is no such command.
    """
    if sys.argv[1:] and sys.argv[1] not in ("-h", "--help"):
        return _call(sys.argv[1], sys.argv[2:])
    described = [describe(command) for command in COMMANDS]
    width = max(len(call) for call, _ in described)
    with command_line.reader_may_leave():
        print("MUVO, a multimodal generative world model for driving. Commands (each explains itself with --help; muvo "
              "train is\nshort for python -m muvo_jax.train):\n")
        for call, purpose in described:
            print(f"  {call:{width}}  {purpose}")
    return 0


def _call(asked: str, arguments: list[str]) -> int:
    by_name = {command.rpartition(".")[2]: command for command in COMMANDS}
    name = asked.replace("-", "_").removeprefix("interop.")
    if name not in by_name:
        near = difflib.get_close_matches(name, by_name, n=1)
        hint = f"did you mean python -m muvo_jax.{by_name[near[0]]}?" if near else f"known are {', '.join(by_name)}."
        print(f"error: there is no command {asked}; {hint} (muvo --help)", file=sys.stderr)
        return 2
    module = f"muvo_jax.{by_name[name]}"
    if name == "parity":  # a package
        module += ".__main__"
    if pathlib.Path(sys.argv[0]).stem == "muvo":
        sys.argv[0] = f"muvo {name}"  # for the help
    sys.argv[1:] = arguments
    return importlib.import_module(module).main()


if __name__ == "__main__":
    sys.exit(main())
