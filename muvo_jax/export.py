"""python -m muvo_jax.export RUN OUT: a sealed world model that needs jax alone, not muvo_jax.

    OUT/observe_step.bin, imagine.bin, decode_HEAD.bin   StableHLO of jax.export, any batch size, for cpu and cuda
    OUT/weights.safetensors                              one float32 array per parameter
    OUT/config.json, contract.json                       the run's configuration, what an action means
    OUT/signatures.json                                  arguments and results of each function; written last

Arguments and results are arrays and dictionaries of arrays. Keys are raw uint32 data of jax.random.key. The functions
use the plain convolutions, which every platform has.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import pathlib
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax import safetensors_file, types
    from muvo_jax.model import live as live_lib
    from muvo_jax.model import memory as memory_lib
    from muvo_jax.model import rollout, world_model
    from muvo_jax.training import run_folder, screen

PLATFORMS = ("cpu", "cuda")
SIGNATURES = "signatures.json"
WEIGHTS = "weights.safetensors"


@dataclasses.dataclass(frozen=True)
class Options:
    """Writes observe_step, imagine and decode as StableHLO, the weights as safetensors, config and contract as JSON.

    Needs the extra [export].
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """A new or empty folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    horizon: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Steps that `imagine` imagines."""


EXAMPLES = """
python -m muvo_jax.export runs/town-tr sealed/town-tr
python -m muvo_jax.export runs/town-tr sealed/town-tr --horizon=20
"""


def export(options: Options, show: screen.Screen) -> list[pathlib.Path]:
    """Does what the command line asks for; returns the files written.

    Raises:
      ValueError: if OUT is a file or holds something, the horizon is below 1, or a library of the extra is missing.
      OSError: if OUT cannot be written.
    """
    if importlib.util.find_spec("flatbuffers") is None:
        raise ValueError("export needs flatbuffers: pip install 'muvo_jax[export]'")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"OUT: {options.out} is a file; name a new folder.")
    if options.out.exists() and any(options.out.iterdir()):
        raise ValueError(f"OUT: {options.out} is not empty; name a new folder.")
    run_folder.check_writable(options.out, "OUT")
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    horizon = loaded.config.data.horizon if options.horizon is None else options.horizon
    written = seal(loaded.model, loaded.variables, loaded.config, options.out, horizon=horizon)
    for path in written:
        show.line(f"wrote {path}")
    return written


def seal(model: world_model.WorldModel, variables: types.Variables, config: config_lib.Config,
         out: pathlib.Path, *, horizon: int) -> list[pathlib.Path]:
    """Writes the artefact; see the module.

    Raises:
      ValueError: for a horizon below 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}; it must be at least 1.")
    out.mkdir(parents=True, exist_ok=True)
    plain = world_model.WorldModel(dataclasses.replace(model.config, convolution="xla"))
    weights = {name: np.asarray(value, np.float32) for name, value in flatten(variables).items()}
    contents: dict[str, bytes] = {}
    signatures: dict[str, Any] = {}
    for name, (function, arguments) in functions(plain, weights, config, horizon).items():
        exported = jax.export.export(jax.jit(function), platforms=PLATFORMS)(*arguments)
        contents[f"{name}.bin"] = bytes(exported.serialize())
        signatures[name] = {"arguments": [_describe(argument) for argument in arguments[1:]],
                            "result": _describe(jax.tree.unflatten(exported.out_tree, exported.out_avals))}
    contents["config.json"] = json.dumps(config.to_dict(), indent=2).encode()
    contents["contract.json"] = json.dumps(
        {**dataclasses.asdict(config.contract), "stride": config.data.stride}, indent=2).encode()
    contents[SIGNATURES] = json.dumps({"platforms": PLATFORMS, "horizon": horizon, "functions": signatures,
                                       "first_argument": "all arrays of weights.safetensors, a flat dictionary"},
                                      indent=2).encode()
    safetensors_file.save(out / WEIGHTS, weights)
    for name, content in contents.items():  # SIGNATURES last: an artefact without it is not whole
        (out / name).write_bytes(content)
    return [*(out / name for name in contents), out / WEIGHTS]


def functions(model: world_model.WorldModel, weights: Mapping[str, Any], config: config_lib.Config,
              horizon: int) -> dict[str, tuple[Callable, tuple]]:
    """Name -> (function of flat weights and arrays, its arguments as jax.ShapeDtypeStruct with a symbolic batch b)."""
    (batch,) = jax.export.symbolic_shape("b")
    array = lambda dtype, *shape: jax.ShapeDtypeStruct((batch, *shape), dtype)
    flat = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), dict(weights))
    remembered = lambda arrays: {f"memory/{name}": leaf for name, leaf in arrays.items()}
    described = lambda tree: {name: array(leaf.dtype, *leaf.shape[1:]) for name, leaf in to_arrays(tree).items()}
    state, memory = described(model.initial_state(1)), described(memory_lib.empty(model.config, 1))
    keys = array(jax.numpy.uint32, *jax.random.key_data(jax.random.key(0)).shape)
    live = {**state, **remembered(memory), "keys": keys, "frame": array(jax.numpy.int32)}
    observation = {name: array(leaf.dtype, *leaf.shape) for name, leaf in inputs(config).items()}

    def observe_step(weights, live, observation, previous_action):
        tree = unflatten(live)
        memory = types.Memory(**tree["memory"]) if "memory" in tree else None
        stream = live_lib.LiveState(state_of(live), jax.random.wrap_key_data(live["keys"]), live["frame"], memory)
        stream = live_lib.observe_step(model, unflatten(weights), stream, observation, previous_action)
        return {**to_arrays(stream.latent), **remembered(to_arrays(stream.memory)),
                "keys": jax.random.key_data(stream.keys), "frame": stream.frame}

    def imagine(weights, keys, state, actions, temperature):
        dream = rollout.imagine(model, unflatten(weights), jax.random.wrap_key_data(keys), state_of(state), actions,
                                temperature=temperature)
        return to_arrays(dream.states)

    def decode(head, weights, state, memory=None):
        memory = None if memory is None else types.Memory(**memory)
        return rollout.decode(model, unflatten(weights), state_of(state), (head,), memory=memory)[head]

    temperature = jax.ShapeDtypeStruct((), jax.numpy.float32)
    made: dict[str, tuple[Callable, tuple]] = {
        "observe_step": (observe_step, (flat, live, observation, array(jax.numpy.float32, 2))),
        "imagine": (imagine, (flat, keys, state, array(jax.numpy.float32, horizon, 2), temperature))}
    for head in model.config.heads:
        looks = (memory,) if head in memory_lib.guessed_heads(model.config) else ()
        made[f"decode_{head}"] = (functools.partial(decode, head), (flat, state, *looks))
    return made


def inputs(config: config_lib.Config) -> dict[str, jax.ShapeDtypeStruct]:
    """What the model reads of one observation: field of Batch -> [...] without batch and time, as live.observe_step."""
    return {name: jax.ShapeDtypeStruct(shape, types.BATCH_FIELDS[name][0])
            for name, shape in world_model.inputs(config.model).items()}


def to_arrays(tree: Any) -> dict[str, Any]:
    """A LatentState or Memory as {"deterministic": array, "vantage/motion/pose": array, ...}; None is empty."""
    if tree is None:
        return {}
    parts = {name: value for name, value in vars(tree).items() if value is not None}
    return {name if not inner else f"{name}/{inner}": leaf for name, value in parts.items()
            for inner, leaf in (to_arrays(value) if hasattr(value, "__dataclass_fields__") else {"": value}).items()}


def state_of(arrays: Mapping[str, Any]) -> types.LatentState:
    """The LatentState that `to_arrays` took apart; other arrays are left alone."""
    tree = unflatten(arrays)
    vantage = tree.get("vantage")
    if vantage is not None:
        vantage = types.Vantage(**{**vantage, "motion": types.Motion(**vantage["motion"])})
    return types.LatentState(tree["deterministic"], tree["stochastic"], vantage)


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries -> {"params/a/b": array}."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        path = f"{prefix}{name}"
        flat |= flatten(value, f"{path}/") if isinstance(value, Mapping) else {path: value}
    return flat


def unflatten(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of `flatten`."""
    tree: dict[str, Any] = {}
    for path, value in flat.items():
        *parents, leaf = path.split("/")
        node = tree
        for name in parents:
            node = node.setdefault(name, {})
        node[leaf] = value
    return tree


def _describe(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: f"{np.dtype(leaf.dtype).name}[{', '.join(map(str, leaf.shape))}]", tree)


def main() -> int:
    return command_line.run(Options, export, program="export", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
