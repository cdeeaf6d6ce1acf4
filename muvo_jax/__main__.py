"""python -m muvo_jax: lists the commands."""

from __future__ import annotations

import ast
import difflib
import pathlib
import signal
import sys

COMMANDS = ("train", "evaluate", "dream", "plan_drive", "doctor", "voxelize", "pack", "record_carla", "export_muvo",
            "convert", "export", "interop.export_torch", "interop.parity")


def describe(command: str) -> tuple[str, str]:
    """How a command is called and what it does, from the first line of its module; nothing is imported."""
    path = pathlib.Path(__file__).parent.joinpath(*command.split("."))
    path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    call, _, purpose = docstring.splitlines()[0].partition(": ")
    return call, purpose


def main() -> int:
    """Returns 0 where nothing was asked for, else 2: commands are modules, not arguments."""
    asked = [argument for argument in sys.argv[1:] if argument not in ("-h", "--help")]
    if asked:
        near = difflib.get_close_matches(asked[0], COMMANDS, n=1)
        hint = f"did you mean python -m muvo_jax.{near[0]}?" if near else "python -m muvo_jax lists the commands."
        print(f"error: python -m muvo_jax takes no argument, got {asked[0]}; {hint}", file=sys.stderr)
        return 2
    described = [describe(command) for command in COMMANDS]
    width = max(len(call) for call, _ in described)
    print("MUVO, a multimodal generative world model for driving. Commands (each explains itself with --help):\n")
    for call, purpose in described:
        print(f"  {call:{width}}  {purpose}")
    return 0


if __name__ == "__main__":
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # no traceback from python -m muvo_jax | head -1
    sys.exit(main())
