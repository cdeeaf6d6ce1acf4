"""How training varies what the encoders see; re-exported by muvo_jax.config."""

from __future__ import annotations

import dataclasses


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
    blur: float = 0.3
    sharpen: float = 0.3
    blur_std_px: tuple[float, float] = (0.1, 1.7)
    sharpen_factor: tuple[float, float] = (1.0, 5.0)
    colour: float = 0.3
    brightness: float = 0.3
    contrast: float = 0.3
    saturation: float = 0.3
    hue: float = 0.1
    route_drop: float = 0.025
    route_truncate: float = 0.025
    route_affine_small: float = 0.025
    route_affine_large: float = 0.025
    route_rotation_deg: float = 8.0
    route_translation: float = 0.1
    route_scale: tuple[float, float] = (0.95, 1.05)
    route_shear_deg: float = 0.1

    def __post_init__(self):
        for names in (("blur", "sharpen"), ("colour",),
                      ("route_drop", "route_truncate", "route_affine_small", "route_affine_large")):
            shares = [getattr(self, name) for name in names]
            if min(shares) < 0.0 or sum(shares) > 1.0:
                raise ValueError(f"augmentation: {' + '.join(names)} = {' + '.join(f'{share:g}' for share in shares)}; "
                                 f"probabilities lie between 0 and 1, together too.")
        for name, most in (("brightness", 1.0), ("contrast", 1.0), ("saturation", 1.0), ("hue", 0.5)):
            if not 0.0 <= getattr(self, name) <= most:
                raise ValueError(f"augmentation.{name} is {getattr(self, name):g}; it must lie between 0 and {most:g}.")
        for name in ("blur_std_px", "sharpen_factor", "route_scale"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"augmentation.{name} is {low:g} to {high:g}; expected 0 < lowest <= highest.")
