"""Models that ship: they load by name, in float32, only as they were sealed."""

import json

import jax
import numpy as np
import pytest

import muvo_jax
from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.run import Run
from muvo_jax.training import builtin, checkpoint, validation


@pytest.fixture
def sealed(tmp_path, monkeypatch):
    """A run of fresh weights, sealed as builtin:small."""
    config = presets.tiny()
    model = world_model.WorldModel(config.model)
    run = Run(model, model.init(jax.random.key(0)), config, 7)
    monkeypatch.setattr(builtin, "FOLDER", tmp_path)
    builtin.seal(run, tmp_path / "small", {"data": {"name": "nothing"}})
    return run


def test_a_step_may_be_named_in_words_and_windows_are_counted_before_they_are_read(sealed):
    assert muvo_jax.load("builtin:small", "7").step == 7
    with pytest.raises(checkpoint.CheckpointError, match="has step 7 alone, not 8"):
        muvo_jax.load("builtin:small", "8")
    for count, frames in ((0, None), (2, 0), (2, -3), (1.5, None), (2, 2.0)):
        with pytest.raises(ValueError, match=f"count is {count}, frames is {frames}; expected whole numbers"):
            muvo_jax.windows("builtin:small", count=count, frames=frames)


def test_a_sealed_run_comes_back_with_parameters_to_eight_bits(sealed):
    loaded = muvo_jax.load("builtin:small")
    assert loaded.config == sealed.config and loaded.step == 7 and loaded.folder.name == "builtin-small"
    assert jax.tree.structure(loaded.variables) == jax.tree.structure(dict(sealed.variables))
    for stored, given in zip(jax.tree.leaves(loaded.variables), jax.tree.leaves(dict(sealed.variables)), strict=True):
        assert stored.dtype == np.float32
        np.testing.assert_allclose(stored, given, rtol=2**-8)
    for stored, given in zip(*(jax.tree.leaves(run.variables["batch_stats"]) for run in (loaded, sealed)), strict=True):
        np.testing.assert_array_equal(stored, given)


def test_unknown_names_and_steps_are_told(sealed):
    with pytest.raises(builtin.BuiltinError, match=r"there is small\. Did you mean builtin:small"):
        muvo_jax.load("builtin:smal")
    with pytest.raises(checkpoint.CheckpointError, match="has step 7 alone, not 8"):
        muvo_jax.load("builtin:small", 8)


@pytest.mark.parametrize("name", [builtin.WEIGHTS, builtin.CONFIG, builtin.CARD])
def test_damaged_files_are_named(sealed, name):
    path = builtin.FOLDER / "small" / name
    content = bytearray(path.read_bytes())
    content[-9] ^= 0xFF  # of the last weight, or inside the JSON
    path.write_bytes(content)
    with pytest.raises(builtin.BuiltinError, match=r"builtin:small is damaged .*Install muvo_jax again"):
        muvo_jax.load("builtin:small")
    path.unlink()
    with pytest.raises(builtin.BuiltinError, match=r"damaged|there is none"):
        muvo_jax.load("builtin:small")


def test_the_town_ships_whole_and_small():
    folder = builtin.FOLDER / "town"
    assert sum(path.stat().st_size for path in folder.iterdir()) < 8e6
    card = json.loads((folder / builtin.CARD).read_text())
    loaded = muvo_jax.load("builtin:town")
    assert jax.tree.map(np.shape, loaded.variables) == jax.tree.map(
        lambda leaf: leaf.shape, loaded.model.variable_shapes())
    for split in ("val_rl", "val_ds"):  # geometry is the baseline to beat
        model, warp = (card["imagined"][split][source]["iou_occ_above_observed"] for source in ("model", "warp_fused"))
        assert all(ours > theirs for ours, theirs in zip(model["per_step"], warp["per_step"], strict=True))


@pytest.mark.slow
def test_the_town_scores_what_its_card_says():
    """Recomputed on a few windows, recorded anew; what differs is the order of sums on another processor."""
    sample = json.loads((builtin.FOLDER / "town" / builtin.CARD).read_text())["sample"]
    found = validation.sample_scores(muvo_jax.load("builtin:town"), sample["windows"])
    assert found.keys() == sample["imagined"].keys()
    for name, score in found.items():
        assert score == pytest.approx(sample["imagined"][name], rel=0.005), name
