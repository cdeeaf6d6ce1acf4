"""Brightness, colour and sharpness of one image, float32 [H, W, 3] in [0, 1] in and out; jit and vmap them.

The definitions are those of torchvision, with which the reference varies its images. (dm-pix has no sharpening, and
its blur wants the width of the Gaussian before compilation.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from muvo_jax.ops import precision
from muvo_jax.types import Array

_LUMA = (0.2989, 0.587, 0.114)
_BLUR_PX = 5  # side of the window


def blur(image: Array, std_px: Array | float) -> Array:
    """A Gaussian over 5x5 pixels, borders mirrored."""
    rows, columns, _ = image.shape
    half = _BLUR_PX // 2
    offsets = jnp.arange(-half, half + 1, dtype=jnp.float32)
    weights = jax.nn.softmax(-0.5 * jnp.square(offsets / std_px))
    for axis, pixels in ((0, rows), (1, columns)):
        padded = jnp.pad(image, [(half, half) if side == axis else (0, 0) for side in range(3)], mode="reflect")
        shifted = [jax.lax.slice_in_dim(padded, shift, shift + pixels, axis=axis) for shift in range(_BLUR_PX)]
        image = jnp.tensordot(weights, jnp.stack(shifted), axes=1, precision=precision.PRODUCTS)
    return image


def sharpen(image: Array, factor: Array | float) -> Array:
    """Away from a smoothed image where factor > 1; the outermost pixels stay."""
    rows, columns, _ = image.shape
    weighted = 4.0 * image[1:-1, 1:-1]
    for row in range(3):
        for column in range(3):
            weighted += image[row:row + rows - 2, column:column + columns - 2]
    smooth = jnp.asarray(image).at[1:-1, 1:-1].set(weighted / 13.0)
    return _blend(image, smooth, factor)


def brightness(image: Array, factor: Array | float) -> Array:
    """Darker where factor < 1, brighter where it is above."""
    return _blend(image, jnp.zeros_like(image), factor)


def contrast(image: Array, factor: Array | float) -> Array:
    """Away from the mean grey of the image where factor > 1."""
    return _blend(image, jnp.broadcast_to(_grey(image).mean(), image.shape), factor)


def saturation(image: Array, factor: Array | float) -> Array:
    """Away from each pixel's own grey where factor > 1."""
    return _blend(image, _grey(image), factor)


def hue(image: Array, turn: Array | float) -> Array:
    """Turns all colours by a share of the colour circle; greys stay."""
    value, spread = image.max(axis=-1), image.max(axis=-1) - image.min(axis=-1)
    red, green, blue = jnp.moveaxis(image, -1, 0)
    safe = jnp.where(spread > 0.0, spread, 1.0)
    sector = jnp.where(value == red, (green - blue) / safe,
                       jnp.where(value == green, 2.0 + (blue - red) / safe, 4.0 + (red - green) / safe)) + 6.0 * turn
    channels = []
    for offset in (5.0, 3.0, 1.0):
        place = jnp.mod(offset + sector, 6.0)
        channels.append(value - spread * jnp.clip(jnp.minimum(place, 4.0 - place), 0.0, 1.0))
    return jnp.stack(channels, axis=-1)


def _grey(image: Array) -> Array:
    grey = jnp.dot(image, jnp.asarray(_LUMA, image.dtype), precision=precision.PRODUCTS)
    return jnp.broadcast_to(grey[..., None], image.shape)


def _blend(image: Array, other: Array, factor: Array | float) -> Array:
    return jnp.clip(other + factor * (image - other), 0.0, 1.0)
