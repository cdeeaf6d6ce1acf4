"""Ego path and rewards: worked arithmetic."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.agents import rewards, route
from muvo_jax.ops import motion as motion_ops
from muvo_jax.town import renderer, simulator

CONTRACT = config_lib.ActionContract()
GRID = config_lib.VoxelGrid((16, 16, 4), 1.0, (-8.0, -8.0, -1.5))
CONFIG = rewards.RewardConfig()


def moment(speed=10.0, action=(0.0, 0.0), **fields):
    before = motion_ops.at_rest_of_frame(jnp.float32(speed))
    action = jnp.asarray(action, jnp.float32)
    return rewards.Moment(before, motion_ops.drive(before, action, CONTRACT, 2), action, jnp.zeros((3,)),
                          **{"decoded": {}} | fields)


def map_of(line_m):
    """The line of a map on which the town draws a route of points [N, 2] in the ego frame."""
    drawn = renderer.draw_route(np.asarray(line_m, float), np.zeros(3))
    return route.follow(jnp.asarray(drawn), config_lib.RouteMap())


LINE_Y_M = -0.375  # where the map's pixels have the middle of a line at y = 0
STRAIGHT = map_of(np.stack([np.arange(-15, 45, 0.5), np.zeros(120)], axis=1))


def driven(poses, speed=10.0, line=STRAIGHT, config=CONFIG, **fields):
    """(rewards [H], terms) of a car that is led through poses [H + 1, 3] at a speed, with a clear road."""
    poses = jnp.asarray(poses, jnp.float32)
    motion = lambda part: motion_ops.Motion(part, jnp.full(part.shape[:1], speed, jnp.float32))
    steps = rewards.Moment(motion(poses[:-1]), motion(poses[1:]), jnp.zeros((len(poses) - 1, 2)), jnp.zeros((3,)), {},
                           route=line, **fields)
    reward, _, terms = rewards.weighed(steps, None, contract=CONTRACT, step_s=0.2, config=config)
    return np.asarray(reward), {name: np.asarray(term) for name, term in terms.items()}


def through(*corners, step_m=2.0):
    """Poses every step_m along straight stretches between corners [x, y]."""
    stretches = []
    for start, end in itertools.pairwise(corners):
        start, end = np.array(start, float), np.array(end, float)
        yaw, count = np.arctan2(*(end - start)[::-1]), round(np.linalg.norm(end - start) / step_m)
        stretches += [[*(start + (end - start) * k / count), yaw] for k in range(count)]
    return np.array([*stretches, [*corners[-1], yaw]])


def logits(occupied):
    """Occupancy logits [X, Y, Z, 2] with probability 1 at the given voxels, 0 elsewhere."""
    value = np.zeros((*GRID.shape, 2), np.float32)
    value[..., 0] = 40.0
    for voxel in occupied:
        value[voxel] = (0.0, 40.0)
    return jnp.asarray(value)


def test_the_ego_path_is_the_towns():
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (12, 2)).astype(np.float32)
    pose, speed = np.zeros(3), 3.0
    for action in actions:
        for _ in range(2):
            pose, speed = simulator.bicycle(pose, speed, action, CONTRACT)
    motion = motion_ops.path(motion_ops.at_rest_of_frame(jnp.float32(3.0)), jnp.asarray(actions), CONTRACT, 2)
    assert motion.pose.shape == (12, 3) and motion.speed_mps.shape == (12,)
    np.testing.assert_allclose(motion.pose[-1], pose, atol=1e-4)
    np.testing.assert_allclose(motion.speed_mps[-1], speed, atol=1e-5)


def test_braking_by_hand():
    motion = motion_ops.drive(motion_ops.at_rest_of_frame(jnp.float32(1.0)), jnp.array([-1.0, 0.5]), CONTRACT, 2)
    # 6 m/s2 for 0.1 s: 1.0 -> 0.4 m/s over 0.07 m, then 0.4 -> 0 (not -0.2) over 0.02 m.
    np.testing.assert_allclose(motion.speed_mps, 0.0, atol=1e-7)
    np.testing.assert_allclose(motion.pose[2], -0.09 * np.tan(0.3) / 2.9, rtol=1e-5)
    np.testing.assert_allclose(motion.pose[0], 0.09, atol=1e-5)


def test_paths_of_unknown_kinematics_are_refused():
    with pytest.raises(ValueError, match=r"contract\.kinematics is 'none'"):
        motion_ops.drive(moment().before, jnp.zeros((2,)), dataclasses.replace(CONTRACT, kinematics="none"))


def test_only_what_stands_at_the_height_of_the_car_counts():
    # Layers have their centres at -1, 0, 1 and 2 m; the box reaches from 0.6 to 1.6 m.
    plan = rewards.obstacle_plan(logits([(3, 4, 1), (5, 6, 2), (7, 8, 3)]), GRID, CONFIG.box)
    assert np.argwhere(plan > 0.5).tolist() == [[5, 6]]


def test_what_begins_where_the_car_ends_is_no_collision():
    beside = rewards.obstacle_plan(logits([(x, 9, 2) for x in range(16)]), GRID, CONFIG.box)  # from y = 1 m on
    touched = rewards.box_collision(beside, jnp.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]), GRID, CONFIG.box)
    np.testing.assert_allclose(touched, [0.25, 0.75], atol=1e-3)
    assert touched[0] < CONFIG.tolerated_collision


@pytest.mark.parametrize("voxel, pose, expected", [
    ((10, 8, 2), (0, 0, 0), 1.0),  # 2.5 m ahead, 0.5 m to the left: inside the box
    ((13, 8, 2), (0, 0, 0), 0.0),  # 5.5 m ahead: out of reach
    ((13, 8, 2), (3, 0, 0), 1.0),  # ... until the car has driven 3 m
    ((8, 10, 2), (0, 0, 0), 0.0),  # 2.5 m to the left: beside the car
    ((8, 10, 2), (0, 0, np.pi / 2), 1.0),  # ... until it has turned to the left
])
def test_the_ego_box_touches_what_lies_under_it(voxel, pose, expected):
    plan = rewards.obstacle_plan(logits([voxel]), GRID, CONFIG.box)
    probability = rewards.box_collision(plan, jnp.asarray(pose, jnp.float32)[None], GRID, CONFIG.box)
    np.testing.assert_allclose(probability, [expected], atol=0.45)  # bilinear, half a voxel apart


def test_a_collision_is_seen_where_the_car_will_be():
    wall = lambda speed, action=(0.0, 0.0): rewards.collision(  # 5 to 6 m ahead; the bumper is at 3.7 m
        moment(speed, action, decoded={"occupancy": logits([(13, y, 2) for y in range(16)])}), GRID, CONFIG)
    assert wall(1.0) < 0.1  # 0.4 m on
    assert wall(6.0) > 0.6  # 2.4 m on
    assert wall(1.0, (-1.0, 0.0)) < 0.1 and wall(0.0) < 0.1
    bend = rewards.poses_ahead(jnp.zeros(3), moment(5.0).before, moment(5.0, (0.0, -0.5)).after, 0.4)
    np.testing.assert_allclose(bend[:, 2], 5.0 * np.linspace(0.0, 0.4, len(bend)) * np.tan(0.3) / 2.9, rtol=1e-3)
    assert np.all(np.diff(bend[:, 1]) > 0)  # to the left


def test_coarse_occupancy_is_read_as_it_was_trained():
    # Half the size in cells of 2 m: cell [5, 4] covers x from 2 to 4 m and y from 0 to 2 m; its layer 1 0.5 to 2.5 m.
    coarse = jnp.full((8, 8, 2, 2), 0.0).at[..., 0].set(40.0).at[5, 4, 1].set(jnp.array([0.0, 40.0]))
    places = jnp.array([[0.0, 0.0, 0.0], [0.0, 1.9, 0.0]])
    point = rewards.EgoBox(rear_m=2.9, front_m=3.1, half_width_m=0.1)
    where = lambda pooled: rewards.box_collision(rewards.obstacle_plan(coarse, GRID, CONFIG.box, pooled=pooled), places,
                                                 GRID, point, pooled=pooled)
    np.testing.assert_allclose(rewards.centres_m(8, 0, GRID, pooled=True)[0][5], 3.0)  # any of its voxels
    np.testing.assert_allclose(rewards.centres_m(8, 0, GRID, pooled=False)[0][5], 2.5)  # its first voxel alone
    np.testing.assert_allclose(where(True), [0.51, 0.56], atol=0.02)  # the cell's middle is at y = 1 m
    np.testing.assert_allclose(where(False), [0.60, 0.25], atol=0.02)  # 0.4 m beyond it, and 0.4 m or 1.3 m beside
    assert rewards.obstacle_layers(2, GRID, CONFIG.box).tolist() == [1]
    with pytest.raises(ValueError, match=r"in 1 layers.* from -1\.5 to 2\.5 m and holds the road.*occupancy_scale"):
        rewards.obstacle_layers(1, GRID, CONFIG.box)


def test_bilinear_by_hand():
    plane = jnp.array([[0.0, 4.0], [8.0, 0.0]])
    sampled = rewards.bilinear(plane, jnp.array([0.0, 0.5, 0.25, -0.5, 5.0]), jnp.array([1.0, 0.5, 0.0, 1.0, 0.0]))
    np.testing.assert_allclose(sampled, [4.0, 3.0, 2.0, 2.0, 0.0])


def test_the_line_of_a_map_is_the_towns_route():
    scale = config_lib.RouteMap()
    assert scale.metres_per_px == renderer.ROUTE_MAP_M_PER_PX and scale.ego_row == renderer.ROUTE_MAP_EGO_ROW
    bend = np.linspace(0, np.pi / 2, 40)
    turn = np.stack([10 + 12 * np.sin(bend), -12 * (1 - np.cos(bend))], axis=1)  # to the right, from 10 m ahead on
    line_m = np.concatenate([np.stack([np.arange(-12, 10, 0.5), np.zeros(44)], 1), turn, turn[-1] - [[0, 8], [0, 16]]])
    line = map_of(line_m)
    points, along = np.asarray(line.points_m)[line.known], np.asarray(line.along_m)[line.known]
    dense = np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(line_m)])
    assert np.linalg.norm(points[:, None] - dense[None], axis=-1).min(axis=1).max() < 1.3
    assert along[0] < -8 and along[-1] > 10 + 12 * np.pi / 2 + 8 and (np.diff(along) > 0).all()
    at, away = route.place(line, jnp.array([[5.0, 0.0, 0.0], [-5.0, 1.0, 0.0], [22.0, -20.0, -1.6]]))
    np.testing.assert_allclose(at, [5.0, -5.0, 10 + 12 * np.pi / 2 + 8], atol=1.5)
    np.testing.assert_allclose(away, [0.0, 1.0, 0.0], atol=0.6)


def test_without_a_painted_pixel_nothing_is_gained():
    empty = route.follow(jnp.zeros((64, 64), jnp.uint8), config_lib.RouteMap())
    assert not empty.known.any()
    reward, terms = driven(through((0, 0), (20, 0)), line=empty)
    np.testing.assert_array_equal(terms["progress_m"], 0.0)
    assert np.isfinite(reward).all()


def test_progress_fades_with_the_distance_from_the_route():
    _, on = driven(through((0, LINE_Y_M), (20, LINE_Y_M)))
    np.testing.assert_allclose(on["progress_m"], 2.0, rtol=0.02)
    _, beside = driven(through((0, 2.6), (20, 2.6)))
    away = route.place(STRAIGHT, jnp.array([10.0, 2.6, 0.0]))[1]
    np.testing.assert_allclose(away, 2.6, atol=0.4)  # half a pixel
    fading = np.exp(-0.5 * (away / CONFIG.route_tolerance_m) ** 2)
    np.testing.assert_allclose(beside["progress_m"][2:], 2.0 * fading, rtol=0.02)


def test_driving_back_along_the_painted_route_loses_what_driving_on_gains():
    on, back = (driven(through((0, LINE_Y_M), (end, LINE_Y_M)))[0] for end in (10, -10))
    np.testing.assert_allclose(on, 1.0, rtol=0.05)
    np.testing.assert_allclose(back, -1.0, rtol=0.05)
    _, terms = driven(through((0, 0), (-10, 0)), line=None)  # no map: along the heading of the start
    np.testing.assert_allclose(terms["progress_m"], -2.0, rtol=1e-3)


def test_standing_still_earns_nothing_and_any_drive_along_the_route_more():
    still, _ = driven(np.zeros((6, 3)), speed=0.0)
    np.testing.assert_allclose(still, 0.0, atol=1e-6)
    for speed in (1.0, 5.0, 10.0):
        assert driven(through((0, 0), (12, 0), step_m=0.2 * speed), speed)[0].min() > 0.05


@pytest.mark.parametrize("line", [STRAIGHT, None], ids=["route", "no map"])
def test_circling_earns_nothing(line):
    angle = np.linspace(0, 2 * np.pi, 21)
    circle = np.stack([6 * np.sin(angle), 6 * (1 - np.cos(angle)), angle], axis=1)
    reward, terms = driven(circle, line=line)
    assert terms["progress_m"].sum() < 0.1 and reward.sum() < 0.1
    aside = driven(through((0, 0), (12, 0), (12, 8), (0, 8), (0, 0)), line=line)[1]  # back where nothing fades
    assert aside["progress_m"].sum() < 0.1


def test_leaving_and_rejoining_the_route_never_pays():
    y = LINE_Y_M
    straight = driven(through((0, y), (24, y)))[1]["progress_m"].sum()
    detour = driven(through((0, y), (6, y), (12, 6), (18, y), (24, y)))[1]["progress_m"].sum()
    again = driven(through((0, y), (12, y), (12, 6), (4, 6), (4, y), (24, y)))[1]["progress_m"].sum()
    np.testing.assert_allclose(straight, 24.0, atol=0.5)
    assert detour < 0.8 * straight and again < straight


@pytest.mark.parametrize("weight", [0.1, 1.0, 3.0])
def test_the_limit_is_the_best_speed_whatever_speeding_costs(weight):
    config = dataclasses.replace(CONFIG, speeding=weight)
    earned = {speed: driven(through((0, 0), (24, 0), step_m=0.2 * speed), speed, config=config)[0].mean()
              for speed in (8.0, 9.0, 10.0, 12.0, 15.0, 20.0)}
    assert max(earned, key=earned.get) == 10.0 and earned[20.0] < earned[15.0] < earned[10.0] - 0.2 * weight


def test_comfort_and_speeding_by_hand():
    discomfort = rewards.discomfort(moment(10.0, (-0.5, 0.1)), CONTRACT, 0.2, CONFIG)
    speed = 10.0 - 0.2 * 3.0
    np.testing.assert_allclose(discomfort, (3.0**2 + (speed**2 * np.tan(0.06) / 2.9) ** 2) / 9.0, rtol=1e-5)
    np.testing.assert_allclose(rewards.speeding(moment(12.0), CONFIG), 0.2, rtol=1e-5)
    np.testing.assert_allclose(rewards.speeding(moment(8.0), CONFIG), 0.0)


def test_the_reward_adds_up_and_ends_at_a_collision():
    whole = lambda occupancy: rewards.driving_reward(
        moment(5.0, decoded={"occupancy": occupancy}), grid=GRID, contract=CONTRACT, step_s=0.2, config=CONFIG)
    reward, terminated, _ = whole(logits([]))
    np.testing.assert_allclose(reward, 0.5, rtol=1e-4)  # 1 m of the 2 m that the limit allows
    assert not terminated
    reward, terminated, terms = whole(logits([(10, 8, 2), (10, 7, 2), (11, 8, 2), (11, 7, 2)]))
    np.testing.assert_allclose(reward, 0.5 - 20.0 * (terms["collision"] - 0.3) / 0.7, rtol=1e-4)
    assert terminated
    reward, terminated, _ = whole(jnp.zeros((*GRID.shape, 2)))  # as likely as not, everywhere: an untrained model
    np.testing.assert_allclose(reward, 0.5 - 20.0 * 0.2 / 0.7, rtol=1e-4)
    assert not terminated


def contact(touched, speed=5.0):
    """Rewards [H] of a car on its route at a speed that touches something at probabilities [H]."""
    count, touched = len(touched), jnp.asarray(touched, jnp.float32)
    places = jnp.stack([0.2 * speed * jnp.arange(count + 1.0), *jnp.zeros((2, count + 1))], axis=1)
    motion = lambda part: motion_ops.Motion(part, jnp.full(count, speed))
    steps = rewards.Moment(motion(places[:-1]), motion(places[1:]), jnp.zeros((count, 2)), jnp.zeros((3,)), {},
                           unharmed=rewards.unharmed_before(touched, CONFIG))
    return np.asarray(rewards.weighed(steps, touched, contract=CONTRACT, step_s=0.2, config=CONFIG)[0])


def test_no_step_ends_a_drive_more_than_certainly():
    for tolerated in np.linspace(0.0, 0.99, 100):
        config = dataclasses.replace(CONFIG, tolerated_collision=float(tolerated))
        chances = rewards.likely(jnp.array([0.0, tolerated, 1.0], jnp.float32), config)
        assert ((chances >= 0.0) & (chances <= 1.0)).all()


def test_a_moment_of_old_may_be_mapped():
    given = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), moment(5.0))
    reward = jax.vmap(lambda one: rewards.weighed(one, None, contract=CONTRACT, step_s=0.2, config=CONFIG)[0])(given)
    assert reward.shape == (2,)


def test_no_slow_contact_costs_more_than_a_crash_and_none_is_free():
    crash, earned = contact([1.0])[0], lambda *touched: contact(touched).sum()
    np.testing.assert_allclose(crash, 0.5 - CONFIG.collision, rtol=1e-5)
    for count in (2, 10, 100):
        assert crash < earned(*[0.6] * count) < earned(0.6)
    assert earned(0.6, 0.6, 0.0, 0.0) < earned(0.6, 0.0, 0.0, 0.0) < earned(0.0, 0.0, 0.0, 0.0)
    # After an hour beside something there is nothing left to gain.
    np.testing.assert_allclose(contact([0.6] * 40 + [0.0])[-1], 0.0, atol=1e-6)


def test_gradients_push_the_car_away_from_obstacles_and_towards_the_route():
    plan = rewards.obstacle_plan(logits([(12, 8, 2)]), GRID, CONFIG.box)  # centre 4.5 m ahead, the bumper at 3.7 m
    touch = lambda pose: rewards.box_collision(plan, pose[None], GRID, CONFIG.box)[0]
    assert jax.grad(touch)(jnp.array([0.2, 0.0, 0.0]))[0] > 0  # driving on makes it worse
    line = map_of(np.stack([np.arange(-15, 45, 0.5), np.full(120, -4.0)], axis=1))
    away = lambda pose: route.place(line, pose)[1]
    assert jax.grad(away)(jnp.zeros(3))[1] > 0  # the route is to the right
    along = jax.grad(lambda x: route.place(STRAIGHT, jnp.array([1.0, 0.0, 0.0]) * x)[0])(2.0)
    np.testing.assert_allclose(along, 1.0, rtol=0.02)


@pytest.mark.parametrize("action", [(-1.0, 0.0), (-0.5, 0.3), (0.0, 0.0)])
def test_a_car_that_stands_pays_nothing_for_holding_its_brake(action):
    np.testing.assert_array_equal(rewards.discomfort(moment(0.0, action), CONTRACT, 0.2, CONFIG), 0.0)


def test_a_car_that_comes_to_stand_pays_for_how_it_slowed_down_not_for_its_pedal():
    found = rewards.discomfort(moment(0.3, (-1.0, 0.0)), CONTRACT, 0.2, CONFIG)
    np.testing.assert_allclose(found, (0.3 / 0.2 / 3.0) ** 2, rtol=1e-5)


def test_a_scale_at_which_nothing_is_decoded_is_refused():
    with pytest.raises(ValueError, match="occupancy_scale is 3; expected 1, 2 or 4"):
        rewards.RewardConfig(occupancy_scale=3)
