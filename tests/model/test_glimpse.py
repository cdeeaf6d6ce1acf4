"""How the memory looks: what moves goes on moving, and returns that lie off their beams stay where they were."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import head, presets
from muvo_jax.heads import image as image_head
from muvo_jax.heads import range_view as range_view_head
from muvo_jax.model import glimpse, memory, world_model
from muvo_jax.ops import range_view, reproject
from muvo_jax.types import Memory, Motion, Vantage

GRID = config_lib.VoxelGrid(shape=(32, 32, 8), voxel_size_m=1.0, origin_m=(-16.0, -16.0, -1.5))
VIEW = config_lib.RangeViewGeometry(rows=64, columns=256, elevation_min_rad=-0.5, elevation_max_rad=0.2,
                                    position_m=(0.0, 0.0, 2.0))
FRAMES = 5
TINY = presets.tiny().model
CONFIG = dataclasses.replace(TINY, heads=("range_view", "occupancy"), voxels=GRID, range_view=VIEW,
                             latent=dataclasses.replace(TINY.latent, occupancy_blocks=0),
                             first_guess=config_lib.LastSeen(memory_frames=FRAMES, follow_movers=True))
look = jax.jit(glimpse.look, static_argnums=(0, 4))


def scan(car_x_m, car_y_m):
    """A lidar's view [Hr, Wr, 4] of a flat road, a wall 40 m all around, and a car of 4 m x 2 m x 1.4 m."""
    beams, lidar_m = range_view.beam_directions(VIEW).astype(np.float64), np.float64(VIEW.position_m)
    flat = np.linalg.norm(beams[..., :2], axis=-1)
    road_m = np.where(beams[..., 2] < -1e-3, -lidar_m[2] / np.minimum(beams[..., 2], -1e-3), np.inf)
    range_m = np.minimum(40.0 / flat, road_m)
    low, size = np.float64([car_x_m - 2.0, car_y_m - 1.0, 0.1]) - lidar_m, np.float64([4.0, 2.0, 1.4])
    with np.errstate(divide="ignore"):
        sides = np.sort([low / beams, (low + size) / beams], axis=0)
    enter, leave = sides[0].max(axis=-1), sides[1].min(axis=-1)
    range_m = np.where((enter < leave) & (enter > 0.0), np.minimum(enter, range_m), range_m)
    return np.concatenate([beams * range_m[..., None] + lidar_m, range_m[..., None]], axis=-1).astype(np.float32)


def memory_of(car_m, speed_cells):
    """Two drives that stand still: past one a car drives, past the other it is parked."""
    times = np.arange(1 - FRAMES, 1)
    drives = [[scan(car_m[0] + speed * step, car_m[1]) for step in times] for speed in (speed_cells, 0.0)]
    return Memory(jnp.zeros((2, FRAMES, 3)), jnp.asarray(np.stack([np.stack(drive) for drive in drives])))


def vantage_of(steps):
    zeros = jnp.zeros((2,), jnp.int32)
    return Vantage(Motion(jnp.zeros((2, 3)), jnp.zeros((2,))), zeros, zeros + FRAMES - 1, zeros + steps)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_car_that_moved_goes_on_and_a_parked_one_stays(steps):
    car_m, speed = (2.0, 6.0), 2.0
    seen = memory_of(car_m, speed)
    voxels = look(CONFIG, seen, jnp.arange(2), vantage_of(steps), ("occupancy",))[0]["occupancy"]
    moving, parked = np.asarray(voxels.onward)
    assert not parked.any()
    assert moving.sum() >= 4  # its sides that the lidar saw
    x, y, _ = (np.argwhere(moving > 0.0) + 0.5).T * GRID.voxel_size_m + np.reshape(GRID.origin_m, (3, 1))[..., :]
    ahead_m = car_m[0] + speed * steps * GRID.voxel_size_m
    assert (np.abs(x - ahead_m) <= 3.0).all() and (np.abs(y - car_m[1]) <= 1.5).all()
    assert np.asarray(voxels.newest)[:, 16:20, 21:22].max() == 1.0  # where it was, it is shown too


@pytest.mark.parametrize("steps", [2, glimpse.FORESEEN_STEPS + 1])
def test_evidence_worked_out_once_shows_the_same(steps):
    seen, vantage = memory_of((-2.0, 5.0), 1.0), vantage_of(steps)
    ready = jax.jit(glimpse.with_evidence, static_argnums=0)(CONFIG, seen, vantage_of(0))
    direct, once = (look(CONFIG, some, jnp.arange(2), vantage, ("occupancy",))[0]["occupancy"]
                    for some in (seen, ready))
    for name in ("newest", "older"):
        np.testing.assert_allclose(getattr(once, name), getattr(direct, name), atol=1e-4, err_msg=name)
    if steps <= glimpse.FORESEEN_STEPS:
        assert direct.onward.any()
        np.testing.assert_allclose(once.onward, direct.onward, atol=1e-4)
    else:
        assert not once.onward.any()  # too far ahead to say


def test_variables_and_evidence_are_float32_where_jax_counts_in_float64():
    config = dataclasses.replace(CONFIG, action_path="recurrence", kinematics=config_lib.Kinematics(),
                                 range_scale_m=49.0)  # whose shapes nobody has asked for
    narrow = lambda tree: {leaf.dtype.itemsize for leaf in jax.tree.leaves(tree)} <= {1, 2, 4}
    seen = jax.eval_shape(lambda: (memory_of((2.0, 6.0), 1.0), vantage_of(0)))
    with jax.enable_x64(True):
        shapes = world_model.WorldModel(config).variable_shapes()
        assert {"transition", "first_guess_range_view"} <= shapes["batch_stats"].keys() and narrow(shapes)
        assert narrow(jax.eval_shape(lambda seen, vantage: glimpse.with_evidence(config, seen, vantage), *seen))


def test_returns_in_the_middle_of_pixels_are_told_from_returns_anywhere():
    middle = scan(5.0, 3.0)
    turned = middle[..., :2] @ np.float32([[0.9999, 0.0123], [-0.0123, 0.9999]])  # by half a column
    anywhere = np.concatenate([turned, middle[..., 2:]], axis=-1)
    found = reproject.lies_on_beams(jnp.stack([jnp.asarray(middle), jnp.asarray(anywhere)]), VIEW)
    assert found.tolist() == [True, False]


def test_returns_off_their_beams_are_shown_where_they_were():
    """A real lidar's, of which a pixel holds one of several."""
    random = np.random.default_rng(0)
    points_m = scan(5.0, 3.0)[..., :3].reshape(-1, 3) + random.uniform(-0.2, 0.2, (VIEW.rows * VIEW.columns, 3))
    stored = range_view.project(points_m.astype(np.float32), VIEW)
    seen = Memory(jnp.zeros((2, FRAMES, 3)), jnp.asarray(np.broadcast_to(stored, (2, FRAMES, *stored.shape))))
    view = look(CONFIG, seen, jnp.arange(2), vantage_of(1), ("range_view",))[0]["range_view"]
    inner = slice(1, -1)  # the reader puts what lies above or below the field of view into the edge rows
    shown = np.asarray(reproject.beam_points(view.moved_m, VIEW) + view.off_beam_m)[0, inner]
    returned = stored[inner, :, 3] > 0.0
    np.testing.assert_allclose(shown[returned], stored[inner, :, :3][returned], atol=1e-3)
    assert np.abs(np.asarray(view.off_beam_m)[0, inner][returned]).max() > 0.1


def test_too_few_remembered_frames_to_tell_what_moves_are_refused():
    with pytest.raises(ValueError, match="memory_frames is 3; set it to 4 or more"):
        config_lib.LastSeen(memory_frames=3, follow_movers=True)
    assert memory.guessed_heads(CONFIG) == ("range_view", "occupancy")


def test_points_off_their_beams_are_decoded_where_they_came_to():
    """With nothing drawn: the point of the beam at the moved range, and what the return lay beside it."""
    shape = (1, VIEW.rows, VIEW.columns)
    ranges_m = jnp.full(shape, 12.0)
    beside_m = jnp.full((*shape, 3), 0.3).at[:, ::2].set(0.0)
    seen = glimpse.RangeGlimpse(moved_m=ranges_m, newest_m=ranges_m, still_m=ranges_m, filled_m=ranges_m,
                                sky=jnp.zeros(shape), height_m=jnp.zeros(shape), off_beam_m=beside_m)
    drawn = {scale: jnp.zeros((1, VIEW.rows // scale, VIEW.columns // scale, 5)) for scale in head.SCALES}
    config = dataclasses.replace(CONFIG, range_view_points="beams")
    composed = range_view_head.HEAD.guide.compose(drawn, seen, lambda outputs: outputs, config)
    for scale, value in composed.items():
        points_m = range_view_head.HEAD.finish(value, scale, config)
        want = (reproject.beam_points(ranges_m, VIEW) + beside_m)[:, ::scale, ::scale]
        np.testing.assert_allclose(points_m[..., :3], want, atol=1e-3)
        np.testing.assert_allclose(points_m[..., 3], 12.0, rtol=1e-5)


def test_what_comes_into_view_is_guessed_in_the_light_of_what_was_seen():
    """At night: a pixel that was seen stays, one beyond the edge is half the edge and half the darkened average."""
    average, night = 0.5, 0.1
    covered = jnp.array([1.0, glimpse.EDGE]).reshape(1, 1, 2, 1)
    covered = jnp.tile(covered, (1, 4, 2, 1))
    seen = glimpse.ImageGlimpse(image=night * jnp.tile(covered, (1, 1, 1, 3)), covered=covered,
                                colour=jnp.full((1, 1, 1, 3), night))
    nothing = glimpse.ImageGlimpse(*(jnp.zeros_like(leaf) for leaf in (seen.image, covered, seen.colour)))
    drawn = {scale: jnp.zeros((1, 4 // scale, 4 // scale, 3)) for scale in head.SCALES}
    usual = lambda outputs: jax.tree.map(lambda leaf: leaf + average, outputs)
    compose = lambda one: image_head.HEAD.guide.compose(drawn, one, usual, CONFIG)
    for scale in head.SCALES:
        np.testing.assert_allclose(compose(seen)[scale], night, atol=1e-6)  # nowhere daylight
        np.testing.assert_allclose(compose(nothing)[scale], average, atol=1e-6)
