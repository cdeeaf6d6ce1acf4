"""Forecasts along the rays of recorded scans: worked arithmetic, the box, rays where nothing is predicted."""

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.metrics import scans
from muvo_jax.ops import range_view as range_view_ops

GEOMETRY = config_lib.RangeViewGeometry(rows=32, columns=256, position_m=(1.0, 0.0, 2.0))
EVALUATION = config_lib.EvaluationConfig(scan_region_m=(-20.0, -20.0, -4.5, 20.0, 20.0, 4.5))
STILL = np.zeros((1, 1, 4))


@pytest.fixture
def scan():
    """One point along each of some beams, 5 to 10 m from the lidar."""
    random = np.random.default_rng(0)
    beams = range_view_ops.beam_directions(GEOMETRY)[8:24:8, ::16].reshape(-1, 3)
    return (beams * random.uniform(5, 10, (len(beams), 1)) + GEOMETRY.position_m).astype(np.float32)


def scores(prediction, scan, motion=STILL, evaluation=EVALUATION):
    found = scans.frame_scores(prediction[None, None], [[scan]], motion, geometry=GEOMETRY, evaluation=evaluation,
                               threshold_m=1.0)
    return {name: value.item() for name, value in found.items()}


def farther(view, metres):
    """Every range longer; only ranges are looked at."""
    return np.concatenate([np.zeros_like(view[..., :3]), view[..., 3:] + metres * (view[..., 3:] > 0)], axis=-1)


def test_a_perfect_forecast_is_perfect_and_half_a_metre_is_half_a_metre(scan):
    view = range_view_ops.project(scan, GEOMETRY)
    assert scores(view, scan) == pytest.approx({"near_m2": 0, "l1_m": 0, "absrel_percent": 0}, abs=1e-4)
    ranges_m = np.linalg.norm(scan - np.array(GEOMETRY.position_m), axis=-1)
    # Beams are 1 m and more apart there: the nearest point is that of the same ray, a quarter of a square metre.
    assert scores(farther(view, 0.5), scan) == pytest.approx(
        {"near_m2": 0.25, "l1_m": 0.5, "absrel_percent": 100 * (0.5 / ranges_m).mean()}, rel=1e-4)


def test_points_outside_the_box_count_for_no_distance_and_rays_end_where_they_leave_it(scan):
    view = range_view_ops.project(scan, GEOMETRY)
    small = config_lib.EvaluationConfig(scan_region_m=(-2.5, -2.5, -2.5, 2.5, 2.5, 2.5))
    found = scores(farther(view, 1.0), scan, evaluation=small)  # all of it lies beyond the box
    assert np.isnan(found["near_m2"]) and found["l1_m"] == found["absrel_percent"] == 0.0


def view_of(range_m):
    """A range view that shows one range everywhere."""
    return np.full((GEOMETRY.rows, GEOMETRY.columns, 4), range_m, np.float32)


def test_a_ray_without_a_predicted_return_asks_the_nearest_one_and_ends_at_the_box():
    scan = np.array([[6.0, 0.0, 2.0]], np.float32)  # straight ahead, 5 m from the lidar; the box ends at 20 m
    assert all(np.isnan(value) for value in scores(view_of(-1.0), scan).values())  # there is none
    view = view_of(-1.0)
    view[:, 0], view[:, 150] = 9.0, 8.0  # behind the lidar, and to its right, which is nearer
    assert scores(view, scan) == pytest.approx({"near_m2": 9.0, "l1_m": 3.0, "absrel_percent": 60.0}, rel=1e-5)
    found = scores(view_of(50.0), scan)
    assert np.isnan(found["near_m2"])
    assert (found["l1_m"], found["absrel_percent"]) == pytest.approx((15.0, 300.0), rel=1e-3)


def test_the_box_stays_where_the_last_observed_lidar_stood():
    """The car drives 15 m ahead and turns to the left by a right angle: ahead of it the box now ends after 19 m, to its
    right after 6."""
    view = view_of(50.0)
    motion = np.array([[[15.0, 0.0, np.pi / 2, 0.0]]])
    # The lidar, 1 m ahead of the ego's origin, stands at (14, 1) of the old lidar's frame.
    ahead, right = (np.array([point], np.float32) for point in ([4.0, 0.0, 2.0], [1.0, -3.0, 2.0]))
    assert scores(view, ahead, motion)["l1_m"] == pytest.approx(19.0 - 3.0, rel=1e-3)
    assert scores(view, right, motion)["l1_m"] == pytest.approx(6.0 - 3.0, rel=1e-3)


def test_returns_of_the_car_itself_are_left_out_and_what_is_not_finite_is_undefined(scan):
    view = range_view_ops.project(scan, GEOMETRY)
    own = np.array([[1.5, 0.2, 1.0], GEOMETRY.position_m], np.float32)
    without = config_lib.EvaluationConfig(scan_region_m=EVALUATION.scan_region_m, scan_without_m=(-2.0, -1.0, 3.0, 1.0))
    assert scores(view, np.concatenate([scan, own]), evaluation=without) == scores(view, scan)
    assert all(np.isnan(value) for value in scores(view * np.nan, scan).values())
    assert all(np.isnan(value) for value in scores(view, own, evaluation=without).values())
