"""How good a moved image can be: python -m experiments.memory.ceiling RUN [WINDOWS]

PSNR of imagined steps of the built-in town, in dB: of the model, of the newest image as the memory moves it, of that
with the best shift of half and whole pixels around each pixel (chosen by the true image, which nobody has), of the
newest image moved by its recorded depth instead of the lidar's ranges, or looked up through the depth that is recorded
at the new place, and of the true image itself after half a pixel there and back, which is what any resampling costs.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

import muvo_jax
from experiments.memory import errors, geometry
from muvo_jax import recordings
from muvo_jax.data import pipeline, sources
from muvo_jax.metrics import protocol
from muvo_jax.ops import camera, motion, reproject
from muvo_jax.town import record

SHIFTS_PX = (-1.0, -0.5, 0.0, 0.5, 1.0)
NEIGHBOURHOOD_PX = 9  # over which a shift is chosen


def psnr_db(frames: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of each frame [B, H, W, 3] in [0, 1]."""
    return -10.0 * np.log10(np.square(frames - truth).mean(axis=(1, 2, 3)))


def shifted(frames: np.ndarray, down_px: float, right_px: float) -> np.ndarray:
    return scipy.ndimage.shift(frames, (0.0, down_px, right_px, 0.0), order=1, mode="nearest")


def best_shifts(frames: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Each pixel of frames [B, H, W, 3] from where it fits its neighbourhood in the truth best."""
    candidates = np.stack([shifted(frames, down, right) for down in SHIFTS_PX for right in SHIFTS_PX])
    error = scipy.ndimage.uniform_filter(np.square(candidates - truth).mean(-1),
                                         (0, 0, NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX))
    return np.take_along_axis(candidates, error.argmin(axis=0)[None, ..., None], axis=0)[0]


def recorded_depth_m(labelled, entry, config) -> np.ndarray:
    """Depth maps of the newest observed frame and of those to imagine, float32 [B, 1 + horizon, H, W]."""
    size, first = config.model.image_size, config.data.context - 1
    windows = entry.windows + entry.windows[-1:] * (entry.batch.batch_size - entry.count)
    depth_m = np.stack([[camera.resize_crop_nearest(labelled.read(window.sequence, index)["depth_m"], size)
                         for index in window.indices[first:]] for window in windows])
    return np.minimum(depth_m, reproject.FAR_M).astype(np.float32)


def by_depth(run, batch, depth_m):
    """The newest image by its own depth, moved, and through the depth at the new places: float32 [N, H, W, 3] each.

    depth_m: [B, 1 + horizon, H, W], see `recorded_depth_m`.
    """
    memory, rows, vantage = geometry.sights(run, batch)
    newest = memory.pose.shape[1] - 1
    pose = motion.relative(vantage.motion.pose, memory.pose[rows, newest])
    image, intrinsics, to_ego = memory.image[rows, newest], memory.intrinsics[rows], memory.camera_to_ego[rows]
    count, height, width = image.shape[:3]
    rays, camera_m = reproject._camera_rays(intrinsics, to_ego, height, width), to_ego[:, None, :3, 3]
    along = lambda directions: (directions * to_ego[:, None, :3, 2]).sum(-1)  # the optical axis
    points_m = lambda depth_m: camera_m + rays * (depth_m.reshape(count, -1) / along(rays))[..., None]

    def looked_up(depth_m):
        u_px, v_px, _ = reproject._project(motion.out_of_frame(points_m(depth_m), pose), intrinsics, to_ego)
        return reproject._bilinear(image, v_px - 0.5, u_px - 0.5).reshape(image.shape) / 255.0

    moved_m = motion.into_frame(points_m(depth_m[rows, 0]), pose)
    u_px, v_px, ahead = reproject._project(moved_m, intrinsics, to_ego)
    inside = ahead & (u_px >= 0) & (u_px < width) & (v_px >= 0) & (v_px < height)
    pixel = jnp.where(inside, jnp.floor(v_px) * width + jnp.floor(u_px), height * width).astype(jnp.int32)
    nearest = jax.vmap(lambda pixel, depth_m: jnp.full(height * width + 1, jnp.inf).at[pixel].min(depth_m))(
        pixel, along(moved_m - camera_m))[:, :-1].reshape(count, height, width)
    around = -jax.lax.reduce_window(-nearest, -jnp.inf, jax.lax.max, (1, 3, 3), (1, 1, 1), "SAME")
    filled_m = jnp.where(jnp.isinf(nearest), around, nearest)
    return looked_up(jnp.where(jnp.isinf(filled_m), depth_m[rows, 0], filled_m)), looked_up(
        depth_m[:, 1:].reshape(count, height, width))


def main(path: str = "builtin:town", windows: str = "16") -> None:
    run = muvo_jax.load(path)
    config, context, horizon = run.config, run.config.data.context, run.config.data.horizon
    recording = recordings.open_configured(config)
    labelled = sources.open_recording(record.cached_town(config), labels=frozenset({"depth_m"}))
    frames, look = pipeline.Frames(recording, config), jax.jit(
        lambda batch, depth_m: (errors.moved(run, batch)[0], *by_depth(run, batch, depth_m)))
    for split in (name for name in recording.description.splits if name != "train"):
        scores: dict[int, list[np.ndarray]] = {step: [] for step in errors.STEPS}
        for entry in pipeline.evaluation_batches(frames, split, windows=int(windows)):
            truth = np.asarray(entry.batch.time_slice(context, context + horizon).image) / 255.0
            guess = protocol.predict(run.model, run.variables, jax.random.key(0), entry.batch, context=context,
                                     horizon=horizon, sampled=False)["image"][:, context:]
            pictures = [guess, *(np.asarray(moved).reshape(truth.shape)
                                 for moved in look(entry.batch, recorded_depth_m(labelled, entry, config)))]
            for step, found in scores.items():
                true, *guesses = (picture[:entry.count, step - 1] for picture in (truth, *pictures))
                there_and_back = shifted(shifted(true, 0.5, 0.5), -0.5, -0.5)
                found.append(np.stack([psnr_db(image, true) for image in (
                    *guesses, best_shifts(guesses[1], true), there_and_back)]))
        for step, found in scores.items():
            model, newest, by_its_depth, by_depth_there, best, resampled = np.concatenate(found, axis=1).mean(axis=1)
            print(f"{split}  step {step}  model {model:.2f}, moved {newest:.2f}, with the best shifts {best:.2f}, by "
                  f"its depth {by_its_depth:.2f}, through the depth there {by_depth_there:.2f}; the truth half a pixel "
                  f"there and back {resampled:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
