"""The line that a route map shows: followed once for a map, then asked for places along it and distances from it.

A map says where the route runs, not which way. The car does: it stands on the route and looks along it, so what the map
shows before the car is the way ahead, and what it shows behind is the way back.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax.config import RouteMap
from muvo_jax.types import Array, ArrayLike

PAINTED = 127  # a route map's pixels above this lie on the route
POINTS_AHEAD, POINTS_BEHIND = 64, 24
FARTHEST_M = 1e3
_STRIDE_PX = 1.5  # from point to point
_RING_PX = 2.5  # the next point is sought among the pixels at about this distance
_CONE = 0.5  # cosine of the largest bend from point to point


@flax.struct.dataclass
class Route:
    """The middle of a painted line in the ego frame in which its map was drawn, from behind the car to far ahead.

    Attributes:
      points_m: float32 [..., K, 2].
      along_m: float32 [..., K], metres along the line; 0 where it is nearest to the car, negative behind.
      known: bool [..., K], whether the line reaches as far.
    """

    points_m: Array
    along_m: Array
    known: Array


def follow(route_map: Array, scale: RouteMap) -> Route:
    """Follows the line of a map [64, 64] forwards and backwards from the car, whose heading says which way is which.

    Where the line crosses itself it goes straight on. Nothing is `known` of a map that shows no route.
    """
    height, width = route_map.shape
    painted = route_map > PAINTED
    x = jnp.broadcast_to((scale.ego_row - (jnp.arange(height, dtype=jnp.float32) + 0.5))[:, None], (height, width))
    y = jnp.broadcast_to((scale.ego_column - (jnp.arange(width, dtype=jnp.float32) + 0.5))[None], (height, width))
    distance = jnp.where(painted, jnp.hypot(x, y), jnp.inf)
    nearest = jnp.argmin(distance)
    near = painted & (jnp.hypot(x - x.ravel()[nearest], y - y.ravel()[nearest]) <= 1.5)
    mean = lambda value: jnp.where(near, value, 0.0).sum() / jnp.maximum(near.sum(), 1)
    start, any_route = jnp.stack([mean(x), mean(y)]), painted.any()

    def walk(forward, count):
        def step(carry, index):
            point, direction, known = carry
            offset_x, offset_y = x - point[0], y - point[1]
            radius = jnp.sqrt(offset_x**2 + offset_y**2 + 1e-6)
            cosine = (offset_x * direction[0] + offset_y * direction[1]) / radius
            # The first stretch may leave in any direction before the car.
            weight = jnp.where(painted & (cosine > jnp.where(index == 0, 0.0, _CONE)),
                               jnp.exp(-((radius - _RING_PX) ** 2)), 0.0)
            aim = jnp.stack([(weight * offset_x).sum(), (weight * offset_y).sum()])
            known = known & (weight.sum() > 0.5)
            direction = jnp.where(known, aim / jnp.maximum(jnp.linalg.norm(aim), 1e-6), direction)
            point = jnp.where(known, point + _STRIDE_PX * direction, point)
            return (point, direction, known), (point, known)

        return jax.lax.scan(step, (start, jnp.array([forward, 0.0], jnp.float32), any_route), jnp.arange(count))[1]

    ahead, ahead_known = walk(1.0, POINTS_AHEAD)
    behind, behind_known = walk(-1.0, POINTS_BEHIND)
    points = jnp.concatenate([behind[::-1], start[None], ahead])
    along = _STRIDE_PX * jnp.arange(-POINTS_BEHIND, POINTS_AHEAD + 1, dtype=jnp.float32)
    return Route(points * scale.metres_per_px, along * scale.metres_per_px,
                 jnp.concatenate([behind_known[::-1], any_route[None], ahead_known]))


def place(route: Route, pose: Array) -> tuple[Array, Array]:
    """(metres along the route of the nearest place on it, distance from it) of cars at pose [..., 3].

    The route's leading axes broadcast against the pose's. Both differentiable almost everywhere; without a route 0 and
    FARTHEST_M.
    """
    extra = pose.ndim - 1 - (route.along_m.ndim - 1)
    points, metres, reached = (leaf.reshape((1,) * extra + leaf.shape)
                               for leaf in (route.points_m, route.along_m, route.known))
    first, second = points[..., :-1, :], points[..., 1:, :]
    line = second - first
    offset = jnp.expand_dims(pose[..., :2], -2) - first
    share = jnp.clip((offset * line).sum(-1) / jnp.maximum((line**2).sum(-1), 1e-6), 0.0, 1.0)
    away = offset - jnp.expand_dims(share, -1) * line
    square = jnp.where(reached[..., :-1] & reached[..., 1:], (away**2).sum(-1), FARTHEST_M**2)
    along = metres[..., :-1] + share * (metres[..., 1:] - metres[..., :-1])
    nearest = jnp.argmin(square, axis=-1, keepdims=True)
    pick = lambda value: jnp.take_along_axis(value, nearest, axis=-1)[..., 0]
    return jnp.where(reached.any(axis=-1), pick(along), 0.0), jnp.sqrt(pick(square) + 1e-6)


def ahead(route: Route, pose: Array, distances_m: ArrayLike) -> Array:
    """Poses [D, 3] on a route (without leading axes), so many metres on from the place nearest to a car at pose [3].

    Where the line is known no farther, its last known place; without a route the car's own frame's origin.
    """
    along, _ = place(route, pose)
    some = route.known.any()
    low = jnp.where(some, jnp.where(route.known, route.along_m, jnp.inf).min(), 0.0)
    high = jnp.where(some, jnp.where(route.known, route.along_m, -jnp.inf).max(), 0.0)
    spacing = route.along_m[1] - route.along_m[0]
    spot = (jnp.clip(along + jnp.asarray(distances_m), low, high) - route.along_m[0]) / spacing
    first = jnp.clip(jnp.floor(spot), 0, route.along_m.shape[0] - 2).astype(jnp.int32)
    line = route.points_m[first + 1] - route.points_m[first]
    # The last known point of the line may be followed by copies of itself: a heading needs two that differ.
    back = route.points_m[first] - route.points_m[jnp.maximum(first - 1, 0)]
    towards = jnp.where((line**2).sum(-1, keepdims=True) > 1e-6, line, back)
    heading = jnp.arctan2(towards[:, 1], jnp.where((towards**2).sum(-1) > 1e-6, towards[:, 0], 1.0))
    return jnp.concatenate([route.points_m[first] + (spot - first)[:, None] * line, heading[:, None]], axis=-1)


def straight() -> Route:
    """The route of a car without one: straight on along the heading of its start."""
    along = jnp.arange(-POINTS_BEHIND, POINTS_AHEAD + 1, dtype=jnp.float32)
    return Route(jnp.stack([along, jnp.zeros_like(along)], axis=-1), along, jnp.ones(along.shape, jnp.bool_))
