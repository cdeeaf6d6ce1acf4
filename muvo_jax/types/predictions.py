"""What a model says: decoded heads at their scales."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import flax.struct

from muvo_jax.types.arrays import Array


@flax.struct.dataclass
class Predictions:
    """What `decode` returns: for each decoded head an array [..., *size / scale, channels] at one scale or several.

    `predictions.image` is the full size, `predictions.at_scale(2).image` half of it along every spatial axis. A head
    whose name Python keeps for itself, and one whose name is in a variable, is read with brackets:
    `predictions["continue"]`. Brackets take names only; `jax.tree.map(lambda leaf: leaf[:, 0], predictions)` indexes
    all arrays.

    Attributes:
      arrays: head -> scale (1, 2, 4; 1 is full size) -> float32 [..., *size / scale, channels].
      scale: the one that attributes and brackets read.
    """

    arrays: Mapping[str, Mapping[int, Array]]
    scale: int = flax.struct.field(pytree_node=False, default=1)

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads that have this scale."""
        return tuple(head for head, scales in self.arrays.items() if self.scale in scales)

    def scales(self, head: str) -> Mapping[int, Array]:
        """{scale: array} of a head.

        Raises:
          KeyError: if it was not decoded; names what was.
        """
        if head not in self.arrays:
            raise KeyError(f"the head {head!r} was not decoded; these were: {', '.join(self.arrays) or 'none'}.")
        return self.arrays[head]

    def at_scale(self, scale: int) -> Predictions:
        """The same predictions, read at 1 / scale of the size.

        Raises:
          ValueError: if no head has that scale; names those that there are.
        """
        found = sorted({found for scales in self.arrays.values() for found in scales})
        if scale not in found:
            raise ValueError(f"no decoded head has the scale {scale}; there are {', '.join(map(str, found))}.")
        return dataclasses.replace(self, scale=scale)

    def __getitem__(self, head: str) -> Array:
        if not isinstance(head, str):
            raise TypeError(f"predictions[{head!r}]: brackets take the name of a head, such as 'image'; to index all "
                            f"arrays use jax.tree.map(lambda leaf: leaf[index], predictions).")
        scales = self.scales(head)
        if self.scale not in scales:
            raise KeyError(f"the head {head!r} has no scale {self.scale}; it has {', '.join(map(str, scales))}.")
        return scales[self.scale]

    def __getattr__(self, name: str) -> Array:
        if name.startswith("_") or name == "arrays":  # asked for by copying and pickling, before the fields are there
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(f"Predictions.{name}: {error.args[0]}") from None

    def __contains__(self, head: object) -> bool:
        return head in self.heads

    def __iter__(self) -> Iterator[str]:
        return iter(self.heads)

    def __or__(self, other: Predictions) -> Predictions:
        """The heads of both."""
        return dataclasses.replace(self, arrays={**self.arrays, **other.arrays})
