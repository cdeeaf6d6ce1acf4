"""A mirrored window is the window of the mirrored world: every field against the geometry that makes it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.data import ego_motion
from muvo_jax.ops import motion as motion_ops
from muvo_jax.ops import range_view, voxels
from muvo_jax.town import renderer
from muvo_jax.training import mirror
from muvo_jax.training import step as step_lib

OTHER_SIDE = np.array([1.0, -1.0, 1.0], np.float32)
SHAPES = {"image": (8, 12, 3), "range_view": (4, 8, 4), "points": (5, 3), "occupancy": (4, 6, 2),
          "occupancy_moving_mask": (4, 6, 2), "route_map": (64, 64), "depth_m": (8, 12), "image_classes": (8, 12),
          "image_instance_mask": (8, 12), "image_moving_mask": (8, 12), "range_view_classes": (4, 8),
          "birds_eye_classes": (4, 6), "birds_eye_instances": (4, 6), "action": (2,), "target_m": (2,),
          "next_target_m": (2,), "ego_motion": (4,)}


def full_batch(seed=0, windows=2):
    """Every field there is, of random values."""
    random = np.random.default_rng(seed)
    fields = {}
    for name, (dtype, _) in types.BATCH_FIELDS.items():
        shape = (windows, 3, *SHAPES.get(name, ()))
        if name in types.UNTIMED_FIELDS:
            shape = (windows, 3, 3) if name == "intrinsics" else (windows, 4, 4)
        values = random.normal(size=shape) if dtype == np.float32 else random.integers(0, 2, shape)
        fields[name] = values.astype(dtype)
    fields["command"] = random.integers(0, 6, (windows, 3)).astype(np.int32)
    return types.Batch(**fields).validate()


def batch_of(**fields):
    frames = {"action": np.zeros((1, 1, 2), np.float32), "is_first": np.ones((1, 1), bool)}
    return types.Batch(**frames | {name: value[None, None] for name, value in fields.items()})


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_twice_mirrored_is_as_it_was_and_every_field_but_the_plain_ones_changes(seed):
    batch = full_batch(seed)
    once = mirror.mirrored(batch).validate()
    twice = mirror.mirrored(once)
    for name in types.BATCH_FIELDS:
        np.testing.assert_allclose(getattr(twice, name), getattr(batch, name), rtol=1e-6, atol=2e-6, err_msg=name)
    same = {name for name in types.BATCH_FIELDS if np.array_equal(getattr(once, name), getattr(batch, name))}
    assert same <= {"is_first", "speed_mps", "reward", "is_terminal", "point_count", "next_command"}


def test_mirrored_points_give_the_mirrored_range_view_and_occupancy():
    points_m = np.random.default_rng(0).normal(0.0, 8.0, (3000, 3)).astype(np.float32)
    lidar = config_lib.RangeViewGeometry(rows=32, columns=64, position_m=(1.0, 0.0, 2.0))
    grid = config_lib.VoxelGrid((16, 16, 16), 1.0, (-8.0, -8.0, -4.0))
    winner = range_view.nearest_points(points_m, lidar)
    classes = np.append(np.arange(len(points_m)) % 7, 255).astype(np.uint8)
    batch = batch_of(points=points_m, range_view=range_view.project(points_m, lidar),
                     range_view_classes=classes[winner], occupancy=voxels.voxelize(points_m, grid))
    seen = mirror.mirrored(batch)
    other_m = np.asarray(seen.points[0, 0])
    np.testing.assert_array_equal(other_m, points_m * OTHER_SIDE)
    np.testing.assert_allclose(seen.range_view[0, 0], range_view.project(other_m, lidar), atol=1e-6)
    np.testing.assert_array_equal(seen.range_view_classes[0, 0], classes[range_view.nearest_points(other_m, lidar)])
    np.testing.assert_array_equal(seen.occupancy[0, 0], voxels.voxelize(other_m, grid))


def test_mirrored_points_fall_into_the_mirrored_picture():
    random = np.random.default_rng(1)
    height_px, width_px = 40, 64
    intrinsics = np.array([[50.0, 3.0, 30.0], [0.0, 48.0, 21.0], [0.0, 0.0, 1.0]], np.float32)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    ahead = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ (np.eye(3) + 0.05 * (turn - turn.T))
    camera_to_ego = np.eye(4, dtype=np.float32)
    camera_to_ego[:3, :3], camera_to_ego[:3, 3] = ahead, (1.5, 0.3, 1.6)
    points_m = random.uniform((8.0, -4.0, 0.0), (20.0, 4.0, 3.0), (200, 3)).astype(np.float32)
    picture = np.zeros((height_px, width_px, 3), np.uint8)
    seen = mirror.mirrored(dataclasses.replace(batch_of(image=picture), intrinsics=intrinsics[None],
                                               camera_to_ego=camera_to_ego[None]))

    def project(points_m, intrinsics, camera_to_ego):
        in_camera = np.linalg.inv(camera_to_ego) @ np.append(points_m, np.ones((len(points_m), 1)), axis=1).T
        image = intrinsics @ in_camera[:3]
        return image[0] / image[2], image[1] / image[2]

    column, row = project(points_m, intrinsics, camera_to_ego)
    other_column, other_row = project(points_m * OTHER_SIDE, np.asarray(seen.intrinsics[0]),
                                      np.asarray(seen.camera_to_ego[0]))
    np.testing.assert_allclose(other_column, width_px - column, atol=1e-3)
    np.testing.assert_allclose(other_row, row, atol=1e-3)
    rotation = np.asarray(seen.camera_to_ego[0, :3, :3])
    assert np.linalg.det(rotation) * np.linalg.det(camera_to_ego[:3, :3]) > 0  # a camera, not its mirror image


def test_the_mirrored_way_is_drawn_where_the_flip_puts_it():
    way_m = np.stack([np.linspace(-10.0, 40.0, 60), 0.02 * np.linspace(-10.0, 40.0, 60) ** 2 + 0.1], axis=1)
    still = np.zeros(3)
    seen = mirror.mirrored(batch_of(route_map=renderer.draw_route(way_m, still)))
    np.testing.assert_array_equal(seen.route_map[0, 0], renderer.draw_route(way_m * OTHER_SIDE[:2], still))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), speed_mps=st.floats(0.0, 20.0))
def test_mirrored_actions_drive_the_mirrored_path(seed, speed_mps):
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (1, 6, 2)).astype(np.float32)
    other = mirror.mirrored(types.Batch(action=actions, is_first=np.zeros((1, 6), bool))).action
    start, contract = motion_ops.at_rest_of_frame(jnp.float32(speed_mps)), config_lib.ActionContract()
    own_path = motion_ops.path(start, jnp.asarray(actions[0]), contract, periods=2)
    other_path = motion_ops.path(start, other[0], contract, periods=2)
    np.testing.assert_allclose(other_path.pose, np.asarray(own_path.pose) * [[1.0, -1.0, -1.0]], atol=1e-5)
    np.testing.assert_allclose(other_path.speed_mps, own_path.speed_mps)
    # and it is the motion that a recording of that path would have
    course = lambda path: np.append(path.pose, path.speed_mps[:, None], axis=1).astype(np.float64)
    motion = ego_motion.between(course(own_path))
    moved = mirror.mirrored(types.Batch(action=actions, is_first=np.zeros((1, 6), bool), ego_motion=motion[None]))
    np.testing.assert_allclose(moved.ego_motion[0], ego_motion.between(course(other_path)), atol=1e-5)


def test_commands_to_the_left_become_commands_to_the_right():
    seen = mirror.mirrored(batch_of(command=np.int32(0), next_command=np.int32(5), target_m=np.float32([20.0, 3.0])))
    assert (int(seen.command[0, 0]), int(seen.next_command[0, 0])) == (1, 4)
    np.testing.assert_array_equal(seen.target_m[0, 0], [20.0, -3.0])


def test_every_second_window_is_mirrored_as_a_whole_and_the_key_decides():
    batch = full_batch(windows=64)
    keys = step_lib.sample_keys(jax.random.key(0), 0, 0, 64, None)
    drawn, other = jax.jit(mirror.randomly)(batch, keys), mirror.mirrored(batch)
    fields = ("image", "action", "intrinsics", "camera_to_ego", "birds_eye_classes", "range_view")
    turned = np.array([[np.allclose(getattr(drawn, name)[window], getattr(other, name)[window]) for name in fields]
                       for window in range(64)])
    kept = np.array([[np.array_equal(getattr(drawn, name)[window], getattr(batch, name)[window]) for name in fields]
                     for window in range(64)])
    assert (turned.all(axis=1) ^ kept.all(axis=1)).all()
    assert 20 <= turned.all(axis=1).sum() <= 44
    again = mirror.randomly(batch, keys)
    np.testing.assert_array_equal(again.image, drawn.image)


def test_training_sees_it_and_validation_does_not():
    config = config_lib.override(presets.tiny(), "augmentation.mirror", True)
    model, batch = small_world.SmallWorld(config.model), small_world.make_batch(config.model)
    keys = step_lib.sample_keys(jax.random.key(0), 0, 0, small_world.WINDOWS, None)
    variables = model.init()

    def loss(config, train):
        forward = jax.jit(functools.partial(step_lib.forward, model=model, config=config, train=train, axis_name=None))
        total, _ = forward(variables["params"], variables["batch_stats"], batch, keys)
        return float(total)

    assert loss(config, True) != loss(presets.tiny(), True)
    assert loss(config, False) == loss(presets.tiny(), False)


@pytest.mark.parametrize(("field", "value", "message"), [
    ("model.range_view.position_m", (1.0, 0.4, 2.0), r"the lidar \(model.range_view.position_m\) lies at y = 0.4 m"),
    ("model.voxels.origin_m", (-16.0, -15.0, -3.0), "the middle of model.voxels lies at y = 1 m"),
    ("data.route_map.ego_column", 20.0, r"column 20 \(data.route_map.ego_column\), not at the middle, 32"),
])
def test_sensors_that_are_not_symmetric_are_refused_before_compilation(field, value, message):
    config = config_lib.override_all(presets.tiny(), {"augmentation.mirror": True, field: value})
    with pytest.raises(ValueError, match=message):
        step_lib.make_train_step(small_world.SmallWorld(config.model), config)


def test_where_the_car_stands_in_route_maps_that_are_not_read_does_not_matter():
    mirror.check(config_lib.override_all(presets.tiny(), {"model.route": False, "data.route_map.ego_column": 20.0}))
