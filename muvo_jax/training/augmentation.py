"""Random changes of what the encoders see in training (the reference's, where its presets ask for them).

They happen inside the compiled step, on the observed part of a batch: targets come from the batch as it was recorded,
the host's cache keeps recorded frames, and no time is spent on the host. Everything follows from the key of a sample,
which depends on run, step and place in the batch alone; so a resumed run, and any number of devices, see the same.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.config import AugmentationConfig
from muvo_jax.ops import photometric

_SITE = 0xA06  # separates these draws from all others made with the same sample key


def augment(batch: types.Batch, keys: types.Array, settings: AugmentationConfig) -> types.Batch:
    """Another look at the same windows: images change frame by frame, the route map of a window as a whole.

    Args:
      batch: windows [B, T, ...]; a modality that it lacks is left out.
      keys: typed keys [B], one per window.
      settings: what to do, and how often.

    Returns:
      The batch with another `image` and `route_map`, of the same shapes and dtypes (images are rounded to 8 bits).
    """
    image_keys, route_keys = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, _SITE)), out_axes=1)(keys)
    if settings.image and batch.image is not None:
        frames = jnp.arange(batch.frames)
        frame_keys = jax.vmap(lambda key: jax.vmap(lambda frame: jax.random.fold_in(key, frame))(frames))(image_keys)
        change = jax.vmap(jax.vmap(lambda key, image: augment_image(key, image, settings)))
        batch = dataclasses.replace(batch, image=change(frame_keys, jnp.asarray(batch.image)))
    if settings.route and batch.route_map is not None:
        change = jax.vmap(lambda key, maps: augment_route(key, maps, settings))
        batch = dataclasses.replace(batch, route_map=change(route_keys, jnp.asarray(batch.route_map)))
    return batch


def augment_image(key: types.Array, image: types.Array, settings: AugmentationConfig) -> types.Array:
    """uint8 [H, W, 3] -> the same, blurred or sharpened, and with other colours, each with its probability."""
    key_filter, key_std, key_factor, key_coin, key_colour = jax.random.split(key, 5)
    share = jax.random.uniform(key_filter, (), jnp.float32)
    original = image.astype(jnp.float32) / 255.0
    blurred = photometric.blur(original, jax.random.uniform(key_std, (), jnp.float32, minval=settings.blur_std_px[0],
                                                            maxval=settings.blur_std_px[1]))
    low, high = settings.sharpen_factor
    sharpened = photometric.sharpen(original, jax.random.uniform(key_factor, (), jnp.float32, minval=low, maxval=high))
    filtered = jnp.where(share < settings.blur, blurred,
                         jnp.where(share < settings.blur + settings.sharpen, sharpened, original))
    coloured = _other_colours(key_colour, filtered, settings)
    changed = jnp.where(jax.random.bernoulli(key_coin, settings.colour), coloured, filtered)
    return jnp.round(255.0 * changed).astype(jnp.uint8)


def _other_colours(key: types.Array, image: types.Array, settings: AugmentationConfig) -> types.Array:
    """Brightness, contrast, saturation and hue, one after the other in an order that is drawn too."""
    key_order, key_amount = jax.random.split(key)
    most = jnp.asarray([settings.brightness, settings.contrast, settings.saturation, settings.hue], jnp.float32)
    amount = most * jax.random.uniform(key_amount, (4,), jnp.float32, minval=-1.0)
    changes = (lambda value: photometric.brightness(value, 1.0 + amount[0]),
               lambda value: photometric.contrast(value, 1.0 + amount[1]),
               lambda value: photometric.saturation(value, 1.0 + amount[2]),
               lambda value: photometric.hue(value, amount[3]))
    step = lambda value, which: (jax.lax.switch(which, changes, value), None)
    changed, _ = jax.lax.scan(step, image, jax.random.permutation(key_order, 4))
    return changed


def augment_route(key: types.Array, maps: types.Array, settings: AugmentationConfig) -> types.Array:
    """uint8 [T, S, S], the route maps of one window -> all of them blank, shortened or moved alike, or as they were."""
    key_kind, key_rows, key_small, key_large = jax.random.split(key, 4)
    limits = jnp.cumsum(jnp.asarray([settings.route_drop, settings.route_truncate, settings.route_affine_small,
                                     settings.route_affine_large], jnp.float32))
    kind = jnp.searchsorted(limits, jax.random.uniform(key_kind, (), jnp.float32), side="right")
    side = maps.shape[-1]
    near = jnp.arange(side) >= jax.random.randint(key_rows, (), 0, side)
    truncated = jnp.where(near[None, :, None], maps, 0)
    moved = [affine(maps, **_random_affine(key, degrees, side, settings))
             for key, degrees in ((key_small, settings.route_rotation_deg), (key_large, 180.0))]
    return jnp.select([kind == index for index in range(4)], [jnp.zeros_like(maps), truncated, *moved], maps)


def _random_affine(key: types.Array, degrees: float, side: int, settings: AugmentationConfig) -> dict:
    key_angle, key_shift, key_scale = jax.random.split(key, 3)
    most_px = settings.route_translation * side
    return {"angle_rad": jnp.deg2rad(jax.random.uniform(key_angle, (), jnp.float32, minval=-degrees, maxval=degrees)),
            "shift_px": jnp.round(jax.random.uniform(key_shift, (2,), jnp.float32, minval=-most_px, maxval=most_px)),
            "scale": jax.random.uniform(key_scale, (), jnp.float32, minval=settings.route_scale[0],
                                        maxval=settings.route_scale[1]),
            "shear_rad": jnp.deg2rad(jnp.float32(settings.route_shear_deg))}


def affine(maps: types.Array, angle_rad: types.Array, shift_px: types.Array, scale: types.Array,
           shear_rad: types.Array) -> types.Array:
    """Shears, turns clockwise and scales square maps [T, S, S] about their centre, then shifts them; nearest pixel.

    Args:
      angle_rad, scale, shear_rad: scalars.
      shift_px: [2], to the right and down.
    """
    side = maps.shape[-1]
    cosine, sine = jnp.cos(angle_rad), jnp.sin(angle_rad)
    centre = jnp.arange(side, dtype=jnp.float32) + 0.5 - side / 2
    right, down = centre[None, :] - shift_px[0], centre[:, None] - shift_px[1]
    # Backwards: out of the turn and the scale, then out of the shear, which moved what lies below to the left.
    x, y = (cosine * right + sine * down) / scale, (cosine * down - sine * right) / scale
    x = x + jnp.tan(shear_rad) * y
    column, row = (jnp.floor(value + side / 2).astype(jnp.int32) for value in (x, y))
    inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
    picked = maps[:, jnp.clip(row, 0, side - 1), jnp.clip(column, 0, side - 1)]
    return jnp.where(inside[None], picked, 0)
