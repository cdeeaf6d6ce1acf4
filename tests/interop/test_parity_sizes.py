"""Golden files of other sizes: what a file's arrays show goes before pack.json, and that before the sizes of seed 0."""

import json
import pathlib

import numpy as np
import pytest

from muvo_jax.interop.parity import (
    all_losses,
    cases,
    full_models,
    geometry,
    golden,
    losses,
    modules_1d,
    modules_2d,
    pooling,
    raw_batch,
    recordings,
    registry,
    runner,
)

ODD = pathlib.Path(__file__).parents[1] / "golden" / "odd_sizes"


def settings(folder, **sizes):
    (folder / "pack.json").write_text(json.dumps({"format": 1, "seed": 7, **sizes}))
    return golden.Settings(folder)


def shapes_only(folder, **shapes):
    """A context whose file holds zeros of the given shapes."""
    np.savez(folder / "p.npz", **{entry.replace("__", "/"): np.zeros(shape, np.float32)
                                  for entry, shape in shapes.items()})
    return cases.Context(golden.File(folder / "p.npz"), settings(folder))


def computed(folder, groups, sizes, more=None):
    """A file with what the groups compute for the sizes of pack.json, which are then forgotten."""
    np.savez(folder / "p.npz", **(more or {}))
    context = cases.Context(golden.File(folder / "p.npz"), settings(folder, **sizes))
    entries = {check.entry: np.asarray(check.got) for group in groups for check in group(context)}
    np.savez(folder / "p.npz", **entries, **(more or {}))
    return entries


def check(folder, groups, **sizes):
    report, lines = runner.Report(), []
    context = cases.Context(golden.File(folder / "p.npz"), settings(folder, **sizes))
    runner.run_file(cases.FileChecks("p", ("p",), groups), context, report, lines.append)
    assert not report.failed and not report.stopped, "\n".join([*lines, *report.stopped])
    return report


def test_losses_read_their_sizes_from_their_gradients(tmp_path):
    groups = (losses.regressions, losses.spatial, losses.scene_class_affinity, losses.chamfer)
    entries = computed(tmp_path, groups, {"p1": {
        "voxel_bsxyz": [2, 1, 6, 5, 4], "regression": [3, 2, 2], "regression_c4": [1, 2, 5], "spatial_hw": [7, 9],
        "chamfer_points": 30}})
    assert entries["sem_scal_c2/grad"].shape == (2, 1, 2, 6, 5, 4) and entries["cd_loss/grad"].shape == (2, 2, 30, 3)
    assert check(tmp_path, groups).passed == len(entries)


def test_geometry_reads_its_sizes_from_its_labels(tmp_path):
    """The range view and its labels, as well as the bytes of a depth image, are of sizes of their own."""
    groups = (geometry.network_inputs, geometry.optional_labels, geometry.halved_batch, recordings.birdviews)
    raw = {"image_hw": [150, 100], "route_hw": [64, 64]}
    entries = computed(tmp_path, groups, {"p2": raw | {
        "range_hw": [32, 512], "birdview_hw": [128, 128], "voxel_xyz": [16, 16, 8], "instance_hw": [8, 10],
        "halved_hw": [10, 16]}})
    assert entries["pre/range_view_seg_label_2"].shape == (1, 2, 1, 16, 256)
    assert entries["pre/voxel"].shape == (1, 2, 1, 16, 16, 8) and entries["pre/center_label_1"].shape[-1] == 128
    assert check(tmp_path, groups, p2=raw).passed == len(entries)


def test_clouds_depth_images_and_frusta_are_of_sizes_of_their_own(tmp_path):
    groups = (geometry.cameras, geometry.projection, recordings.range_views, recordings.depth_images, pooling.frusta)
    given = {"cloud_points": 400, "depth2pcd_hw": [9, 12]}
    entries = computed(tmp_path, groups, {"p2": given | {
        "range_hw": [16, 64], "carla_decode_hw": [48, 80], "birdview_hw": [130, 130], "frustum_full_batch": 1,
        "frustum_full": [1, 4, 6, 2, 8], "frustum_small": [1, 3, 5, 3, 16], "converted_points_xyz": [50, 3]}},
                       {"range/label_ambiguous": np.zeros((16, 64), bool)})
    assert entries["carla_decode/depth_m"].shape == (48, 80) and entries["convert_coor_lidar"].shape == (50, 3)
    assert entries["frustum/full_sparse_out_f64accum"].shape == (1, 2, 48, 48)
    assert check(tmp_path, groups, p2=given).passed == len(entries)


@pytest.mark.slow
def test_modules_read_their_sizes_from_their_outputs(tmp_path):
    groups = (modules_1d.compression, modules_1d.measurements, modules_1d.recurrent, modules_1d.transformer)
    entries = computed(tmp_path, groups, {"p3_1d": {
        "rssm": {"batch": 1, "steps": 3, "imagine": 2}, "tokens": [5, 1, 384], "image_feature_conv_hw": [6, 4],
        "lidar_feature_conv_hw": [2, 8], "lidar_state_conv_hw": [4, 8]}})
    assert entries["rssm_sample1/imagine/mu"].shape[:2] == (1, 2)
    assert check(tmp_path, groups).passed == len(entries)


def test_tokens_decoders_and_transitions_read_their_sizes_from_arrays(tmp_path):
    context = shapes_only(tmp_path, rssm_sample1__posterior__mu=(3, 4, 512), rssm_sample1__imagine__mu=(3, 5, 512),
                          voxel_decoder__voxel_1=(1, 2, 96, 64, 32))
    assert modules_1d.transition_sizes(context, "rssm", "p3_1d", "rssm") == (3, 4, 5)
    assert modules_1d.transition_sizes(context, "rssmtd48", "p3_2d", "rssmtd48") == (2, 6, 6)
    assert modules_2d._grid(context, "voxel_decoder/voxel_1", 16) == (6, 4, 2)


def test_the_raw_batch_of_whole_models_follows_what_the_pack_shows(tmp_path):
    context = shapes_only(tmp_path, in__range_view_pcd_xyzd=(1, 3, 4, 32, 512), in__voxel_label_4=(1, 3, 1, 8, 8, 4),
                          embedding=(1, 3, 512), imagine__action=(1, 2, 2))
    assert full_models._steps(context) == (3, 2)
    raw = raw_batch.draw_raw(context, *full_models._steps(context))
    assert raw["range_view_pcd_xyzd"].shape == (1, 3, 4, 32, 512) and raw["action"].shape == (1, 5, 2)
    assert raw["voxel"].shape == (1, 3, 1, 32, 32, 16)


def test_every_loss_term_takes_the_sizes_of_pack_json(tmp_path):
    np.savez(tmp_path / "p5_losses_all_1d.npz")
    sizes = {"p4": {"image_hw": [150, 100], "range_hw": [16, 64], "voxel_xyz": [8, 8, 4]},
             "p5": {"losses_all_sequence": 1, "birdview_hw": [128, 128]}}
    context = cases.Context(golden.File(tmp_path / "p5_losses_all_1d.npz"), settings(tmp_path, **sizes))
    labels = all_losses._labels(context)
    shapes = {name: labels[f"{name}_1"].shape[-2:] for name in ("range_view_label", "birdview_label")}
    assert shapes == {"range_view_label": (16, 64), "birdview_label": (128, 128)}
    assert labels["voxel_label_4"].shape == (1, 1, 1, 2, 2, 1) and labels["action"].shape == (1, 1, 2)


def test_mobilevit_on_maps_that_are_odd_gives_timms_numbers():
    """timm 1.0.31 on torch 2.13, weights by the rule: an image of 96x160, whose deepest map of 3x5 grows to 4x6."""
    lines = []
    report = runner.run_folder(ODD, registry.FILES, write=lines.append)
    assert report.ok and report.passed == 6, "\n".join(lines)
