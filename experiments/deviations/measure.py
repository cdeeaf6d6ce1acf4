"""What each deviation from the reference does to a number: python experiments/deviations/measure.py [--output FILE]

Prints a markdown table. Seconds on two CPU cores; nothing is trained, so that every row can be repeated exactly.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import geometry, presets, types
from muvo_jax.metrics import points
from muvo_jax.model import rollout, world_model
from muvo_jax.objectives import kl, regression, scal
from muvo_jax.ops import camera, frustum, pillars
from muvo_jax.town import settings
from muvo_jax.town.simulator import Town


def gaussians(seed: int, frames: int) -> tuple[types.Gaussian, types.Gaussian]:
    """A posterior and a prior [4, frames, 512] with standard deviations between 0.1 and 2.1."""
    random = np.random.default_rng(seed)
    draw = lambda: types.Gaussian(jnp.asarray(random.normal(size=(4, frames, 512)), jnp.float32),
                                  jnp.asarray(random.uniform(0.1, 2.1, (4, frames, 512)), jnp.float32))
    return draw(), draw()


def leaky_slope() -> tuple[str, str]:
    """Mean absolute size of imagined deterministic states after six steps, with the same fresh weights."""
    sizes = []
    for numerics in ("standard", "reference"):
        config = config_lib.override_all(presets.get("town"), {"model.latent": "1d", "model.numerics": numerics}).model
        model = world_model.WorldModel(config)
        variables = model.init(jax.random.key(0))
        dream = rollout.imagine(model, variables, jax.random.key(1), model.initial_state(8), jnp.ones((8, 6, 2)))
        sizes.append(f"{float(jnp.abs(dream.prior.mean[:, -1]).mean()):.4f}")
    return sizes[0], sizes[1]


def first_step_kl(frames: int) -> tuple[str, str]:
    """Balanced KL of random Gaussians over `frames` steps, nats per frame."""
    posterior, prior = gaussians(0, frames)
    values = [float(kl.balanced_kl_sums(posterior, prior, balance=0.75, numerics=numerics).value())
              for numerics in ("standard", "reference")]
    return f"{values[0]:.2f}", f"{values[1]:.2f}"


def prior_dropout_coin() -> tuple[str, str]:
    """Share of steps after the first in which all 8 windows of a batch toss the same coin (probability 0.15 each)."""
    keys = rollout.sample_keys(jax.random.key(0), 8)
    coins = np.asarray(rollout.draw_noise(keys, 2000, (1,), 0.15).use_prior)
    batch_axis = coins.shape.index(8)
    same = coins.all(batch_axis) | ~coins.any(batch_axis)
    return f"{same.mean():.3f}", "1.000"


def town_frame() -> dict[str, np.ndarray]:
    """One frame of the town at the default sizes, with its occupancy."""
    town = Town(settings.from_config(presets.get("town")))
    seen = town.render(town.reset(2_000))
    return {**seen, "occupancy": town.occupancy(seen)}


def masked_xyz(frame: dict[str, np.ndarray]) -> tuple[str, str]:
    """L2 of xyz (units of 50 m) where every point is predicted at the origin."""
    target = jnp.asarray(frame["range_view"], jnp.float32)[None, None]
    origin = jnp.zeros_like(target)
    xyz = [regression.range_view_sums(origin, target, scale_m=50.0, mask_holes=masked)[0] for masked in (True, False)]
    return f"{float(xyz[0].value()):.4f}", f"{float(xyz[1].value()):.4f}"


def unknown_voxels(frame: dict[str, np.ndarray]) -> tuple[str, str]:
    """Cross-entropy of a network that says 0.5 for seen free space and 0.9 for all the rest."""
    occupancy = frame["occupancy"]
    p = np.where(occupancy == types.OCCUPANCY_EMPTY, 0.5, 0.9)
    logits = jnp.asarray(np.stack([np.log1p(-p), np.log(p)], -1), jnp.float32)
    values = [float(scal.cross_entropy(scal.occupancy_sums(logits, jnp.asarray(occupancy), unknown_is_empty)))
              for unknown_is_empty in (False, True)]
    return f"{values[0]:.4f}", f"{values[1]:.4f}"


def chamfer_of_pixels(frame: dict[str, np.ndarray]) -> tuple[str, str]:
    """Chamfer distance (m) of the frame to itself moved by 1 m: of returns, or of 10,000 random pixels, holes too."""
    truth = np.asarray(frame["range_view"], np.float32)
    moved = truth.copy()
    moved[truth[..., 3] > 0, 0] += 1.0
    returns = points.frame_chamfer_m(moved[None, None], truth[None, None], seed=(0,), return_threshold_m=1.0, points=0)
    pixels = points.pixel_chamfer_m(moved[None, None], truth[None, None], pixels=10_000, seed=(0,))
    return f"{float(returns.squeeze()):.3f}", f"{float(pixels.squeeze()):.3f}"


def pillar_offsets() -> tuple[str, str]:
    """Mean distance along x of points, evenly spread over the grid, to what a pillar takes for its centre (m)."""
    grid = geometry.PillarGrid()
    cloud = jnp.asarray(np.random.default_rng(0).uniform(-48, 48, (1, 4000, 3)), jnp.float32)
    index, cell = pillars.pillar_indices(cloud, jnp.asarray([4000], jnp.int32), grid)
    offsets = [pillars.decorate(cloud, index, cell, grid, swapped_corners=swapped)[..., 6] for swapped in (False, True)]
    here, reference = (f"{float(jnp.abs(offset).mean()):.2f}" for offset in offsets)
    return here, reference


def lifted_share() -> tuple[str, str]:
    """Share of the points on a camera's rays that fall into the bird's-eye grid, at the paper's size."""
    grid, size = geometry.BirdsEyeGrid(), (40, 104)
    cropped_px = np.array([[0, 0, 64], [0, 0, 138], [0, 0, 0]], np.float32)
    intrinsics = camera.intrinsics_from_fov(960, 600, math.radians(100)) - cropped_px
    pose = camera.level_camera_to_ego((1.0, 0.0, 2.0))
    shares = []
    for quirks in (False, True):
        rays = frustum.frustum_points(intrinsics[None], pose[None], size, 8, grid.depth_bins, corners=quirks)
        shares.append(f"{float((frustum.cell_indices(rays, grid, truncate=quirks) < grid.cells**2).mean()):.4f}")
    return shares[0], shares[1]


def posterior_memory() -> tuple[str, str]:
    """Mean change of the posterior's means where the mark of the state's tokens moves by N(0, 0.5), 2D town model."""
    changes = []
    for numerics in ("standard", "reference"):
        config = dataclasses.replace(presets.get("town").model, numerics=numerics)
        model = world_model.WorldModel(config)
        params = model.init(jax.random.key(0))["params"]
        mark = 0.5 * jax.random.normal(jax.random.key(1), (config.fusion.token_channels,))
        embedding = jax.random.normal(jax.random.key(2), (4, 50, config.fusion.token_channels))
        zeros = model.initial_state(4).stochastic
        noise = types.StepNoise(zeros, zeros, jnp.zeros((4,), bool))

        def means(table, model=model, params=params, embedding=embedding, noise=noise):
            moved = {**params, "transition": {**params["transition"], "type_embedding": table}}
            return model.observe_step({"params": moved}, noise, model.initial_state(4), jnp.ones((4, 2)), embedding,
                                      jnp.zeros((4,), bool))[1][1].mean

        table = jnp.asarray(params["transition"]["type_embedding"])
        changes.append(f"{float(jnp.abs(jax.jit(means)(table.at[1].add(mark)) - jax.jit(means)(table)).mean()):.4f}")
    return changes[0], changes[1]


def decoder_parameters() -> tuple[str, str]:
    """Parameters of the 2D model's decoders at the paper's size."""
    counts = []
    for numerics in ("standard", "reference"):
        config = config_lib.ModelConfig(latent=config_lib.TokenLatent(), numerics=numerics)
        shapes = world_model.WorldModel(config).variable_shapes()
        decoders = [shape for name, shape in shapes["params"].items() if name.startswith("decoders_")]
        counts.append(f"{sum(leaf.size for leaf in jax.tree.leaves(decoders)):,}")
    return counts[0], counts[1]


def rows() -> list[tuple[str, tuple[str, str]]]:
    """(what was measured, (here, reference))."""
    frame = town_frame()
    return [
        ("mean size of the prior's means after 6 imagined steps, fresh town model", leaky_slope()),
        ("change of the posterior's means with the mark of the state's tokens, 2D town model", posterior_memory()),
        ("parameters of the 2D decoders at the paper's size", decoder_parameters()),
        ("KL of random Gaussians, 6 frames", first_step_kl(6)),
        ("KL of random Gaussians, 12 frames", first_step_kl(12)),
        ("share of steps in which 8 windows toss the same coin", prior_dropout_coin()),
        ("L2 of xyz where everything is predicted at the origin, one town frame", masked_xyz(frame)),
        ("cross-entropy of p = 0.5 in seen free space, 0.9 elsewhere, one town frame", unknown_voxels(frame)),
        ("Chamfer (m) of a town frame to itself moved by 1 m", chamfer_of_pixels(frame)),
        ("distance along x (m) of a point to its pillar's centre, evenly spread points", pillar_offsets()),
        ("share of ray points inside the bird's-eye grid, paper size", lifted_share()),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=pathlib.Path, help="also write the table here")
    output = parser.parse_args().output
    lines = ["| measured | here | reference |", "|---|---:|---:|"]
    lines += [f"| {name} | {here} | {reference} |" for name, (here, reference) in rows()]
    text = "\n".join(lines) + "\n"
    print(text)
    if output:
        output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
