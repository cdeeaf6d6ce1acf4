"""Moved frames: a wall, a post and a picture as they look from where the car will be."""

import dataclasses

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.metrics import protocol, warp
from muvo_jax.ops import camera, range_view

CONTEXT, HORIZON = 2, 2
GEOMETRY = config_lib.RangeViewGeometry(rows=32, columns=64)
GRID = config_lib.VoxelGrid((16, 16, 2), 1.0, (-8.0, -8.0, 0.5))


def config_of(kinematics="bicycle"):
    config = presets.tiny()
    return dataclasses.replace(
        config, model=dataclasses.replace(config.model, heads=("image", "range_view"), voxels=GRID,
                                          range_view=GEOMETRY),
        contract=config_lib.ActionContract(kinematics=kinematics),
        data=dataclasses.replace(config.data, context=CONTEXT, horizon=HORIZON, stride=2))


def driving(speed_mps=10.0):
    """A car that drives straight on, 2 m a step at 10 m/s; a post stands 6.5 m ahead of it in the last seen frame.

    Only the frame before that knows a voxel to the left of it.
    """
    frames, ahead = CONTEXT + HORIZON, types.OCCUPANCY_OCCUPIED
    occupancy = np.zeros((1, frames, *GRID.shape), np.uint8)
    occupancy[0, (1, 2, 3), (14, 12, 10), 8] = ahead  # centre at 6.5 m, 4.5 m and 2.5 m
    occupancy[0, 0, 15, 12] = ahead  # at 7.5 m then, 5.5 m when seen from frame 1
    occupancy[0, 1, :, 12] = types.OCCUPANCY_UNKNOWN
    heights_m = np.linspace(0.0, 3.0, 16)
    post = np.stack([np.full(16, 6.5), np.zeros(16), heights_m], axis=1).astype(np.float32)
    views = np.stack([range_view.project(post, GEOMETRY)] * frames)[None]
    action = np.zeros((1, frames, 2), np.float32)
    ego_motion = np.zeros((1, frames, 4), np.float32)
    ego_motion[:, 1:, 0], ego_motion[..., 3] = 0.2 * speed_mps, speed_mps
    calibration = {"intrinsics": camera.intrinsics_from_fov(64, 32, 1.5)[None],
                   "camera_to_ego": camera.level_camera_to_ego((1.0, 0.0, 2.0))[None]}
    return types.Batch(
        action=action, is_first=np.zeros((1, frames), bool), range_view=views, occupancy=occupancy,
        image=np.full((1, frames, 32, 64, 3), 51, np.uint8), ego_motion=ego_motion,
        speed_mps=np.full((1, frames), speed_mps, np.float32), **calibration).validate()


def test_a_post_comes_nearer_by_what_the_car_drives():
    frames = warp.warp(driving(), CONTEXT, HORIZON, config_of())
    for step, (cell, distance_m) in enumerate(((12, 4.5), (10, 2.5))):
        assert np.argwhere(frames["occupancy"][0, step]).tolist() == [[cell, 8, 0], [cell, 8, 1]]
        points_m = range_view.to_points(frames["range_view"][0, step])
        np.testing.assert_allclose(points_m[:, :2], [[distance_m, 0.0]] * len(points_m), atol=1e-4)
        assert len(points_m) > 2
    np.testing.assert_allclose(frames["image"], 0.2, atol=1e-6)
    assert frames["image"].shape == (1, HORIZON, 32, 64, 3)


def test_later_frames_and_their_speeds_are_not_looked_at():
    batch, other = driving(), driving()
    for name in ("occupancy", "range_view", "image", "speed_mps"):
        getattr(other, name)[:, CONTEXT:] = 0
    for name, value in warp.warp(batch, CONTEXT, HORIZON, config_of()).items():
        np.testing.assert_array_equal(value, warp.warp(other, CONTEXT, HORIZON, config_of())[name])


def test_the_pedals_and_the_wheel_decide_where_it_goes():
    braking, turning = driving(), driving()
    braking.action[..., 0] = -1.0
    turning.action[..., 1] = -1.0  # to the left: the post goes to the right
    braked, turned = (warp.warp(batch, CONTEXT, HORIZON, config_of()) for batch in (braking, turning))
    # Full brake, 6 m/s2 for 0.4 s: 0.4 * 10 - 0.5 * 6 * 0.4^2 = 3.52 m.
    np.testing.assert_allclose(range_view.to_points(braked["range_view"][0, 1])[:, 0], 6.5 - 3.52, atol=1e-4)
    assert range_view.to_points(turned["range_view"][0, 1])[:, 1].mean() < -0.5


def test_all_seen_frames_know_more_than_the_last():
    fused = warp.warp(driving(), CONTEXT, HORIZON, config_of(), fused=True)
    assert fused["occupancy"][0, 0, 11, 12].all()  # 3.5 m ahead now, of the frame before last
    assert not warp.warp(driving(), CONTEXT, HORIZON, config_of())["occupancy"][0, 0, 11, 12].any()
    assert fused["occupancy"][0, 0, 12, 8].all()


def test_without_kinematics_the_recorded_motion_counts():
    batch, config = driving(), config_of("none")
    assert (warp.motion_source(batch, config_of()), warp.motion_source(batch, config)) == ("actions", "recorded")
    for name, value in warp.warp(batch, CONTEXT, HORIZON, config).items():
        np.testing.assert_allclose(value, warp.warp(batch, CONTEXT, HORIZON, config_of())[name], atol=1e-4)


def test_the_protocol_judges_moved_frames_and_says_where_their_motion_comes_from():
    """A car that overtakes: where geometry is wrong are the movers, since nothing labels them."""
    batch = driving()
    batch.occupancy[0, 3, 10, 8], batch.occupancy[0, 3, 13, 8] = 0, types.OCCUPANCY_OCCUPIED
    report = protocol.evaluate(None, None, [protocol.Windows(batch, ("a",))], config_of(),
                               sources=("copy_last", "warp_last", "warp_fused"))
    assert list(report["imagined"]) == ["copy_last", "warp_last", "warp_fused"] and not report["observed"]
    moved, copied = (report["imagined"][source] for source in ("warp_last", "copy_last"))
    assert moved["iou_occ_above_observed"]["per_step"] == [1.0, 0.0] and copied["iou_occ_above_observed"]["mean"] == 0
    assert moved["iou_occ_movers"]["mean"] == 0.0 and report["movers"] == "voxels that warp-last gets wrong"
    assert "motion from actions" in report["protocol"]
    assert "motion as recorded" in protocol.identity(config_of("none"))
    lost = protocol.Windows(batch.replace(speed_mps=None, ego_motion=None), ("a",))
    assert list(protocol.evaluate(None, None, [lost], config_of(), sources=("copy_last", "warp_last"))[
        "imagined"]) == ["copy_last"]


def test_what_cannot_be_moved_is_left_out_and_unknown_motion_is_refused():
    batch = driving().replace(range_view=None)
    assert set(warp.warp(batch, CONTEXT, HORIZON, config_of())) == {"occupancy"}
    lost = batch.replace(speed_mps=None, ego_motion=None)
    assert warp.motion_source(lost, config_of()) is None
    with pytest.raises(ValueError, match="no speed_mps and no ego_motion: the motion is unknown"):
        warp.warp(lost, CONTEXT, HORIZON, config_of())
