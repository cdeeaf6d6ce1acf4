"""The folder of one run: config.json, metrics.jsonl, TensorBoard events; checkpoints and pictures lie beside them."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator, Mapping
from typing import Any

from tensorboardX import event_file_writer, summary
from tensorboardX.proto import event_pb2

from muvo_jax import config as config_lib
from muvo_jax.data import processes
from muvo_jax.training import checkpoint, timing, together

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.jsonl"
LOCK_FILE = ".training"
PREVIEW_FOLDER = "previews"
TRACE_FOLDER = "trace"


class RunFolder:
    """Files of one run. Records are appended line by line, so that a killed run loses none that it reported.

    Of several processes the first one writes; in this module the others only read.
    """

    def __init__(self, path: str | os.PathLike, first_step: int = 0):
        self.path = pathlib.Path(path).expanduser()
        self._writes = together.is_first()
        if not self._writes:
            return
        with _writing(self.path / METRICS_FILE):
            _end_line(self.path / METRICS_FILE)
            self._metrics = (self.path / METRICS_FILE).open("a", encoding="utf-8")
        # Not SummaryWriter, which waits for ever for its thread once that has died of a full disk.
        with _writing(self.path):
            self._events = event_file_writer.EventsWriter(str(self.path / "events"))
            if first_step:  # TensorBoard then hides what an earlier start told of this step and later ones
                started = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
                self._events.write_event(event_pb2.Event(step=first_step, session_log=started))

    def log(self, record: Mapping[str, Any]) -> None:
        """Appends one record; finite numbers also go to TensorBoard as `kind/name`. What is not finite is null.

        Raises:
          OSError: where it cannot be written, naming the file.
        """
        if not self._writes:
            return
        clean = {name: _json_number(value) for name, value in record.items()}
        with _writing(self.path / METRICS_FILE):
            self._metrics.write(json.dumps(clean) + "\n")
            self._metrics.flush()
        prefix = "/".join(str(record[name]) for name in ("kind", "split") if name in record)
        event = event_pb2.Event(wall_time=time.time(), step=record["step"])
        for name, value in record.items():
            if name != "step" and isinstance(value, (int, float)) and math.isfinite(value):
                event.summary.value.extend(summary.scalar(f"{prefix}/{name}", value).value)
        with _writing(self.path):
            self._events.write_event(event)
            self._events.flush()

    def close(self) -> None:
        """Safe after a failed `log`, too: what could not be written then is given up."""
        for file in (self._metrics, self._events) if self._writes else ():
            with contextlib.suppress(OSError):
                file.close()


@contextlib.contextmanager
def _writing(path: pathlib.Path) -> Iterator[None]:
    """Names the file of an error, which Python's do not."""
    try:
        yield
    except OSError as error:
        raise OSError(f"{path} cannot be written ({error.strerror or error}). Is the disk full, or the folder "
                      f"read-only? Mend that and go on with --resume.") from error


def _end_line(path: pathlib.Path) -> None:
    """Ends a last line that was cut short, or the next record would be lost with it."""
    if not path.is_file() or not path.stat().st_size:
        return
    with path.open("rb+") as file:
        file.seek(-1, os.SEEK_END)
        if file.read(1) != b"\n":
            file.write(b"\n")


@contextlib.contextmanager
def claimed(path: str | os.PathLike) -> Iterator[None]:
    """Keeps another training out of an existing run's folder.

    Raises:
      BlockingIOError: where one is there now.
    """
    if not together.is_first():
        yield
        return
    with processes.locked(pathlib.Path(path).expanduser() / LOCK_FILE, "training"):
        yield


def check_new(path: str | os.PathLike, again: str) -> None:
    """Refuses to start a run where there is one.

    Args:
      again: the command that goes on with an existing run, for the message.

    Raises:
      FileExistsError: where it exists and is not empty; nothing in it is touched.
      OSError: where no folder can be made there.
    """
    path = pathlib.Path(path).expanduser()
    if path.is_dir() and any(path.iterdir()):
        has_steps = bool(list((path / checkpoint.FOLDER).glob("*")))
        state = "has checkpoints" if has_steps else "has no checkpoint yet"
        raise FileExistsError(f"run folder {path} exists and {state}. Go on with it:  {again}   "
                              f"or start another one with  --name=SOMETHING_NEW")
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file, expected a folder for the run: choose another --name.")
    parent = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        state = "cannot be written to" if parent.is_dir() else "is a file"
        raise OSError(f"{parent} {state}, so that {path} cannot be made: choose another --runs-dir or --name.")


def check_writable(path: str | os.PathLike, name: str) -> None:
    """Whether a folder can be written into, or made, for the moment before anything takes long. Leaves nothing.

    Args:
      name: what the user calls it, for the message, such as "--out".

    Raises:
      OSError: where it cannot.
    """
    path = there = pathlib.Path(path).expanduser().absolute()
    try:
        there = next(parent for parent in (path, *path.parents) if parent.exists())
        with tempfile.TemporaryFile(dir=there):  # os.access knows neither root's rights nor read-only file systems
            pass
    except OSError as error:
        said = "it is a file" if there.is_file() else error.strerror or str(error)
        raise OSError(f"{name}: nothing can be written into {path} ({there}: {said}). Choose another folder, or mend "
                      f"that.") from error


def create(path: str | os.PathLike, config: config_lib.Config, again: str) -> None:
    """Makes the folder of a new run and writes its config; refuses as `check_new` does."""
    if not together.is_first():
        return
    check_new(path, again)
    pathlib.Path(path).expanduser().mkdir(parents=True, exist_ok=True)
    write_config(path, config)


def write_config(path: str | os.PathLike, config: config_lib.Config) -> None:
    """Writes RUN/config.json; the file is replaced as a whole."""
    if not together.is_first():
        return
    target = pathlib.Path(path).expanduser() / CONFIG_FILE
    partial = target.with_name(CONFIG_FILE + ".part")
    with _writing(target):
        partial.write_text(json.dumps(config.to_dict(), indent=2) + "\n", encoding="utf-8")
        partial.replace(target)


def read_config(path: str | os.PathLike) -> config_lib.Config:
    """The config of an existing run.

    Raises:
      FileNotFoundError: where there is no run.
      ValueError: where its config.json cannot be understood.
    """
    source = pathlib.Path(path).expanduser() / CONFIG_FILE
    try:
        return config_lib.Config.from_dict(json.loads(source.read_text(encoding="utf-8-sig")))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{source} is missing, so there is no run to go on with in {path}. "
                                f"Leave --resume away to start one.") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{source} is not valid JSON ({error}). Every checkpoint holds a copy of the config: take it "
                         f"from {path}/{checkpoint.FOLDER}/STEP/meta.") from error
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def read_metrics(path: str | os.PathLike) -> list[dict[str, Any]]:
    """All records of a run, oldest first; what is none, such as a line cut short by a crash, is left out."""
    source = pathlib.Path(path).expanduser() / METRICS_FILE
    records = []
    for line in source.read_text(encoding="utf-8", errors="replace").splitlines() if source.is_file() else []:
        with contextlib.suppress(ValueError, RecursionError):
            record = json.loads(line)
            if isinstance(record, dict) and {"kind", "step"} <= record.keys():
                records.append(record)
    return records


def reproducible_metrics(path: str | os.PathLike) -> list[dict[str, Any]]:
    """The records of a run without what depends on the clock: those of the same run made again are equal."""
    return [{name: value for name, value in record.items() if name not in timing.OF_THE_CLOCK}
            for record in read_metrics(path) if record["kind"] != "time"]


def forget_after(path: str | os.PathLike, step: int) -> int:
    """Removes records of later steps, which a resumed run makes again; returns how many."""
    if not together.is_first():
        return 0
    records = read_metrics(path)
    kept = [record for record in records if record["step"] <= step]
    if len(kept) == len(records):
        return 0
    target = pathlib.Path(path).expanduser() / METRICS_FILE
    partial = target.with_name(METRICS_FILE + ".part")
    with _writing(target):
        partial.write_text("".join(json.dumps(record) + "\n" for record in kept), encoding="utf-8")
        partial.replace(target)
    return len(records) - len(kept)


def _json_number(value):
    return None if isinstance(value, float) and not math.isfinite(value) else value
