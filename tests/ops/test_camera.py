import math

import numpy as np
import pytest

from muvo_jax.ops import camera

INTRINSICS = camera.intrinsics_from_fov(256, 64, math.radians(90))
POSE = camera.level_camera_to_ego((1.0, 0.0, 2.0))


def test_ninety_degrees_make_the_focal_length_half_the_width():
    np.testing.assert_allclose(INTRINSICS, [[128, 0, 128], [0, 128, 32], [0, 0, 1]], rtol=1e-6)


def test_worked_projection():
    """Ego (11, -5, 1) is 10 m ahead of the camera, 5 m right and 1 m below: u = 128 + 64, v = 32 + 12.8."""
    uv_px, depth_m = camera.project_to_image(np.array([[11, -5, 1], [-4, 0, 2]]), INTRINSICS, POSE)
    np.testing.assert_allclose(uv_px[0], [192, 44.8], rtol=1e-5)
    np.testing.assert_allclose(depth_m, [10, -5])
    assert np.isnan(uv_px[1]).all()


def test_depth_to_points_and_back():
    depth_m = np.random.default_rng(0).uniform(1, 90, (64, 256)).astype(np.float32)
    points_m = camera.depth_to_points(depth_m, INTRINSICS, POSE)
    uv_px, depth_again_m = camera.project_to_image(points_m, INTRINSICS, POSE)
    rows, columns = np.mgrid[:64, :256]
    np.testing.assert_allclose(uv_px, np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2), atol=1e-2)
    np.testing.assert_allclose(depth_again_m, depth_m.ravel(), rtol=1e-5)


def test_pixels_without_depth_give_no_point():
    depth_m = np.array([[np.inf, 4.0], [np.nan, 0.0]], np.float32)
    points_m = camera.depth_to_points(depth_m, camera.intrinsics_from_fov(2, 2, math.radians(90)), POSE)
    np.testing.assert_allclose(points_m, [[5, -2, 4]])  # half a pixel right of and above the centre, f = 1 pixel


def test_resize_crop_keeps_the_bottom_and_the_rays():
    image = np.zeros((100, 400, 3), np.uint8)
    image[60:] = 200
    intrinsics = camera.intrinsics_from_fov(400, 100, math.radians(100))
    cropped, scaled = camera.resize_crop(image, intrinsics, (32, 200))
    assert cropped.shape == (32, 200, 3)
    assert (cropped[-19:] == 200).all()  # the lower 40 of 100 rows are 20 of the 50 scaled ones
    assert (cropped[:11] == 0).all()
    point = np.array([[9.0, 1.0, 1.2]])
    (before,), _ = camera.project_to_image(point, intrinsics, POSE)
    (after,), _ = camera.project_to_image(point, scaled, POSE)
    np.testing.assert_allclose(after, [before[0] / 2, before[1] / 2 - 18], rtol=1e-4)


def test_resize_crop_leaves_a_fitting_image_alone():
    image = np.random.default_rng(0).integers(0, 255, (64, 256, 3), np.uint8)
    same, intrinsics = camera.resize_crop(image, INTRINSICS, (64, 256))
    np.testing.assert_array_equal(same, image)
    np.testing.assert_array_equal(intrinsics, INTRINSICS)


def test_resize_crop_refuses_images_that_are_too_flat():
    with pytest.raises(ValueError, match=r"20 rows, fewer than the 32 wanted"):
        camera.resize_crop(np.zeros((40, 400, 3), np.uint8), INTRINSICS, (32, 200))
