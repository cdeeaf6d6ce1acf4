"""What the commands share: flags first, one clear line for an expected error, the compilation cache, opening the data.

A command imports what its work needs inside `late.imports()`, so that --help and a wrong flag answer at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import inspect
import json
import math
import os
import pathlib
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

from muvo_jax import cache, late

with late.imports():
    from muvo_jax import recordings
    from muvo_jax.training import checkpoint, host, screen

if TYPE_CHECKING:
    from muvo_jax import config as config_lib
    from muvo_jax import run as run_lib
    from muvo_jax.data import schema

TRACEBACK_VARIABLE = "MUVO_JAX_TRACEBACK"
# DataError, CheckpointError, WorkerError and NonFiniteLossError are these.
EXPECTED_ERRORS = (ValueError, OSError, ArithmeticError, MemoryError)
_Options = TypeVar("_Options")
_Result = TypeVar("_Result")


def shown(metavar: str, default: str = "preset's"):
    """How the help shows an option whose default is None: what to write, and what happens when it is left out."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def run(options_type: type[_Options], work: Callable[[_Options, screen.Screen], _Result], *, program: str,
        examples: str = "", arguments: Sequence[str] | None = None, status: Callable[[_Result], int] = lambda _: 0,
        failed: int = 1, trains: bool = False) -> int:
    """Parses the command line and does the work.

    Args:
      options_type: a dataclass; its docstring is the description.
      work: gets the options and a screen.
      program: as in python -m muvo_jax.PROGRAM.
      examples: command lines for the help.
      arguments: instead of those of the process.
      status: the exit code of what the work returns.
      failed: the exit code of an error that was explained.
      trains: whether the process should be one that trains fast (host.restart_with_huge_pages).

    Returns:
      The exit code: `status`, or `failed`, or 130 where interrupted. A wrong command line raises SystemExit(2).
    """
    given = sys.argv[1:] if arguments is None else arguments
    check_options(options_type, program, given)
    given = gathered(options_type, given)
    paragraphs = [inspect.getdoc(options_type) or "", "Examples:", *examples.strip().splitlines()]
    description = "\n\n".join(paragraphs)  # the help joins lines, but not paragraphs
    called = sys.argv[0] if sys.argv[0].startswith("muvo ") else f"python -m muvo_jax.{program}"
    with reader_may_leave():
        options = at_home(tyro.cli(options_type, prog=called, args=given, description=description))
    check_numbers(options)
    if trains and arguments is None:
        host.restart_with_huge_pages()
    prepare_compiler()
    late.load()
    show = screen.Screen()
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: show.warn(str(message))  # type: ignore[assignment]
        try:
            return status(work(options, show))
        except (*EXPECTED_ERRORS, RuntimeError) as error:  # JAX's of memory are RuntimeErrors
            said = explained(error)
            if said is None:
                raise
            show.stop()
            if os.environ.get(TRACEBACK_VARIABLE):
                traceback.print_exc()
            print(f"error: {said}", file=sys.stderr)
            if not os.environ.get(TRACEBACK_VARIABLE):
                print(f"({type(error).__name__}; {TRACEBACK_VARIABLE}=1 shows where)", file=sys.stderr)
            return failed
        except KeyboardInterrupt:
            show.stop()
            print("interrupted.", file=sys.stderr)
            return 130


def explained(error: Exception) -> str | None:
    """What is said of an expected error, of JAX's those of memory that ran out; None for one that is a defect."""
    if isinstance(error, EXPECTED_ERRORS):
        return str(error)
    if "RESOURCE_EXHAUSTED" not in str(error):
        return None
    reason = next(line for line in str(error).splitlines() if "RESOURCE_EXHAUSTED" in line)
    return (f"the device's memory ran out ({reason[:200]}): take a smaller --batch, and for training --set "
            f"train.remat=frames; python -m muvo_jax.estimate with the same flags says what a training needs, and with "
            f"--memory-gib=N what fits.")


@contextlib.contextmanager
def reader_may_leave() -> Iterator[None]:
    """Ends with exit code 0 where the reader of what is printed here has seen enough, as in --help | head.

    Only for what does nothing but print: work goes on without its reader (screen.Screen).
    """
    try:
        try:
            yield
        finally:
            print(end="", flush=True)  # else a reader that has left is found at the interpreter's end
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # takes what is still buffered
        raise SystemExit(0) from None


def check_options(options_type: type, program: str, arguments: Sequence[str]) -> None:
    """Ends with exit code 2 at an option that does not exist, naming its neighbours."""
    fields = dataclasses.fields(options_type)
    known = ["--help", *(f"--{field.name.replace('_', '-')}" for field in fields),
             *(f"--no-{field.name.replace('_', '-')}" for field in fields if field.default is True)]
    for argument in arguments:
        option_name = argument.partition("=")[0].replace("_", "-")
        if not option_name.startswith("--") or option_name in known:
            continue
        near = difflib.get_close_matches(option_name, known, n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "the options are " + " ".join(known)
        print(f"error: unknown option {option_name}; {hint} (python -m muvo_jax.{program} --help)", file=sys.stderr)
        raise SystemExit(2)


def gathered(options_type: type, arguments: Sequence[str]) -> list[str]:
    """The arguments with options that take many values once each: --set A=1 --set B=2 means both, and the parser would
    take the last one alone."""
    many = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(options_type)
            if isinstance(field.default, tuple)}
    named = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    rest: list[str] = []
    values: dict[str, list[str]] = {name: [] for name in many if named.count(name) > 1}
    into = rest
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if argument.startswith("--"):
            into = values.get(name, rest)
        if into is rest or not argument.startswith("--"):
            into.append(argument)
        elif equals:
            into.append(value)
    return rest + [word for name, words in values.items() for word in (name, *words)]


def at_home(options: _Options) -> _Options:
    """The options with their paths' ~ expanded, which a shell leaves alone in --out=~/runs."""
    paths = {field.name: pathlib.Path(os.path.expanduser(value)) for field in dataclasses.fields(options)  # type: ignore
             if isinstance(value := getattr(options, field.name), pathlib.Path)}
    return dataclasses.replace(options, **paths)  # type: ignore[type-var]


def check_numbers(options: Any) -> None:
    """Ends with exit code 2 at a number that no option takes: a negative or endless one, or no worker at all."""
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        least = int(field.name == "workers")
        if isinstance(value, int | float) and not least <= value < math.inf:
            print(f"error: --{field.name.replace('_', '-')} is {value}; expected {least} or more, and finite",
                  file=sys.stderr)
            raise SystemExit(2)


def prepare_compiler() -> None:
    """Keeps compiled programs in the user's cache folder (or JAX_COMPILATION_CACHE_DIR) and chooses emitters.

    For a JAX that is yet to be imported: it reads the variables once.
    """
    host.use_plain_emitters()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        with contextlib.suppress(OSError):  # nowhere to keep them: they are compiled each time
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache.folder() / "jax")


def process_start_s() -> float:
    """When this process began, on the clock of time.perf_counter (where the system does not say: now)."""
    try:
        ticks = int(pathlib.Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, AttributeError):
        age_s = 0.0
    return time.perf_counter() - age_s


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """{"model.fusion.dropout": 0.0} from ["model.fusion.dropout=0.0"]; a value that is not JSON is text.

    Raises:
      ValueError: where there is no "=".
    """
    parsed = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"--set: got {setting!r}, expected name=value, such as --set model.fusion.dropout=0.0")
        try:
            parsed[name] = json.loads(text)
        except json.JSONDecodeError:
            parsed[name] = text
    return parsed


def chosen_settings(options: Any, fields: Mapping[str, str]) -> dict[str, Any]:
    """{"data.horizon": 12} of the options that were given; `fields` says which setting each of them is."""
    return {field: getattr(options, flag) for flag, field in fields.items() if getattr(options, flag) is not None}


def load_run(run: pathlib.Path, which: str, show: screen.Screen) -> run_lib.Run:
    """The run in a folder at what --checkpoint says; shows which damaged checkpoints were passed over.

    Raises:
      ValueError, CheckpointError: as which_checkpoint and checkpoint.load_run.
    """
    loaded = checkpoint.load_run(run, which_checkpoint(which))
    for text in loaded.warnings:
        show.warn(text)
    return loaded


def which_checkpoint(text: str) -> str | int:
    """"latest", "best" or a step, as checkpoint.load_run takes it, from what --checkpoint says.

    Raises:
      ValueError: for anything else.
    """
    if text in ("latest", "best"):
        return text
    if text.isdecimal():
        return int(text)
    raise ValueError(f"--checkpoint: got {text!r}, expected latest, best or a step such as 400.")


def open_data(config: config_lib.Config, show: screen.Screen, split: str | None = None) -> schema.Recording:
    """The recording that a config names, or one split of it, with a progress bar where the town is recorded."""
    with show.counter("recording the built-in town", "frames") as progress:
        return recordings.open_configured(config, progress, split=split)
