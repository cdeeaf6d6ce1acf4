"""How training varies what the encoders see; re-exported by muvo_jax.config."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from muvo_jax.limits import SHARE, above, between, check


@dataclasses.dataclass(frozen=True)
class AugmentationConfig:
    """Random changes of training windows: of the model's inputs, never of a target, but for `mirror`.

    The numbers are the reference's, which has no mirror.

    Attributes:
      image, route: whether images and route maps are changed at all.
      light: put every second window as a whole, inputs and targets, in another light (training/light.py).
      mirror: exchange left and right of every second window, drawn anew each time: in all of its fields, inputs,
        actions and targets alike. For sensors that are symmetric about the middle of the car and look ahead.
      blur, sharpen: probability that a frame is blurred, or else sharpened.
      blur_std_px: of the Gaussian, over a window of 5 pixels.
      sharpen_factor: 0 is a smoothed image, 1 the image itself.
      colour: probability that the colours of a frame are changed, all four in an order drawn anew.
      brightness, contrast, saturation: factors lie within 1 +- this.
      hue: turned by at most this share of the colour circle.
      route_drop, route_truncate, route_affine_small, route_affine_large: probability that the route of a window is
        blank, ends early (its farthest rows are blank), or is moved a little, or turned anywhere.
      route_rotation_deg: of the small affine change, at most; the large one turns by any angle.
      route_translation: of both, at most, as a share of the map's side.
      route_scale: of both.
      route_shear_deg: of both, always (the reference gives its range as one number twice).
    """

    image: bool = False
    route: bool = False
    mirror: bool = False
    light: bool = False
    blur: Annotated[float, SHARE] = 0.3
    sharpen: Annotated[float, SHARE] = 0.3
    blur_std_px: Annotated[tuple[float, float], above(0, unit="px")] = (0.1, 1.7)
    sharpen_factor: Annotated[tuple[float, float], above(0)] = (1.0, 5.0)
    colour: Annotated[float, SHARE] = 0.3
    brightness: Annotated[float, SHARE] = 0.3
    contrast: Annotated[float, SHARE] = 0.3
    saturation: Annotated[float, SHARE] = 0.3
    hue: Annotated[float, between(0, 0.5)] = 0.1
    route_drop: Annotated[float, SHARE] = 0.025
    route_truncate: Annotated[float, SHARE] = 0.025
    route_affine_small: Annotated[float, SHARE] = 0.025
    route_affine_large: Annotated[float, SHARE] = 0.025
    route_rotation_deg: Annotated[float, between(0, 180, "degrees")] = 8.0
    route_translation: Annotated[float, SHARE] = 0.1
    route_scale: Annotated[tuple[float, float], above(0)] = (0.95, 1.05)
    route_shear_deg: Annotated[float, between(-45, 45, "degrees")] = 0.1

    def __post_init__(self):
        check(self)
        for names in (("blur", "sharpen"),
                      ("route_drop", "route_truncate", "route_affine_small", "route_affine_large")):
            shares = [getattr(self, name) for name in names]
            if sum(shares) > 1.0:
                raise ValueError(f"augmentation: {' + '.join(names)} = {' + '.join(f'{share:g}' for share in shares)}; "
                                 f"probabilities lie between 0 and 1, together too.")
        for name in ("blur_std_px", "sharpen_factor", "route_scale"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"augmentation.{name} is {low:g} to {high:g}; expected lowest <= highest.")
