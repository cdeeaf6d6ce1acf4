"""python -m muvo_jax.train: train a world model, judge it and draw its dreams."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import shlex
import sys
import traceback
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax import choices, dream, evaluate, presets, recordings
    from muvo_jax import config as config_lib
    from muvo_jax.interop import backbones
    from muvo_jax.metrics import protocol
    from muvo_jax.objectives import perceptual
    from muvo_jax.training import (
        builtin,
        checkpoint,
        loop,
        run_folder,
        screen,
        start,
        together,
        transfer,
        validation,
    )
    from muvo_jax.viz import curves, sheets

PERCEPTUAL_WEIGHT = 0.1  # the reference's
_LONGEST_NAME = 255  # bytes of a file's or a folder's, on every usual file system
# Flags that change one field of the configuration.
_FIELDS = {"lidar": "model.lidar", "camera": "model.camera", "fusion": "model.fusion", "latent": "model.latent",
           "backbone": "model.backbone", "data": "data.path", "data_camera": "data.camera", "workers": "data.workers",
           "steps": "train.steps", "batch": "train.batch", "accumulate": "optimizer.accumulate",
           "frames": "data.frames", "stride": "data.stride", "context": "data.context", "horizon": "data.horizon",
           "learning_rate": "optimizer.learning_rate", "seed": "train.seed", "parallel": "train.parallel"}

_ANY_CASE = ("lidar", "camera", "fusion", "latent", "backbone")  # the paper writes RV, WOB, TR


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains a multimodal world model on camera and lidar, judges it beside baselines and draws its dreams.

    Without options it records a small built-in town and learns to predict it, in minutes, on two CPU cores.

    A flag beats the preset; --set reaches every other setting. Everything lands in RUNS_DIR/NAME.
    """

    preset: Annotated[str | None, command_line.shown("NAME", "town")] = None
    """Named configuration: town (small), tiny (for tests), paper (camera and lidar at the paper's size),
    paper-occupancy (with voxels), reference-1d, reference-2d, reference-mobilevit (as the authors released them)."""
    variant: Annotated[str | None, command_line.shown("NAME")] = None
    """The paper's name of lidar, camera and fusion, such as PP-BEV-FC."""
    lidar: Annotated[str | None, command_line.shown("{rv,pp,none}")] = None
    """How points are read: rv (range view), pp (PointPillars) or none (not at all)."""
    camera: Annotated[str | None, command_line.shown("{wob,bev,none}")] = None
    """How images are read: wob (as they are), bev (lifted to a bird's-eye view) or none (not at all)."""
    fusion: Annotated[str | None, command_line.shown("{tr,fc,avg}")] = None
    """How camera and lidar are fused: tr (transformer), fc (concatenation and a dense layer), avg (mean)."""
    latent: Annotated[str | None, command_line.shown("{1d,2d}")] = None
    """The latent state: 1d (vectors) or 2d (tokens, only with fusion tr; the town preset's there)."""
    backbone: Annotated[str | None, command_line.shown("{resnet18,mobilevitv2_100}")] = None
    """Of image and range view."""
    heads: Annotated[str | None, command_line.shown("NAME,...")] = None
    """What is predicted, exactly: of image, range_view, occupancy, action and the optional heads (docs/variants.md)."""
    with_heads: Annotated[str | None, command_line.shown("NAME,...", "none")] = None
    """Heads beside those of the preset."""
    backbone_weights: Annotated[pathlib.Path | None, command_line.shown("PATH", "none")] = None
    """Start the encoders from an image network: a .pth or .safetensors file of ResNet-18 (torchvision's or timm's
    names) or MobileViT-V2 (timm's), whichever --backbone says. Nothing is downloaded."""
    perceptual: tyro.conf.FlagCreatePairsOff[bool] = False
    """Compare pictures by the maps of a frozen network too: that of --backbone-weights or of --perceptual-from."""
    perceptual_from: Annotated[pathlib.Path | None, command_line.shown("RUN", "none")] = None
    """The frozen network is the image encoder of this run (or in this file)."""
    occupancy: tyro.conf.FlagCreatePairsOff[bool] = False
    """Predict occupancy, whatever the preset says."""
    no_occupancy: tyro.conf.FlagCreatePairsOff[bool] = False
    """Predict no occupancy."""
    augment: tyro.conf.FlagCreatePairsOff[bool] = False
    """Vary images and route maps that the encoders see in training, whatever the preset says."""
    no_augment: tyro.conf.FlagCreatePairsOff[bool] = False
    """Train on windows as they were recorded, not mirrored or in another light either."""
    data: Annotated[str | None, command_line.shown("PATH")] = None
    """"town" (built in) or the folder of a recording; its kind is recognised."""
    data_camera: Annotated[str | None, command_line.shown("NAME", "the reader's choice")] = None
    """Which camera of the recording, where it has several (KITTI: image_00 to image_03; nuScenes: CAM_FRONT, ...)."""
    key_frames: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only key frames, where the recording has them (nuScenes: 2 a second instead of 10)."""
    workers: Annotated[int | None, command_line.shown("N", "one a processor but one, 2 to 16")] = None
    """How many batches are read and decoded side by side, each by a thread."""
    name: Annotated[str | None, command_line.shown("NAME", "made of data, preset and fusion")] = None
    """Of the run."""
    runs_dir: pathlib.Path = pathlib.Path("runs")
    """Where runs are kept."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go on with the run of that name from its newest readable checkpoint, with the settings it was started with."""
    init: Annotated[pathlib.Path | None, command_line.shown("RUN", "fresh weights")] = None
    """Start from the weights of another run (trained, or converted from PyTorch), whose network is then taken too."""
    steps: Annotated[int | None, command_line.shown("N")] = None
    """Updates of the whole run. The learning rate follows a schedule over all of them."""
    batch: Annotated[int | None, command_line.shown("N")] = None
    """Windows per micro-batch, over all devices."""
    accumulate: Annotated[int | None, command_line.shown("N")] = None
    """Micro-batches per update."""
    frames: Annotated[int | None, command_line.shown("N")] = None
    """Frames of a training window."""
    stride: Annotated[int | None, command_line.shown("N")] = None
    """Recorded frames from one frame of a window to the next."""
    context: Annotated[int | None, command_line.shown("N")] = None
    """Frames that evaluation observes."""
    horizon: Annotated[int | None, command_line.shown("N")] = None
    """Frames that evaluation imagines after them."""
    learning_rate: Annotated[float | None, command_line.shown("RATE")] = None
    """Peak of the schedule."""
    seed: Annotated[int | None, command_line.shown("N")] = None
    """Of initialisation, order of the data and sampling."""
    parallel: Annotated[str | None, command_line.shown("{auto,pmap,shard_map}")] = None
    """How devices share a batch: auto takes shard_map where there is more than one."""
    hosts: Annotated[str | None, command_line.shown("{N,auto}", "this process alone")] = None
    """Train together with other processes, each started with this command (docs/cluster.md): how many, or auto in a job
    of SLURM, Kubernetes, Open MPI or Cloud TPU, which says the rest too."""
    host: Annotated[int | None, command_line.shown("INDEX", "none")] = None
    """Which of them this one is, from 0."""
    coordinator: Annotated[str | None, command_line.shown("ADDRESS:PORT", "none")] = None
    """Of host 0, a free port there; the same for all."""
    trace: bool = False
    """Let JAX's profiler trace five steps into RUN/trace (for XProf or Perfetto)."""
    evaluate: bool = True
    """Judge the trained model on every split and draw a dream at the end."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Any setting of the configuration, such as optimizer.clip_norm=1 (config.json of a run shows them all)."""


EXAMPLES = """
python -m muvo_jax.train --fusion=tr
python -m muvo_jax.train --variant=PP-BEV-FC --no-occupancy
python -m muvo_jax.train --preset=tiny  (does everything run?)
python -m muvo_jax.train --data=/data/kitti_raw --name=kitti
python -m muvo_jax.train --name=town-tr --resume --steps=800  (goes on with a run)
python -m muvo_jax.train --init=runs/town-tr --data=/data/kitti_raw  (starts from its weights)
python -m muvo_jax.train --preset=paper-occupancy --batch=1 --accumulate=1 --steps=1 --no-evaluate
python -m muvo_jax.train --set loss.kl=0.01 model.fusion.dropout=0.0
python -m muvo_jax.train --batch=16 --hosts=2 --host=0 --coordinator=10.0.0.1:1234  (and --host=1 on another machine)
"""


def configure(options: Options) -> tuple[config_lib.Config, dict[str, Any], pathlib.Path]:
    """Returns the config, the settings that the user chose by dotted name, and the run's folder.

    Raises:
      ValueError: for an unknown setting or a value of the wrong type; for a name that is none; for flags and settings
        that contradict each other; for another preset than that of the resumed run, or another network than that of
        the run to start from.
      FileNotFoundError, CheckpointError: where there is no run to resume or to start from.
    """
    if options.resume and options.init:
        raise ValueError("--resume and --init contradict each other: a resumed run has weights of its own.")
    options = _in_lower_case(options)
    settings = command_line.parse_settings(options.set)
    choices.check(options, settings, _FIELDS)
    chosen = (choices.of_variant(options, settings) | _network_settings(options, settings)
              | command_line.chosen_settings(options, _FIELDS) | settings)
    base, folder = presets.get(options.preset or "town"), options.runs_dir / run_name(options)
    started = checkpoint.load_run(options.init) if options.init else None
    if options.resume:
        base = run_folder.read_config(folder)
        if options.preset not in (None, base.preset):
            raise ValueError(f"run {folder} was started with preset {base.preset!r}, not {options.preset!r}: leave "
                             f"--preset away, or start another run with --name.")
    elif started is not None:
        base = dataclasses.replace(base, model=started.config.model)
    heads = choices.heads(options, chosen.get("model.heads", base.model.heads))
    if heads is not None:
        chosen["model.heads"] = heads
    if options.key_frames:
        chosen["data.key_frames"] = True
    if options.augment or options.no_augment:
        if options.augment and options.no_augment:
            raise ValueError("--augment and --no-augment contradict each other: give one of them.")
        for name in ("image", "route") if options.augment else ("image", "route", "mirror", "light"):
            chosen.setdefault(f"augmentation.{name}", options.augment)
    if chosen.get("model.fusion", "tr") != "tr" and isinstance(base.model.latent, config_lib.TokenLatent):
        chosen.setdefault("model.latent", "1d")  # the only one that such a fusion has
    base = config_lib.override_all(base, chosen)
    if (options.perceptual or options.perceptual_from) and "image" not in base.model.heads:
        raise ValueError(f"--perceptual compares images, and no head predicts any (heads {', '.join(base.model.heads)}"
                         f"): add --with-heads=image, or leave --perceptual away.")
    if base.data.path != "town":
        base = config_lib.override(base, "data.path", str(pathlib.Path(base.data.path).expanduser().resolve()))
    elif {"data.camera", "data.key_frames"} & chosen.keys():
        recordings.check_town(base.data)
    if started is not None and any(name.startswith("model.") for name in chosen):
        transfer.check(started, base)
    return base, chosen, folder


def _network_settings(options: Options, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """What --backbone-weights, --perceptual and --perceptual-from set, beside what --set does.

    Raises:
      ValueError: where they contradict other flags, or the perceptual term has no network.
    """
    settings: dict[str, Any] = {}
    given = options.backbone_weights or "train.backbone_weights" in chosen
    if given and (options.init or options.resume):
        flag = "--backbone-weights" if options.backbone_weights else "--set train.backbone_weights"
        raise ValueError(f"{flag} and --{'init' if options.init else 'resume'} contradict each other: the encoders "
                         f"have weights then. Give one of them.")
    if options.backbone_weights:
        settings["train.backbone_weights"] = str(options.backbone_weights.expanduser().resolve())
    if options.perceptual or options.perceptual_from:
        source = options.perceptual_from or options.backbone_weights
        if source is None:
            raise ValueError("--perceptual compares pictures by the maps of a trained image network, and there is "
                             "none: give --backbone-weights=PATH (a ResNet-18 of ImageNet, say) or "
                             "--perceptual-from=RUN (one of your runs).")
        shipped = builtin.named(source) is not None  # a name, and no file here
        settings |= {"loss.image_perceptual": PERCEPTUAL_WEIGHT,
                     "train.perceptual_from": str(source if shipped else source.expanduser().resolve())}
    return settings


def frozen_encoder(config: config_lib.Config) -> perceptual.FrozenEncoder | None:
    """The network of the perceptual term; None where the term is off.

    Raises:
      ValueError, CheckpointError: where there is none, or it cannot be read.
    """
    if not config.loss.image_perceptual:
        return None
    if not config.train.perceptual_from:
        raise ValueError("loss.image_perceptual is on, but train.perceptual_from names no network. Give --perceptual "
                         "with --backbone-weights=PATH or --perceptual-from=RUN.")
    path = pathlib.Path(config.train.perceptual_from).expanduser()
    if builtin.named(path) is None and not path.is_dir():
        return backbones.frozen_encoder(backbones.read(path))
    loaded = checkpoint.load_run(path)
    return backbones.frozen_encoder_of_run(loaded.variables, loaded.config.model, f"step {loaded.step} of {path}")


def run_name(options: Options) -> str:
    """That of the run's folder in RUNS_DIR; it may lie in folders there, as a/b does.

    Raises:
      ValueError: for one that leads elsewhere, or that no folder can have.
    """
    name = options.name or default_name(_in_lower_case(options))
    parts, problem = pathlib.PurePath(name).parts, None
    if name.startswith(("~", "/")):
        problem = f"it is a path; give --runs-dir={name} and a name"
    elif not name.strip() or not parts or ".." in parts:
        problem = "it leads out of that folder, or to the folder itself"
    elif "\0" in name or any(len(os.fsencode(part)) > _LONGEST_NAME for part in parts):
        problem = f"no folder can be called so (up to {_LONGEST_NAME} bytes, none of them 0)"
    if problem:
        raise ValueError(f"--name is a name inside --runs-dir ({options.runs_dir}); got {name!r:.100}: {problem}.")
    return name


def _in_lower_case(options: Options) -> Options:
    """What the paper writes in capitals."""
    return dataclasses.replace(options, **{flag: getattr(options, flag).lower() for flag in _ANY_CASE
                                           if getattr(options, flag) is not None})


def default_name(options: Options) -> str:
    """Such as town-tr, tiny-pp-bev-fc or kitti_raw-tr-2d."""
    settings = choices.of_variant(options, {})
    lidar, camera, fusion = (getattr(options, flag) or settings.get(f"model.{flag}", usual)
                             for flag, usual in (("lidar", "rv"), ("camera", "wob"), ("fusion", "tr")))
    parts = [options.preset or "town", fusion if (lidar, camera) == ("rv", "wob") else f"{lidar}-{camera}-{fusion}"]
    parts += [choice for choice in (options.latent, options.backbone) if choice]
    if options.data not in (None, "town"):
        parts = [pathlib.Path(options.data).resolve().name] + (parts if options.preset else parts[1:])
    return "-".join(parts)


def train(options: Options, show: screen.Screen) -> None:
    """Does what the command line asks for."""
    launch = together.launch_of(options.hosts, options.host, options.coordinator)
    if launch is not None:
        together.join(launch, show)
    config, chosen, folder = configure(options)
    elsewhere = [f"--runs-dir={options.runs_dir}"] if options.runs_dir != pathlib.Path("runs") else []
    resume_command = shlex.join(["python", "-m", "muvo_jax.train", f"--name={run_name(options)}", "--resume",
                                 *elsewhere])
    visible = bool(protocol.shown_heads(config.model))
    with together.noticing_losses(resume_command):
        outcome = loop.train(loop.Job(
            config=config, folder=folder, open_recording=lambda: command_line.open_data(config, show),
            chosen=tuple(chosen), resume=options.resume, resume_command=resume_command,
            started_s=command_line.process_start_s(), init=options.init,
            pretrained=_pretrained(config, options.resume), frozen=frozen_encoder(config),
            preview=draw_preview if visible else None, trace=options.trace), show)
    if not together.is_first():
        return
    draw_curves(folder)
    if not visible:
        show.line("no head shows anything: there is nothing to draw or to judge.")
    if outcome.stopped or not options.evaluate or not visible:
        return
    evaluate.evaluate(evaluate.Options(run=folder), show)
    dream.dream(dream.Options(run=folder), show)


def _pretrained(config: config_lib.Config, resume: bool) -> start.Pretrained | None:
    """Fills a fresh model's encoders from the file that the config names; a resumed run hardly needs it any more."""
    path = config.train.backbone_weights
    if not path:
        return None
    backbone = None if resume else backbones.read(path)
    if backbone is not None:
        backbones.check(backbone, config.model)  # before anything is recorded or compiled
    return lambda variables, model: backbones.load_into(variables, backbone or backbones.read(path), model)


def draw_preview(folder: pathlib.Path, validator: validation.Validator, variables, name: str) -> None:
    """Pictures of one window of the first validation split, and the curves so far."""
    split = validator.splits[0] if validator.splits else "train"
    batch, frames = validator.example(split, variables)
    config = validator.config
    sheets.write_dream(folder, sheets.views_of_batch(batch, 0), {"world model": sheets.views_of_frames(frames, 0)},
                       np.asarray(batch.action[0]), sheets.Scene.of(config), context=config.data.context,
                       title=f"{config.model.variant}  {name}  {split}", name=f"{name}_{split}", animate=False,
                       beside=dream.moved_views(batch, config))
    draw_curves(folder.parent)


def draw_curves(folder: pathlib.Path) -> None:
    """RUN/curves.png from RUN/metrics.jsonl."""
    records = run_folder.read_metrics(folder)
    names = ("total", "psnr_db", "kl", "gradient_norm", "imagined_psnr_db", "imagined_chamfer_m",
             "imagined_iou_occ_above", "skill")
    units = {"psnr_db": "dB", "imagined_psnr_db": "dB", "imagined_chamfer_m": "m"}
    plots = []
    for name in names:
        series: dict[str, tuple[list, list]] = {}
        for record in records:
            if name not in record or record["kind"] not in ("train", "validation"):
                continue
            steps, values = series.setdefault(record.get("split", record["kind"]), ([], []))
            steps.append(record["step"])
            values.append(float("nan") if record[name] is None else record[name])
        if series:
            plots.append(curves.curve(series, name.removesuffix("_db").removesuffix("_m").replace("_", " "),
                                      unit=units.get(name, ""), logarithmic=name in ("total", "kl", "gradient_norm")))
    if plots:
        curves.write_curves(folder / "curves.png", plots, folder.name)


def main() -> int:
    try:
        code = command_line.run(Options, train, program="train", examples=EXAMPLES, trains=True)
    except Exception:  # at the interpreter's end this host would wait for others that wait for it
        traceback.print_exc()
        code = 1
    return together.leave(code)


if __name__ == "__main__":
    sys.exit(main())
