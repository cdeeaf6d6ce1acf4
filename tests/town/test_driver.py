"""The drivers' laws by hand: when they brake, whom they follow, where they steer."""

import math

import numpy as np
import pytest

from muvo_jax.town import driver


@pytest.mark.parametrize(("speed_mps", "desired_mps", "gap_m", "leader_mps", "expected_mps2"), [
    (0.0, 8.0, 1e9, 0.0, 2.0),  # an empty road
    (8.0, 8.0, 1e9, 0.0, 0.0),  # at the speed that is wished for
    (0.0, 8.0, driver.STANDSTILL_GAP_M, 0.0, 0.0),  # in a queue
    (12.0, 8.0, 1e9, 0.0, -2.5 / 3),  # too fast: 2.5 times the share that is too much
    (5.0, 10.0, 14.0, 5.0, 2 * (1 - 0.5**4 - (7 / 14) ** 2)),  # 2 m and a second are wished for
])
def test_acceleration_by_hand(speed_mps, desired_mps, gap_m, leader_mps, expected_mps2):
    got = driver.follow(np.array(speed_mps), np.array(desired_mps), np.array(gap_m), np.array(leader_mps))
    np.testing.assert_allclose(got, expected_mps2, atol=1e-9)


def test_whoever_is_nearer_or_slower_is_braked_for_harder():
    brakes = lambda gap_m, leader_mps: driver.follow(8.0, 8.0, np.asarray(gap_m), np.asarray(leader_mps))
    assert (np.diff(brakes(np.linspace(2.0, 40.0, 20), 4.0)) > 0).all()
    assert (np.diff(brakes(20.0, np.linspace(0.0, 8.0, 20))) > 0).all()


def test_the_first_on_the_path_is_followed_at_its_speed_along_the_path():
    straight = np.stack([driver.LOOK_AHEAD_M, np.zeros_like(driver.LOOK_AHEAD_M)], axis=-1)
    paths = np.stack([straight, straight + np.array([0.0, 50.0])])  # two cars side by side, the other far to the left
    others_m = np.array([[0.0, 0.0], [12.0, 0.5], [20.0, 0.0], [7.0, 4.0], [1.0, 50.0]])
    velocity_mps = np.array([[5.0, 0.0], [3.0, 4.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    distance_m, speed_mps = driver.find_leader(paths, np.zeros(paths.shape[:2]), others_m, velocity_mps,
                                               np.full(5, 1.9), np.array([0, 4]))
    # It reaches to within 1.9 m of (12, 0.5) at 11.5 m; 4 m beside the path, and the car itself, do not count.
    np.testing.assert_allclose(distance_m, [driver.LOOK_AHEAD_M[7], driver.NO_GAP_M])
    np.testing.assert_allclose(speed_mps, [3.0, 0.0])


def test_wheels_lead_the_rear_axle_through_the_target_on_a_circle():
    assert driver.pursue(np.zeros(2), 0.0, np.array([9.0, 0.0]), 2.7) == 0.0
    radius_m, turned_rad = 15.0, 0.6
    target_m = radius_m * np.array([math.sin(turned_rad), 1 - math.cos(turned_rad)])  # on a circle to the left
    np.testing.assert_allclose(math.tan(driver.pursue(np.zeros(2), 0.0, target_m, 2.7)), 2.7 / radius_m, rtol=1e-6)
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(driver.pursue(np.array([3.0, 4.0]), math.pi / 2, turned @ target_m + [3.0, 4.0], 2.7),
                               driver.pursue(np.zeros(2), 0.0, target_m, 2.7), rtol=1e-6)


def test_a_restless_driver_is_short_of_patience_and_the_same_each_time():
    rate_hz = 10.0
    bursts = [driver.burst(3, frame, rate_hz) for frame in range(2000)]
    on = np.array([burst is not None for burst in bursts])
    assert 0.15 < on.mean() < 0.5
    lengths = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], on, [0]]))))[::2]
    assert (lengths.min() + 1) / rate_hz >= 0.3 and (lengths.max() - 1) / rate_hz <= 1.0
    pedals = np.array([burst for burst in bursts if burst is not None])
    assert ((pedals != 0).sum(axis=1) == 1).all() and np.abs(pedals).max() <= 1.0  # one pedal or the wheel
    np.testing.assert_array_equal(pedals, [burst for frame in range(2000)
                                           if (burst := driver.burst(3, frame, rate_hz)) is not None])
