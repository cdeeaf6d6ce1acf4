"""The town's streets: an irregular grid of junctions, the lanes between them and the turns through them.

A segment is a stretch of lane: straight between two junctions, or a curve through one. Every segment is sampled at
`SAMPLES` points of equal spacing, so that positions along any number of segments are looked up in one indexing step.
Traffic keeps right.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from muvo_jax.town import settings

ROAD_HALF_M = 5.5  # a lane of 3.5 m and a parking strip of 2 m on each side of the middle
LANE_OFFSET_M = 1.75
PARKING_OFFSET_M = 4.55
PAVEMENT_HALF_M = 8.0  # from the middle of the road to the far edge of the pavement
JUNCTION_M = 11.0  # lanes end this far from the middle of a junction
SAMPLES = 33


@dataclasses.dataclass(frozen=True)
class Streets:
    """Junctions, streets and lane segments, in the frame of the map (metres).

    Attributes:
      nodes_m: float64 [N, 2].
      edges: int [E, 2], streets between nodes.
      degree: int [N], streets at each node.
      points_m: float64 [S, SAMPLES, 2], lane segments.
      yaws_rad: float64 [S, SAMPLES], their directions.
      lengths_m: float64 [S].
      limits_mps: float64 [S], infinite on straight ones.
      junction: int [S], the node a segment crosses, -1 for lanes.
      end_node: int [S], the node a lane leads to (for turns the node they cross).
      successors: int [S, 4], -1 where there are fewer; successor_count: int [S].
    """

    nodes_m: np.ndarray
    edges: np.ndarray
    degree: np.ndarray
    points_m: np.ndarray
    yaws_rad: np.ndarray
    lengths_m: np.ndarray
    limits_mps: np.ndarray
    junction: np.ndarray
    end_node: np.ndarray
    successors: np.ndarray
    successor_count: np.ndarray

    @property
    def lanes(self) -> np.ndarray:
        """Indices of the straight segments."""
        return np.flatnonzero(self.junction < 0)


def make_streets(config: settings.TownConfig) -> Streets:
    """Builds the streets of a town from its seed."""
    rng = np.random.default_rng([config.seed, 1])
    nodes_m = _nodes(config, rng)
    edges = _edges(config, rng)
    degree = np.bincount(edges.ravel(), minlength=len(nodes_m))

    directed = np.concatenate([edges, edges[:, ::-1]])
    starts, ends = nodes_m[directed[:, 0]], nodes_m[directed[:, 1]]
    forward = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0]], 1)
    lane_starts = starts + forward * JUNCTION_M + right * LANE_OFFSET_M
    lane_ends = ends - forward * JUNCTION_M + right * LANE_OFFSET_M
    share = np.linspace(0, 1, SAMPLES)[None, :, None]
    curves = [lane_starts[:, None] * (1 - share) + lane_ends[:, None] * share]
    limits, junction = [np.inf] * len(directed), [-1] * len(directed)
    successors: list[list[int]] = [[] for _ in directed]
    for lane, (origin, node) in enumerate(directed):
        for onward in np.flatnonzero((directed[:, 0] == node) & (directed[:, 1] != origin)):
            turn_rad = np.arccos(np.clip(forward[lane] @ forward[onward], -1, 1))
            successors[lane].append(len(successors))
            successors.append([int(onward)])
            curves.append(_curve(lane_ends[lane], forward[lane], lane_starts[onward], forward[onward])[None])
            limits.append(np.inf if turn_rad < 0.5 else config.turn_mps)
            junction.append(int(node))
    points_m = np.concatenate(curves)
    steps = np.diff(points_m, axis=1)
    yaws = np.unwrap(np.arctan2(steps[..., 1], steps[..., 0]), axis=1)
    table = np.full((len(successors), 4), -1)
    for segment, following in enumerate(successors):
        table[segment, :len(following)] = following
    return Streets(nodes_m=nodes_m, edges=edges, degree=degree, points_m=points_m,
                   yaws_rad=np.concatenate([yaws, yaws[:, -1:]], axis=1),
                   lengths_m=np.linalg.norm(steps, axis=-1).sum(1), limits_mps=np.array(limits),
                   junction=np.array(junction),
                   end_node=np.concatenate([directed[:, 1], junction[len(directed):]]),
                   successors=table, successor_count=(table >= 0).sum(1))


def locate(streets: Streets, segment: np.ndarray, along_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns position [..., 2] and yaw [...] at `along_m` on each segment (both arguments of one shape)."""
    position = np.clip(along_m / streets.lengths_m[segment], 0, 1) * (SAMPLES - 1)
    low = np.minimum(position.astype(np.int64), SAMPLES - 2)
    share = position - low
    points_m = (streets.points_m[segment, low] * (1 - share)[..., None]
                + streets.points_m[segment, low + 1] * share[..., None])
    yaw_rad = streets.yaws_rad[segment, low] * (1 - share) + streets.yaws_rad[segment, low + 1] * share
    return points_m, yaw_rad


def _nodes(config: settings.TownConfig, rng: np.random.Generator) -> np.ndarray:
    axes = [np.cumsum(np.concatenate([[0], rng.uniform(*config.block_m, config.blocks)])) for _ in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return grid + rng.uniform(-5, 5, grid.shape)


def _edges(config: settings.TownConfig, rng: np.random.Generator) -> np.ndarray:
    """Neighbours in the grid, some streets left out such that no junction becomes a dead end or unreachable."""
    count = config.blocks + 1
    index = np.arange(count * count).reshape(count, count)
    across, along = (index[:-1].ravel(), index[1:].ravel()), (index[:, :-1].ravel(), index[:, 1:].ravel())
    edges = [tuple(pair) for pair in np.concatenate([np.stack(across, 1), np.stack(along, 1)]).tolist()]
    wanted = round(len(edges) * (1 - config.missing_streets))
    for street in [edges[index] for index in rng.permutation(len(edges))]:
        rest = [edge for edge in edges if edge != street]
        keeps_turns = np.bincount(np.ravel(rest), minlength=count * count).min() >= 2
        if len(edges) > wanted and keeps_turns and _connected(rest, count * count):
            edges = rest
    return np.array(edges)


def _connected(edges: list, count: int) -> bool:
    label = np.arange(count)
    for _ in range(count):
        for first, second in edges:
            label[first] = label[second] = min(label[first], label[second])
    return bool((label == 0).all())


def _curve(start: np.ndarray, start_direction: np.ndarray, end: np.ndarray, end_direction: np.ndarray) -> np.ndarray:
    """A cubic from one lane to the next, sampled evenly, [SAMPLES, 2]."""
    reach = 0.5 * np.linalg.norm(end - start)
    share = np.linspace(0, 1, 200)[:, None]
    rest = 1 - share
    dense = (rest**3 * start + 3 * rest**2 * share * (start + reach * start_direction)
             + 3 * rest * share**2 * (end - reach * end_direction) + share**3 * end)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    wanted = np.linspace(0, along[-1], SAMPLES)
    return np.stack([np.interp(wanted, along, dense[:, axis]) for axis in range(2)], 1)
