import copy
import dataclasses
import math
import shutil

import jax
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import sources
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view, voxels
from muvo_jax.town import Town, TownConfig, record, settings, simulator
from muvo_jax.town import boxes as box_lib
from muvo_jax.town import map as map_lib

CONTRACT = config_lib.ActionContract()


@pytest.fixture(scope="module")
def town():
    return Town()


@pytest.fixture(scope="module")
def drive(town):
    """Twelve moments of an expert drive, 0.4 s apart, with the actions in between."""
    state = town.reset(11)
    states = []
    for frame in range(48):
        if frame % 4 == 0:
            states.append(state)
        state = town.step(state, town.expert(state))
    return states


def assert_equal_trees(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_the_same_seed_gives_the_same_bytes(town):
    def rollout(some_town):
        state = some_town.reset(5, "hard_rain_noon")
        for _ in range(15):
            state = some_town.step(state, some_town.expert(state))
        return state, some_town.render(state)

    first, second = rollout(town), rollout(Town())
    assert_equal_trees(first, second)
    _, other = rollout(Town(TownConfig(seed=1)))
    assert (other["image"] != first[1]["image"]).any()
    assert (town.render(town.reset(6, "hard_rain_noon"))["image"] != first[1]["image"]).any()


def test_bicycle_straight_ahead_by_hand():
    """5 m/s, full throttle (3 m/s2) for 0.1 s: 5.3 m/s, and 0.1 * (5 + 5.3) / 2 = 0.515 m along the heading."""
    pose, speed_mps = simulator.bicycle(np.array([1.0, 2.0, math.pi / 2]), 5.0, np.array([1.0, 0.0]), CONTRACT)
    assert speed_mps == pytest.approx(5.3)
    np.testing.assert_allclose(pose, [1.0, 2.515, math.pi / 2], atol=1e-12)


def test_bicycle_turn_by_hand():
    """6 m/s, no pedal, steering 0.5: wheels 0.3 rad to the right, so the heading falls by 0.6 tan(0.3) / 2.9."""
    pose, speed_mps = simulator.bicycle(np.zeros(3), 6.0, np.array([0.0, 0.5]), CONTRACT)
    turn = -0.6 * math.tan(0.3) / 2.9
    assert speed_mps == pytest.approx(6.0)
    np.testing.assert_allclose(pose, [0.6 * math.cos(turn / 2), 0.6 * math.sin(turn / 2), turn])
    assert pose[1] < 0  # to the right of the ego vehicle


def test_brakes_stop_and_do_not_reverse():
    """Half braking is 3 m/s2: 0.2 m/s is gone before the period ends."""
    pose, speed_mps = simulator.bicycle(np.zeros(3), 0.2, np.array([-0.5, 0.0]), CONTRACT)
    assert speed_mps == 0
    assert pose[0] == pytest.approx(0.1 * 0.2 / 2)


def test_actions_beyond_one_are_clipped():
    for action in ([7.0, -4.0], [-9.0, 2.0]):
        result = simulator.bicycle(np.zeros(3), 4.0, np.array(action), CONTRACT)
        expected = simulator.bicycle(np.zeros(3), 4.0, np.clip(action, -1, 1), CONTRACT)
        assert_equal_trees(result, expected)


def test_a_state_is_a_value(town, drive):
    """Stepping leaves the state as it was, copies share no future, and equal actions give equal futures."""
    state = drive[3]
    kept = copy.deepcopy(state)
    left = right = jax.tree.map(np.copy, state)
    for _ in range(10):
        left, right = town.step(left, np.array([0.3, -0.4])), town.step(right, np.array([-1.0, 0.4]))
    assert_equal_trees(state, kept)
    assert left.pose[2] > right.pose[2] and left.speed_mps > right.speed_mps
    again = kept
    for _ in range(10):
        again = town.step(again, np.array([0.3, -0.4]))
    assert_equal_trees(left, again)


def test_shapes_and_dtypes(town, drive):
    seen = town.render(drive[0])
    found = {name: (value.dtype, value.shape) for name, value in seen.items() if name != "points_m"}
    assert found == {
        "image": (np.uint8, (64, 256, 3)), "depth_m": (np.float32, (64, 256)), "classes": (np.uint8, (64, 256)),
        "range_view": (np.float32, (64, 256, 4)), "route_map": (np.uint8, (64, 64)), "speed_mps": (np.float32, ()),
        "image_moving_mask": (np.bool_, (64, 256)), "occupancy_moving_mask": (np.bool_, (48, 48, 16)),
        "reward": (np.float32, ()), "is_terminal": (np.bool_, ())}
    assert seen["points_m"].dtype == np.float32 and seen["points_m"].shape[1:] == (3,)
    assert len(seen["points_m"]) > 8000


def test_every_class_of_the_street_is_seen(town, drive):
    classes = np.unique(np.concatenate([town.render(state)["classes"].ravel() for state in drive]))
    names = {box_lib.CLASSES[index] for index in classes}
    assert {"sky", "road", "marking", "pavement", "grass", "building", "vegetation", "vehicle"} <= names


def test_movers_are_road_users_that_move(town, drive):
    """What is marked shows road users; of these the parked and the waiting ones are not; a moving one's voxels hold its
    points; and where nobody moves nothing is marked."""
    marked = parked = inside = 0
    grid = town.config.voxels
    for state in drive:
        seen = town.render(state)
        road_users = np.isin(seen["classes"], (box_lib.VEHICLE, box_lib.PEDESTRIAN))
        assert not (seen["image_moving_mask"] & ~road_users).any()
        marked, parked = marked + seen["image_moving_mask"].sum(), parked + (
            road_users & ~seen["image_moving_mask"]).sum()
        points_m = camera_ops.depth_to_points(np.where(seen["image_moving_mask"], seen["depth_m"], np.inf),
                                              town.renderer.intrinsics, town.renderer.camera_to_ego)
        hit = voxels.voxelize(points_m, grid) > 0
        assert not (hit & ~seen["occupancy_moving_mask"]).any()
        inside += hit.sum()
    assert marked > 100 and parked > 100 and inside > 10
    state = drive[-1]
    still = dataclasses.replace(state, traffic=dataclasses.replace(
        state.traffic, speed_mps=0 * state.traffic.speed_mps, crosses=np.ones_like(state.traffic.crosses),
        walked_m=0 * state.traffic.walked_m))
    seen = town.render(still)
    assert not seen["image_moving_mask"].any() and not seen["occupancy_moving_mask"].any()


def test_lidar_points_lie_on_the_depth_map(town, drive):
    """A lidar point is as far away as the depth map says where it projects to (unless it hit something so thin that no
    pixel did)."""
    for state in drive[::4]:
        seen = town.render(state)
        uv_px, depth_m = camera_ops.project_to_image(seen["points_m"], town.renderer.intrinsics,
                                                     town.renderer.camera_to_ego)
        inside = (depth_m > 0) & (uv_px > 1).all(1) & (uv_px < [255, 63]).all(1)
        column, row = np.floor(uv_px[inside]).astype(int).T
        # The pixel's centre is up to half a pixel from the point: compare with the range over its neighbours.
        around = np.stack([seen["depth_m"][row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        low, high = around.min(0), around.max(0)
        agrees = (depth_m[inside] > low - 0.02) & (depth_m[inside] < high + 0.02)
        assert inside.sum() > 1500
        assert agrees.mean() > 0.985


def test_the_range_view_is_the_projection_of_the_points(town, drive):
    seen = town.render(drive[5])
    view = range_view.project(seen["points_m"], town.config.lidar)
    np.testing.assert_allclose(view, seen["range_view"], atol=2e-5)


def test_occupancy_agrees_with_both_sensors(town, drive):
    grid = town.config.voxels
    for state in drive[::5]:
        seen = town.render(state)
        occupancy = town.occupancy(seen)
        assert set(np.unique(occupancy)) == {0, 1, 255}
        depth_points_m = camera_ops.depth_to_points(seen["depth_m"], town.renderer.intrinsics,
                                                    town.renderer.camera_to_ego)
        for points_m in (seen["points_m"], depth_points_m):
            index, inside = voxels.voxel_index(points_m, grid)
            assert (occupancy[tuple(index[inside].T)] == 1).all()
        # Half way to what a beam met there is nothing, unless another beam met something in the same voxel.
        halfway_m = 0.5 * (seen["points_m"] + np.array(town.config.lidar.position_m, np.float32))
        index, inside = voxels.voxel_index(halfway_m, grid)
        halfway = occupancy[tuple(index[inside].T)]
        assert (halfway == 255).mean() < 0.01 and (halfway == 0).mean() > 0.6


def test_ground_is_flat_and_everything_stands_on_it(town, drive):
    points_m = town.render(drive[2])["points_m"]
    assert points_m[:, 2].min() > -1e-3
    assert (np.abs(points_m[:, 2]) < 1e-2).mean() > 0.3


def test_route_map_shows_the_way_ahead(town, drive):
    route_map = town.render(drive[0])["route_map"]
    assert set(np.unique(route_map)) == {0, 255}
    assert (route_map[40:48, 30:34] == 255).any(axis=1).all()  # straight up from the ego vehicle in row 48


def test_the_expert_drives_well(town):
    """Forty seconds in two drives: no collision, in its lane, at urban speed, and its actions vary."""
    for seed in (21, 22):
        state, speeds_mps, actions = town.reset(seed), [], []
        for _ in range(200):
            actions.append(town.expert(state))
            state = town.step(state, actions[-1])
            speeds_mps.append(float(state.speed_mps))
            assert not town.is_terminal(state)
        assert 2.0 < np.mean(speeds_mps) < 10.0 and max(speeds_mps) < 11.5
        assert (np.std(actions, axis=0) > 0.03).all()
        assert np.min(actions) >= -1 and np.max(actions) <= 1


def test_driving_into_a_house_is_a_terminal_collision(town):
    state = town.reset(3)
    rewards = []
    for _ in range(120):
        state = town.step(state, np.array([0.5, 0.35]))
        rewards.append(town.reward(state))
        if state.collided:
            break
    assert state.collided and town.is_terminal(state)
    assert rewards[-1] == -1.0 and min(rewards[:-1]) >= 0 and max(rewards) <= 1


def test_unknown_weather_is_refused(town):
    with pytest.raises(ValueError, match="'snow' is unknown; known are clear_noon"):
        town.reset(0, "snow")


def test_streets_have_no_dead_ends_and_lanes_join():
    for seed in range(3):
        streets = map_lib.make_streets(TownConfig(seed=seed))
        assert (streets.successor_count > 0).all() and (streets.degree >= 2).all()
        for segment, following in enumerate(streets.successors):
            for successor in following[following >= 0]:
                np.testing.assert_allclose(streets.points_m[segment, -1], streets.points_m[successor, 0], atol=1e-9)


def test_splits_share_training_weathers_or_hold_them_out_and_never_share_routes():
    assert not set(settings.TRAINING_WEATHERS) & set(settings.HELD_OUT_WEATHERS)
    assert set(settings.TRAINING_WEATHERS) | set(settings.HELD_OUT_WEATHERS) == set(settings.WEATHERS)
    jobs = record.jobs("default")
    weathers = {split: {job.weather for job in jobs if job.split == split} for split in ("train", "val_rl", "val_ds")}
    assert weathers == {"train": set(settings.TRAINING_WEATHERS), "val_rl": set(settings.TRAINING_WEATHERS),
                        "val_ds": set(settings.HELD_OUT_WEATHERS)}
    assert len({job.seed for job in jobs}) == len(jobs)


def test_unknown_size_is_refused():
    with pytest.raises(ValueError, match="'huge' is unknown; known are default, large, tiny"):
        record.jobs("huge")


def test_fingerprint_depends_on_everything_that_matters():
    base = settings.from_config(presets.get("tiny"))
    changed = [dataclasses.replace(base, seed=1), dataclasses.replace(base, camera_width_px=96),
               dataclasses.replace(base, lidar=config_lib.RangeViewGeometry(rows=64, columns=64))]
    names = {record.fingerprint(town_config, "tiny") for town_config in (base, *changed)}
    assert len(names | {record.fingerprint(base, "default")}) == 5


def test_cached_town_is_recorded_once_and_goes_on_after_an_interruption(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = presets.get("tiny")
    reports = []
    folder = record.cached_town(config, lambda done, total: reports.append((done, total)))
    assert folder.parent == tmp_path / "muvo_jax" and reports[-1] == (48, 48)
    recording = sources.open_recording(folder)
    assert [(sequence.split, sequence.length) for sequence in recording.sequences] == [
        ("train", 12), ("train", 12), ("val_rl", 12), ("val_ds", 12)]
    assert recording.description.modalities >= {"image", "points_m", "occupancy", "route_map", "reward", "is_terminal"}

    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "train/001" in str(path)}
    for path in before:  # as if the second run had been interrupted after some frames
        if path.name == "frames.csv" or path.stem > "000005":
            path.unlink()
    reports.clear()
    assert record.cached_town(config, lambda done, total: reports.append((done, total))) == folder
    assert reports[0] == (37, 48) and reports[-1] == (48, 48)  # only the second run was made again
    assert {path: path.read_bytes() for path in before} == before
    assert record.cached_town(config, lambda *_: pytest.fail("nothing is left to record")) == folder
    shutil.rmtree(folder / "val_ds")  # by somebody who wanted room
    record.cached_town(config, lambda *_: pytest.fail("all that is asked for is there"), split="train")
    record.cached_town(config)
    assert len(list(folder.glob("val_ds/*/frames.csv"))) == 1


def test_workers_record_the_same_bytes_as_one_process(tmp_path):
    town_config = settings.from_config(presets.get("tiny"))
    for name, workers in (("alone", 0), ("shared", 2)):
        record.record_town(tmp_path / name, town_config, "tiny", workers=workers)
    contents = [{path.relative_to(tmp_path / name): path.read_bytes()
                 for path in (tmp_path / name).rglob("*") if path.is_file()} for name in ("alone", "shared")]
    assert contents[0] == contents[1]


def test_a_failing_worker_is_reported(tmp_path):
    town_config = settings.from_config(presets.get("tiny"))
    (tmp_path / "train").write_text("a file where a folder should be")
    with pytest.raises(RuntimeError, match=r"(?s)failed \(exit codes .*NotADirectoryError.*train"):
        record.record_town(tmp_path, town_config, "tiny", workers=1)
