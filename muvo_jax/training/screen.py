"""What a run shows on screen: lines, and a progress bar where there is a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping

import rich.console
import rich.progress
import rich.text

_MOST_SAID = 600  # characters of another library's error


class _Console(rich.console.Console):
    def on_broken_pipe(self) -> None:
        """Goes on in silence where the reader has left, as in | head: files and exit code are what counts."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # takes what is still buffered


class Screen:
    """A console with one progress bar; in a log file or a pipe, plain lines take the place of the bar."""

    def __init__(self, console: rich.console.Console | None = None):
        self.console = console or _Console(highlight=False, soft_wrap=True)
        if not self.console.is_terminal:  # a file or a pipe has no width of its own
            self.console.width = 120
        self._bar: rich.progress.Progress | None = None
        self._task: rich.progress.TaskID | None = None

    def line(self, text: str = "", style: str = "") -> None:
        self.console.print(text, style=style or None, markup=False)

    def field(self, name: str, value: str) -> None:
        """One aligned start-up line."""
        self.console.print(rich.text.Text.assemble((f"{name:>12}  ", "bold cyan"), value))

    def warn(self, text: str) -> None:
        self.line(f"warning: {text}", style="yellow")

    @contextlib.contextmanager
    def counter(self, title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
        """Yields progress(done, total) for something that may take a while; shows nothing where it is never called.

        Where the work ends without an error, all of it is done.
        """
        if self.console.is_terminal:
            progress = rich.progress
            bar = progress.Progress(progress.TextColumn(title), progress.BarColumn(bar_width=24),
                                    progress.TextColumn("{task.completed}/{task.total} " + unit),
                                    progress.TimeRemainingColumn(), console=self.console, transient=True)
            task = bar.add_task(title, total=None, visible=False)
            with bar:
                yield lambda done, total: bar.update(task, completed=done, total=total, visible=True)
            return
        told, last = -1, (0, 0)

        def tell(done: int, total: int) -> None:
            nonlocal told, last
            last = done, total
            quarter = 4 * done // max(total, 1)
            if quarter > told:
                told = quarter
                self.line(f"{title}: {done}/{total} {unit}")

        yield tell
        if told >= 0 and last[0] < last[1]:  # the rest was there already, or was not worth a report
            tell(last[1], last[1])

    def start(self, total: int, done: int) -> None:
        """Shows the bar for `total` steps of which `done` are behind us."""
        if not self.console.is_terminal:
            return
        progress = rich.progress
        self._bar = progress.Progress(
            progress.TextColumn("step {task.completed}/{task.total}"), progress.BarColumn(bar_width=24),
            progress.TextColumn("{task.fields[numbers]}"), progress.TextColumn("ETA"), progress.TimeRemainingColumn(),
            console=self.console, refresh_per_second=2)
        self._bar.start()
        self._task = self._bar.add_task("train", total=total, completed=done, numbers="first step ...")

    def advance(self, done: int, numbers: str) -> None:
        """Moves the bar."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, numbers=numbers)

    def log(self, text: str) -> None:
        """A line that is only needed where there is no bar."""
        if self._bar is None:
            self.line(text)

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def figures_text(numbers: Mapping[str, float]) -> str:
    """The numbers of a log line: loss, PSNR, pace."""
    parts = [f"loss {numbers['total']:.4f}"]
    if "psnr_db" in numbers:
        parts.append(f"PSNR {numbers['psnr_db']:.2f} dB")
    parts += [f"{numbers['steps_per_s']:.2f} steps/s", f"waiting for data {numbers['waiting_percent']:.0f} %"]
    return "  ".join(parts)


def duration_text(seconds: float) -> str:
    """12 s, 3 min 20 s, 1 h 5 min."""
    if seconds != seconds:
        return "?"
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def said(error: BaseException) -> str:
    """The kind of an error and its first line; of a very long one the middle is left out, for the cause stands last."""
    line = (str(error).strip().splitlines() or ["no details"])[0].strip()
    if len(line) > _MOST_SAID:
        line = f"{line[:_MOST_SAID // 3]} ... {line[-2 * _MOST_SAID // 3:]}"
    return f"{type(error).__name__}: {line}"
