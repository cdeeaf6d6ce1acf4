"""The training loop: data in, checkpoints, numbers and pictures out, resumable at every step.

A run is exact: step n always sees the same windows and the same randomness, whether the run was interrupted or not.
"""

from __future__ import annotations

import collections
import concurrent.futures
import dataclasses
import functools
import math
import pathlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping

import jax

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.data import fitting, pipeline, schema, sequences, words
from muvo_jax.objectives import perceptual
from muvo_jax.training import (
    checkpoint,
    checkpoint_meta,
    host,
    opening,
    parallel,
    preparation,
    run_folder,
    screen,
    start,
    timing,
    together,
    validation,
)
from muvo_jax.training import step as step_lib

_STEPS_LATE = 4  # a step is looked at when so many later ones run: what it copied to the host has arrived by then
_MOST_SKIPPED = 10  # batches in a row: it is not the batches then

Preview = Callable[[pathlib.Path, validation.Validator, types.Variables, str], None]


class NonFiniteLossError(ArithmeticError):
    """The loss is NaN or infinite; the message names the step, the terms and the last good checkpoint."""


@dataclasses.dataclass(frozen=True)
class Job:
    """What to train and where.

    Attributes:
      config: a preset with the user's changes.
      folder: the run's folder.
      open_recording: opens (or first makes) the data; called once.
      chosen: dotted names that the user set, which fitting the config to the data leaves alone.
      resume: go on with the run in `folder` instead of starting one.
      init: a run whose newest readable weights a new run starts from.
      pretrained: fills fresh variables with weights from elsewhere, and says which in sentences.
      frozen: the network of the perceptual term, where that is on.
      resume_command: what to type to go on, for messages.
      started_s: time.perf_counter() at the start of the command.
      preview: draws pictures at `train.preview_every`.
      trace: whether the profiler traces some steps into the run's folder.
    """

    config: config_lib.Config
    folder: pathlib.Path
    open_recording: Callable[[], schema.Recording]
    chosen: Collection[str] = ()
    resume: bool = False
    init: pathlib.Path | None = None
    pretrained: start.Pretrained | None = None
    frozen: perceptual.FrozenEncoder | None = None
    resume_command: str = "python -m muvo_jax.train --resume"
    started_s: float = dataclasses.field(default_factory=time.perf_counter)
    preview: Preview | None = None
    trace: bool = False


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run ended: its config as fitted to the data, the step reached, whether it was stopped before the end."""

    config: config_lib.Config
    step: int
    stopped: bool


def train(job: Job, show: screen.Screen) -> Outcome:
    """Trains to `train.steps`, or until the user stops it.

    Raises:
      FileExistsError, FileNotFoundError: where the run exists and `resume` is not asked for, or the other way round.
      DataError, ValueError: for data or settings that do not fit, or that make another architecture than the run's.
      CheckpointError: where a checkpoint cannot be written, or none can be read.
      NonFiniteLossError: where the loss is not finite.
    """
    if job.resume:
        checkpoint_meta.check_resumable(job.config, run_folder.read_config(job.folder), str(job.folder))
    elif together.is_first():
        run_folder.check_new(job.folder, job.resume_command)
    preparation.check_trainable(job.config)
    with concurrent.futures.ThreadPoolExecutor(1, "preparation") as background:
        early = background.submit(_prepare_early, job.config, job.frozen)
        trained: tuple[str, ...] = fitting.OF_TRAINED if job.resume or job.init else ()
        trained += ("train.observe_frames",) if job.resume else ()  # fitted or chosen when the run began
        config, recording, making_s = opening.open_data(job.config, job.open_recording, (*job.chosen, *trained), show)
        frames = pipeline.Frames(recording, config)
        source = _batches(frames, config)
        shapes = preparation.expected_batch(config, _own_windows(config), recorded=sequences.in_every_frame(recording))
        ready = early.result()
        ready = (preparation.recompile(ready, config, shapes, job.frozen) if ready
                 else preparation.prepare(config, shapes, job.frozen))
    opening.introduce(show, config, ready, source.windows_per_epoch, job.frozen, job.folder)
    origin = opening.provenance(recording, config)
    first = functools.partial(start.first, job.init, job.pretrained, show, config, ready, frames)
    state, done, data_state = (None if job.resume else first()), 0, None
    if not job.resume:
        run_folder.create(job.folder, config, job.resume_command)
    with run_folder.claimed(job.folder):
        together.wait_for_all("the run folder is there")
        together.check_same({"settings": config.to_dict(), "data": origin, "run folder": job.folder.is_dir(),
                             "--resume": job.resume, "package versions": checkpoint_meta.package_versions()})
        keeper = checkpoint.Checkpoints(job.folder, keep_last=config.train.keep_last, keep_best=config.train.keep_best)
        if job.resume:
            state, done, data_state = start.resume(keeper, show, config, ready, first)
        if data_state is not None:
            source = _batches(frames, config, data_state)
        run_folder.write_config(job.folder, config)
        files = run_folder.RunFolder(job.folder, done)
        validator = validation.Validator(ready.model, config, frames, job.frozen)
        preparing_s = (ready.initialisation_s, ready.compilation_s)
        run = _Run(job, show, config, ready.step, preparing_s, keeper, files, validator, state, done, origin)
        del early, first, ready, state  # with a state of step 0, which is another one where a run goes on
        try:
            outcome = run.loop(source, making_s)
            keeper.close()
            return outcome
        except BaseException:
            if jax.process_count() == 1:  # else a save under way might wait for a host that is lost
                keeper.close()
            raise
        finally:
            show.stop()
            files.close()


def windows_per_step(config: config_lib.Config) -> int:
    """Windows that one update sees, over all micro-batches, devices and hosts."""
    return config.train.batch * config.optimizer.accumulate


def _own_windows(config: config_lib.Config) -> int:
    """Windows of an update that this process reads."""
    return windows_per_step(config) // jax.process_count()


def _batches(frames: pipeline.Frames, config: config_lib.Config, start_state=None) -> pipeline.TrainBatches:
    return pipeline.TrainBatches(frames, seed=config.train.seed, batch=windows_per_step(config),
                                 start_state=start_state, process=jax.process_index(),
                                 processes=jax.process_count(), accumulate=config.optimizer.accumulate)


def _prepare_early(config: config_lib.Config,
                   frozen: perceptual.FrozenEncoder | None) -> preparation.Prepared | None:
    """Compiles while the town is recorded: its sensors are the preset's. Other data must be looked at first."""
    if config.data.path != "town":
        return None
    return preparation.prepare(config, preparation.expected_batch(config, _own_windows(config)), frozen)


class _Run:
    """One run in progress."""

    def __init__(self, job: Job, show: screen.Screen, config: config_lib.Config, step: step_lib.SpreadFunction,
                 preparing_s: tuple[float, float], keeper: checkpoint.Checkpoints, files: run_folder.RunFolder,
                 validator: validation.Validator, state, done: int, origin: Mapping):
        self.job, self.show, self.config, self.step, self.preparing_s = job, show, config, step, preparing_s
        self.keeper, self.files, self.validator, self.origin = keeper, files, validator, origin
        self.state, self.done = state, done
        self.asked_to_save = done if keeper.saved is not None else None  # the step of the newest checkpoint or save
        self.skipped = 0  # in a row
        self.step_times_s: list[float] = []
        self.spent = timing.Spent()
        self.unchecked: collections.deque[tuple[int, Mapping]] = collections.deque()

    def loop(self, source: pipeline.TrainBatches, making_s: float) -> Outcome:
        settings, pace = self.config.train, timing.Pace()
        traced = self.job.trace and together.is_first()
        trace = timing.Trace(self.job.folder.expanduser() / run_folder.TRACE_FOLDER if traced else None)
        placed = _Placed(source, self.step.place)
        feed = pipeline.prefetch_to_device(placed, self.step.plan.batch_sharding)
        with feed, together.StopRequest() as stop:
            self.show.start(settings.steps, self.done)
            while self.done < settings.steps and not stop.after(self.done):
                trace.begin(len(self.step_times_s))
                start_s, waited_s = time.perf_counter(), feed.waited_s
                batch = next(feed)
                self.state, metrics = self.step(self.state, batch)
                first = not self.step_times_s
                self.done += 1
                metrics["finite"].copy_to_host_async()
                self.unchecked.append((self.done, metrics))
                due = timing.due(self.done, settings)
                at_once = first or due.log or due.any_pause or self.done == settings.steps
                self._check(0 if at_once else _STEPS_LATE)
                self.step_times_s.append(time.perf_counter() - start_s)
                self.spent.add(data=feed.waited_s - waited_s, steps=self.step_times_s[-1] - feed.waited_s + waited_s)
                pace.step(feed.waited_s - waited_s)
                self._tell(trace.end(len(self.step_times_s) - 1, self.state))
                if first:
                    self._first_loss(float(metrics["total"]), making_s)
                    pace.restart()
                if due.log:
                    self.keeper.check()
                    self._log(metrics, None if first else pace.mark(settings.steps - self.done))
                if due.any_pause and self.done < settings.steps:
                    self._pause(due, feed.get_state())
                    pace.restart()
            self._check(0)
            self._tell(trace.end(None, self.state))
            self._finish(stop.requested, feed.get_state())
        return Outcome(self.config, self.done, stop.requested and self.done < settings.steps)

    def _tell(self, line: str | None) -> None:
        if line is not None:
            self.show.line(line)

    def _check(self, late: int) -> None:
        """Looks at all steps but the last `late`: neither does the device wait for the host, nor do batches pile up.

        A step that was not finite has changed no parameter; its successors ran from the same parameters.
        """
        while len(self.unchecked) > late:
            step, metrics = self.unchecked.popleft()
            self.skipped = 0 if float(metrics["finite"]) == 1.0 else self.skipped + 1
            if self.skipped:
                self._not_finite(step, metrics)

    def _not_finite(self, step: int, metrics: Mapping) -> None:
        values = {name: float(value) for name, value in metrics.items()}
        bad = [f"{name} = {value}" for name, value in values.items() if not math.isfinite(value)]
        self.files.log({"kind": "non_finite", "step": step, **values})
        if self.config.train.non_finite == "skip" and self.skipped < _MOST_SKIPPED:
            self.show.warn(f"step {step}: the loss is not finite: {', '.join(bad)}. The batch is skipped.")
            return
        self.keeper.wait()
        saved = self.keeper.saved
        raise NonFiniteLossError(
            f"step {step}: the loss is not finite: {', '.join(bad)}. "
            + (f"The last good checkpoint is of step {saved}, in {self.keeper.folder / str(saved)}."
               if saved is not None else "There is no checkpoint yet.")
            + f" Try a lower --learning-rate, or {self._clipping()}. Where few batches are bad, --set "
              f"train.non_finite=skip leaves them out.")

    def _clipping(self) -> str:
        norm = self.config.optimizer.clip_norm
        if norm > 0.0:
            return f"to clip gradients sooner than at {norm:g}: --set optimizer.clip_norm={norm / 10:g}"
        return ("to clip gradients, in a run of its own (--init and a new --name go on from the weights): --set "
                "optimizer.clip_norm=1")

    def _first_loss(self, loss: float, making_s: float) -> None:
        initialisation_s, compilation_s = self.preparing_s
        self.show.line(f"first loss {loss:.4f} after {time.perf_counter() - self.job.started_s:.1f} s (data "
                       f"{making_s:.1f} s, initialisation {initialisation_s:.1f} s, compilation "
                       f"{compilation_s:.1f} s, first step {self.step_times_s[0]:.1f} s; data and compilation "
                       f"overlap where they can)")

    def _log(self, metrics: Mapping, figures: Mapping[str, float] | None) -> None:
        """figures: screen.Pace.mark; None for the first step after a start, which has no pace and its own line."""
        numbers = {name: float(value) for name, value in metrics.items() if name != "finite"}
        pace = {name: round(value, 4) for name, value in (figures or {}).items() if name != "left_s"}
        self.files.log({"kind": "train", "step": self.done, **numbers, **pace})
        if figures is None:
            return
        text = screen.figures_text({**numbers, **figures})
        self.show.advance(self.done, text)
        left = screen.duration_text(figures["left_s"])
        self.show.log(f"step {self.done}/{self.config.train.steps}  {text}  ETA {left}")

    def _pause(self, due: timing.Due, data_state) -> None:
        """Validation, pictures and a checkpoint, as far as they are due."""
        score = self._validate() if due.validate else None
        if due.preview:
            self._preview()
        if due.checkpoint:
            self._save(data_state, score)
        self.files.log({"kind": "time", "step": self.done, **self.spent.seconds()})

    def _validate(self) -> float | None:
        """Returns the mean skill of the validation splits, the higher the better; None where it is undefined."""
        with self.spent.on("validation"):
            return self._validated()

    def _validated(self) -> float | None:
        scores = []
        for split in self.validator.splits:
            numbers = self.validator.run(self.state, split)
            self.files.log({"kind": "validation", "split": split, "step": self.done, **numbers})
            self.show.line(f"step {self.done}  {split}: {validation.text(numbers)}")
            scores.append(numbers["skill"])
        mean = sum(scores) / len(scores) if scores else math.nan
        return mean if math.isfinite(mean) else None

    def _preview(self) -> None:
        if self.job.preview is None:
            return
        with self.spent.on("pictures"):
            variables = parallel.on_device(self.state.variables, jax.local_devices()[0])  # of all hosts that share it
            if together.is_first():
                self.job.preview(self.job.folder / run_folder.PREVIEW_FOLDER, self.validator, variables,
                                 f"step_{self.done:06d}")

    def _save(self, data_state, score: float | None = None) -> None:
        with self.spent.on("checkpoints"):
            self.keeper.save(self.done, self.state, config=self.config, data_state=data_state, score=score,
                             provenance=self.origin)
        self.asked_to_save = self.done

    def _finish(self, stopped: bool, data_state) -> None:
        total = self.config.train.steps
        self.show.stop()
        if self.done >= total and self.step_times_s:
            score = self._validate()
            self._preview()
            self._save(data_state, score)
        elif self.step_times_s and self.asked_to_save != self.done:
            self._save(data_state)
        with self.spent.on("checkpoints"):
            self.keeper.wait()
        if stopped and self.done < total:
            self.show.line(f"stopped at step {self.done} of {total}; saved. Go on with:  {self.job.resume_command}")
        if self.step_times_s:
            steady_s = self.step_times_s[1:] or self.step_times_s  # the first is no measure
            mean_s, age_s = sum(steady_s) / len(steady_s), time.perf_counter() - self.job.started_s
            self.show.line(f"{words.counted(len(self.step_times_s), 'step')}, {mean_s:.3f} s each on average; peak "
                           f"memory {host.peak_memory_gib():.2f} GiB; {screen.duration_text(age_s)} since the start")
            self.show.line(f"time went into {self.spent.text()}")
            self.files.log({"kind": "time", "step": self.done, **self.spent.seconds()})
        else:
            self.show.line(f"nothing left to train: step {self.done} of {total} is reached (more with --steps).")


class _Placed:
    """Batches split and uploaded for the training step; knows its source's position."""

    def __init__(self, source: pipeline.TrainBatches, place: Callable[[types.Batch], types.Batch]):
        self._source, self._place = source, place

    def __iter__(self) -> Iterator[types.Batch]:
        return self

    def __next__(self) -> types.Batch:
        return jax.block_until_ready(self._place(next(self._source)))

    def get_state(self):
        return self._source.get_state()
