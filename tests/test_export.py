"""A sealed model runs where muvo_jax cannot be imported, and gives the same numbers."""

import dataclasses
import json
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import export, presets
from muvo_jax.model import live, rollout, world_model
from muvo_jax.training import screen

PROGRAM = """
import json, pathlib, sys
sys.modules["muvo_jax"] = None  # an import of it would fail
import jax, jax.export, numpy as np
from safetensors.numpy import load_file
folder = pathlib.Path(sys.argv[1])
weights = load_file(folder / "weights.safetensors")
given = dict(np.load(folder / "given.npz"))
call = lambda name, *args: jax.export.deserialize(bytearray((folder / f"{name}.bin").read_bytes())).call(weights, *args)
part = lambda prefix: {name[len(prefix):]: value for name, value in given.items() if name.startswith(prefix)}
seen = call("observe_step", part("live/"), part("observation/"), given["previous_action"])
memory = {name.removeprefix("memory/"): value for name, value in seen.items() if name.startswith("memory/")}
parts = ("deterministic", "stochastic", "vantage")
state = {name: value for name, value in seen.items() if name.split("/")[0] in parts}
dream = call("imagine", given["keys"], state, given["actions"], np.float32(1))
last = {name: value[:, -1] for name, value in dream.items()}
np.savez(folder / "out.npz", frame=seen["frame"], **dream, action=call("decode_action", last),
         **({head: call(f"decode_{head}", last, memory) for head in ("image", "occupancy")} if memory else {}))
"""


# One that remembers what was seen takes its memory along, as arrays among the others.
REMEMBERING = {"first_guess": config_lib.LastSeen(memory_frames=2, guided_channels=(8, 8, 8)),
               "action_path": "recurrence", "route": False}


@pytest.mark.parametrize(("heads", "changes"), [(("action",), {}), (("image", "occupancy", "action"), REMEMBERING)])
def test_a_sealed_model_gives_the_same_numbers_without_the_library(tmp_path, heads, changes):
    pytest.importorskip("flatbuffers", reason="flatbuffers (extra [export]) is not installed")
    pytest.importorskip("safetensors", reason="safetensors (extra [export]) is not installed")
    config = presets.get("tiny")
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, heads=heads, **changes))
    model = world_model.WorldModel(config.model)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    written = export.seal(model, variables, config, tmp_path, horizon=3)
    assert {path.name for path in written} == {
        "observe_step.bin", "imagine.bin", *(f"decode_{head}.bin" for head in heads), "weights.safetensors",
        "config.json", "contract.json", "signatures.json"}
    signatures = json.loads((tmp_path / "signatures.json").read_text())
    assert signatures["functions"]["imagine"]["arguments"][2] == "float32[b, 3, 2]"
    assert json.loads((tmp_path / "contract.json").read_text())["wheelbase_m"] == config.contract.wheelbase_m

    random = np.random.default_rng(0)
    stream = live.start_live(model, jax.random.key(1), 3)
    observation = {name: random.uniform(0, 20, (3, *leaf.shape)).astype(leaf.dtype)
                   for name, leaf in export.inputs(config).items()}
    keys = jax.random.split(jax.random.key(2), 3)
    actions = random.uniform(-1, 1, (3, 3, 2)).astype(np.float32)
    given = {"previous_action": np.zeros((3, 2), np.float32), "actions": actions, "keys": jax.random.key_data(keys),
             "live/keys": jax.random.key_data(stream.keys), "live/frame": stream.frame}
    given |= {f"live/{name}": value for name, value in export.to_arrays(stream.latent).items()}
    given |= {f"live/memory/{name}": value for name, value in export.to_arrays(stream.memory).items()}
    given |= {f"observation/{name}": value for name, value in observation.items()}
    np.savez(tmp_path / "given.npz", **given)
    subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], check=True, cwd=tmp_path)

    example = pathlib.Path(__file__).parents[1] / "examples" / "sealed.py"
    shown = subprocess.run([sys.executable, example, str(tmp_path)], check=True, cwd=tmp_path, capture_output=True)
    assert all(f"decode_{head} after 3 steps: (2, ".encode() in shown.stdout for head in heads)

    stream = live.observe_step(model, variables, stream, observation, given["previous_action"])
    dream = rollout.imagine(model, variables, keys, stream.latent, actions)
    out = np.load(tmp_path / "out.npz")
    assert out["frame"].tolist() == [1, 1, 1]
    np.testing.assert_allclose(out["stochastic"], dream.states.stochastic, atol=1e-4)
    want = rollout.decode(model, variables, dream.states[:, -1], heads, memory=stream.memory)
    for head in heads:
        np.testing.assert_allclose(out[head], want[head], atol=1e-3)


def test_flattening_has_an_inverse():
    tree = {"params": {"a": {"b": 1, "c": 2}}, "batch_stats": {"d": 3}}
    assert export.flatten(tree) == {"params/a/b": 1, "params/a/c": 2, "batch_stats/d": 3}
    assert export.unflatten(export.flatten(tree)) == tree


def test_a_horizon_of_nothing_is_refused(tmp_path):
    pytest.importorskip("safetensors", reason="safetensors (extra [export]) is not installed")
    with pytest.raises(ValueError, match="horizon is 0"):
        export.seal(world_model.WorldModel(presets.get("tiny").model), {}, presets.get("tiny"), tmp_path, horizon=0)


def test_a_place_that_is_no_folder_is_told_before_the_run_is_read(tmp_path):
    pytest.importorskip("flatbuffers", reason="flatbuffers (extra [export]) is not installed")
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"OUT: .*/file is a file; name a new folder"):
        export.export(export.Options(tmp_path / "run", tmp_path / "file"), screen.Screen())
    with pytest.raises(OSError, match=r"OUT: nothing can be written into .*/file/below"):
        export.export(export.Options(tmp_path / "run", tmp_path / "file/below"), screen.Screen())
