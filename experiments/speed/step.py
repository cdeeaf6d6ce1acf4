"""Where a training step's time goes: python experiments/speed/step.py [--preset=town] [--set KEY=VALUE ...] [--whole]

A row for each part of the step, forward and with its gradients: processor seconds, the arithmetic of its matrix
products and convolutions, and its share of what a float32 product of 2048x2048 reaches in the same run. Random frames
of the preset's sizes, fresh weights. `--whole` leaves the parts out.
"""

import argparse
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import timing

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import presets
from muvo_jax.model import glimpse, rollout, world_model
from muvo_jax.model import memory as memory_lib
from muvo_jax.objectives import kl, total
from muvo_jax.ops import camera, range_view
from muvo_jax.training import cost, host, optimizer, state, step
from muvo_jax.types import Batch


def random_batch(config: config_lib.Config) -> Batch:
    """The windows of an update, of the sizes of a config with camera, range view, route and occupancy."""
    random, model, view = np.random.default_rng(0), config.model, config.model.range_view
    lead = (config.train.batch * config.optimizer.accumulate, config.data.frames)
    beams = range_view.beam_directions(view)
    road_m = view.position_m[2] / np.maximum(-beams[..., 2], 1e-3)
    range_m = np.minimum(20.0, road_m) * random.uniform(0.9, 1.0, (*lead, 1, 1))
    scan = np.concatenate([beams * range_m[..., None] + view.position_m, range_m[..., None]], -1).astype(np.float32)
    intrinsics = camera.intrinsics_from_fov(model.image_size[1], model.image_size[0], 1.4)
    return Batch(action=random.uniform(-1, 1, (*lead, 2)).astype(np.float32),
                 is_first=np.broadcast_to(np.arange(lead[1]) == 0, lead),
                 image=random.integers(0, 256, (*lead, *model.image_size, 3), np.uint8), range_view=scan,
                 occupancy=random.choice(np.array([0, 0, 0, 1, 255], np.uint8), (*lead, *model.voxels.shape)),
                 route_map=np.zeros((*lead, *world_model.ROUTE_MAP_SIZE), np.uint8),
                 speed_mps=np.full(lead, 8.0, np.float32), intrinsics=np.stack([intrinsics] * lead[0]),
                 camera_to_ego=np.stack([camera.level_camera_to_ego((1.0, 0.0, 1.8))] * lead[0]))


def parts(config: config_lib.Config, batch: Batch) -> dict[str, tuple]:
    """Part -> (function, arguments, of which the first are differentiated)."""
    model, network = muvo_jax.WorldModel(config.model), world_model.Network(config.model)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    params, rest = variables["params"], variables["batch_stats"]
    join = lambda own: {"params": params | own, "batch_stats": rest}
    of = lambda *names: {name: params[name] for name in names if name in params}
    keys = jax.random.split(jax.random.key(1), batch.batch_size)
    seen = min(config.train.observe_frames or batch.frames, batch.frames)
    shown = batch.time_slice(0, seen)
    frames = jax.tree.map(jnp.asarray, model._frames(shown))
    mode = world_model.norm.Mode(True)
    during = lambda own, method, *inputs: network.apply(
        join(own), *inputs, method=method, mutable=["batch_stats"])[0]
    camera_of = lambda own: during(own, lambda module, frames: module.camera(frames, mode), frames)
    lidar_of = lambda own: during(own, lambda module, frames: module.lidar(frames, mode), frames)
    # What follows is computed of arguments: XLA would fold constants, for minutes at the paper's size.
    maps = jax.jit(lambda own: (camera_of(own), lidar_of(own)))(params)
    measured = lambda module: [module.route(frames["route_map"], mode)] + (
        [module.speed(frames["speed_mps"])] if config.model.speed else [])
    fused = lambda own, maps: during(own, lambda module, maps: module.fusion(*maps, measured(module), mode, None), maps)
    embedding = jax.jit(fused)(params, maps)
    embedding = embedding.reshape(*shown.action.shape[:2], *embedding.shape[1:])
    noise = rollout.draw_noise(keys, seen, model.initial_state(1).stochastic.shape[1:], dropout=True)
    filtered = lambda own, embedding: rollout.filter_embeddings(
        model, join(own), embedding, shown.action, shown.is_first, noise,
        jnp.asarray(shown.speed_mps) if config.model.tracks_motion else None)
    observed, _ = jax.jit(
        lambda variables: rollout.observe_window(model, variables, shown, keys, train=True))(variables)
    rows = {"camera encoder": (camera_of, (of("camera"),), ()), "lidar encoder": (lidar_of, (of("lidar"),), ()),
            "route, speed and fusion": (fused, (of("fusion", "route", "speed"), maps), ()),
            "filter": (filtered, (of("transition"), embedding), ())}
    if seen < batch.frames:
        rows["imagining"] = (lambda own, last: rollout.imagine(model, join(own), keys, last, jnp.asarray(
            batch.action)[:, seen - 1:-1]).states.features, (of("transition"), observed.last), ())
    states = jax.jit(lambda variables: step._and_imagined(model, variables, observed, batch.action, keys))(variables)
    states, target = step._some_frames(states, batch, keys, config.train.decode_frames)
    flat = lambda tree: jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)
    frame_keys = total.frame_keys(keys, target.frames)
    places = jnp.repeat(jnp.arange(batch.batch_size), target.frames)
    for head in config.model.heads:
        own = of(f"decoders_{head}")
        if head in memory_lib.guessed_heads(config.model):
            rows[f"{head}: what the memory shows"] = (
                lambda pose, head=head: glimpse.look(config.model, observed.memory, places, dataclasses.replace(
                    flat(states.vantage), motion=dataclasses.replace(flat(states.vantage).motion, pose=pose)),
                    (head,)), (flat(states.vantage).motion.pose,), ())
        decode = lambda own, features, head=head: model.decode(
            join(own), dataclasses.replace(states, deterministic=features), (head,), observed.memory)
        rows[f"{head}: decoder"] = (decode, (own, states.deterministic), ())
        predictions = jax.jit(decode)(own, states.deterministic).scales(head)
        rows[f"{head}: losses"] = (
            lambda predictions, head=head: [value.terms(name) for name, value in head_lib.get(head).losses(
                head_lib.Learned(predictions, target, config.model, config.loss, frame_keys, None)).items()],
            (predictions,), ())
    rows["KL divergence"] = (lambda posterior, prior: kl.balanced_kl_sums(
        posterior, prior, balance=config.loss.kl_balance, numerics=config.model.numerics).terms("kl"),
        (observed.posterior, observed.prior), ())
    return rows


def both_ways(function):
    """The function with the gradients of its differentiable arguments, its own results standing for those behind it."""
    def run(*arguments):
        results, pull = jax.vjp(lambda *inputs: [leaf for leaf in jax.tree.leaves(function(*inputs)) if jnp.issubdtype(
            leaf.dtype, jnp.floating)], *arguments)
        return pull(results)

    return run


def profile(config: config_lib.Config, rounds: int, rate: float, whole_only: bool = False) -> None:
    """Prints a row for each part of the step and one for the whole; `rate` is that of a product (cost.product_rate)."""
    batch = random_batch(config)
    print("| part | forward (s) | with gradients (s) | arithmetic (GFLOP) | share of the product's speed |")
    print("|---|---:|---:|---:|---:|")
    for name, (function, arguments, _) in (() if whole_only else parts(config, batch).items()):
        forward, whole = jax.jit(function), jax.jit(both_ways(function))
        taken = timing.processor_seconds({"forward": lambda run=forward, given=arguments: run(*given),
                                          "whole": lambda run=whole, given=arguments: run(*given)}, rounds)
        arithmetic = cost.operations(jax.make_jaxpr(both_ways(function))(*arguments).jaxpr)
        row(name, min(taken["forward"]), min(taken["whole"]), arithmetic, rate)
    update, train, arguments = updates(config, batch)
    arithmetic = cost.operations(jax.make_jaxpr(train.compiled)(*arguments).jaxpr)
    row("**whole step**", None, min(timing.processor_seconds({"whole": update}, rounds)["whole"]), arithmetic,
        rate)


def updates(config: config_lib.Config, batch: Batch):
    """A function that makes one update after the other, the step, and its first arguments as shapes."""
    model = muvo_jax.WorldModel(config.model)
    held = [state.create(model.init(jax.random.key(0)), optimizer.of_config(config), jax.random.key(1))]
    train = step.make_train_step(model, config)
    placed = train.place(batch)
    shapes = jax.eval_shape(lambda *arguments: arguments, held[0], placed)

    def update():
        held[0], metrics = train(held[0], placed)
        return metrics

    return update, train, shapes


def row(name: str, forward_s: float | None, whole_s: float, arithmetic: float, rate: float) -> None:
    forward = "" if forward_s is None else f"{forward_s:.3f}"
    share = arithmetic / whole_s / rate
    print(f"| {name} | {forward} | {whole_s:.3f} | {arithmetic / 1e9:.1f} | {share:.0%} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="town")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--whole", action="store_true")
    options = parser.parse_args()
    host.restart_with_huge_pages()  # as `train` does
    host.use_plain_emitters()
    chosen = dict(setting.split("=", 1) for setting in options.set)
    config = config_lib.override_all(presets.get(options.preset), {
        name: json.loads(value) if value[:1] in "0123456789tf[" else value for name, value in chosen.items()})
    rate = cost.product_rate()
    print(f"float32 product of {cost.GEMM_SIDE}x{cost.GEMM_SIDE}: {rate / 1e9:.0f} GFLOP a processor second\n")
    profile(config, options.rounds, rate, options.whole)


if __name__ == "__main__":
    main()
