"""What public functions return has the shapes and dtypes that the docstrings of their types give, for both latents.

The docstrings are the table: an entry of `Attributes:` reads "names: dtype [axes]" or "names: Type [axes, ...]", where
"..." stands for the axes that whoever holds the value gives it. Nothing is compiled.
"""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import pytest

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.agents import rewards
from muvo_jax.model import world_model
from muvo_jax.types import BATCH_FIELDS, UNTIMED_FIELDS

BATCH, FRAMES, HORIZON, BRANCHES = 2, 3, 5, 7
ENTRY = re.compile(r"^([a-z_, ]+): (float32|int32|uint8|bool|typed keys|[A-Z][A-Za-z]+)(?: \[(.*?)\])?")
TOKENS = re.compile(r"; tokens \[(.*?)\] with the 2D latent")


@functools.cache
def documented(cls):
    """Field -> (dtype or type, its axes, its axes with the 2D latent, the whole entry), of a class's docstring."""
    section = re.split(r"\n\n", cls.__doc__.split("Attributes:\n")[1])[0]
    entries = re.sub(r"\n {8,}", " ", section).splitlines()
    found = {}
    for entry in map(str.strip, entries):
        if parsed := ENTRY.match(entry):
            names, kind, axes = parsed.groups()
            tokens = TOKENS.search(entry)
            found |= dict.fromkeys(names.split(", "), (kind, axes, tokens[1] if tokens else axes, entry))
    return found


def sizes_of(model):
    config, state = model.config, model.initial_state(1)
    sizes = {"B": BATCH, "T": FRAMES, "F": FRAMES, "M": BATCH * FRAMES, "P": model.policy_feature_channels,
             "H": config.image_size[0], "W": config.image_size[1], "Hr": config.range_view.rows,
             "Wr": config.range_view.columns, **dict(zip("XYZ", config.voxels.shape, strict=True))}
    if isinstance(config.latent, config_lib.TokenLatent):
        return sizes | dict(zip("NC", state.deterministic.shape[1:], strict=True))
    return sizes | {"D": state.deterministic.shape[1], "S": state.stochastic.shape[1]}


def check(value, lead, sizes, where=""):
    """Every field of a value, whose holder says that it has the axes `lead`, is as its class documents it."""
    for name in (field.name for field in dataclasses.fields(value)):
        part, path = getattr(value, name), f"{where}{type(value).__name__}.{name}"
        assert name in documented(type(value)), f"{path}: its docstring gives no shape"
        kind, axes, with_tokens, entry = documented(type(value))[name]
        if part is None:
            assert "None" in entry, f"{path} is None, which its docstring does not say"
            continue
        text = (with_tokens if "N" in sizes else axes) or ""
        shape = []
        for axis in filter(None, text.split(", ")):
            if axis == "...":
                shape += lead if not shape else ()
            else:
                shape.append(sizes[axis] if axis in sizes else int(axis))
        if isinstance(part, dict):
            assert all((leaf.dtype, leaf.shape) == (jnp.dtype(kind), (*shape,)) for leaf in part.values()), path
        elif dataclasses.is_dataclass(part):
            assert type(part).__name__ == kind, path
            check(part, shape if text else lead, sizes, f"{path} = ")
        elif kind == "typed keys":
            assert jax.dtypes.issubdtype(part.dtype, jax.dtypes.prng_key) and part.shape == (*shape,), path
        else:
            assert (part.dtype, part.shape) == (jnp.dtype(kind), (*shape,)), path


@pytest.fixture(scope="module", params=["1d", "2d"])
def setting(request):
    """Model with a memory, the shapes of its variables and of a batch, and the sizes of all axes."""
    config = config_lib.override_all(presets.get("tiny"), {
        "model.latent": request.param, "model.first_guess": "last_seen", "model.action_path": "recurrence",
        "model.convolution": "xla"})  # the plain convolutions trace fastest
    model = world_model.WorldModel(config.model)
    shape_of = lambda name, axes: jax.ShapeDtypeStruct(
        ((BATCH,) if name in UNTIMED_FIELDS else (BATCH, FRAMES)) + axes, BATCH_FIELDS[name][0])
    fields = {"action": (2,), "is_first": (), **world_model.inputs(model.config)}
    batch = types.Batch(**{name: shape_of(name, axes) for name, axes in fields.items()})
    return model, model.variable_shapes(), batch, sizes_of(model)


@pytest.fixture(scope="module")
def observed(setting):
    model, variables, batch, _ = setting
    return jax.eval_shape(functools.partial(muvo_jax.observe, model), variables, jax.random.key(0), batch)


def traced(function, setting, *args, **options):
    """What a public function (model, variables, key or what stands in its place, ...) returns, as shapes."""
    return jax.eval_shape(functools.partial(function, setting[0], **options), setting[1], *args)


def last_of(observed):
    return jax.eval_shape(lambda observed: observed.last, observed)


def actions(*lead):
    return jax.ShapeDtypeStruct((*lead, 2), jnp.float32)


def test_observe(setting, observed):
    check(observed, (), setting[-1])
    check(last_of(observed), (BATCH,), setting[-1])


def test_imagine(setting, observed):
    key, sizes = jax.random.key(0), setting[-1]
    dream = traced(muvo_jax.imagine, setting, key, last_of(observed), actions(BATCH, HORIZON))
    check(dream, (BATCH,), sizes | {"H": HORIZON})
    branched = traced(muvo_jax.imagine, setting, key, observed.states, actions(BATCH, FRAMES, BRANCHES, HORIZON))
    check(branched, (BATCH, FRAMES, BRANCHES), sizes | {"H": HORIZON})


def test_a_step_of_imagination_and_of_a_stream(setting, observed):
    model, _, batch, sizes = setting
    after = traced(muvo_jax.imagine_step, setting, jax.random.key(0), observed.states, actions(BATCH, FRAMES))
    check(after, (BATCH, FRAMES), sizes)
    begun = jax.eval_shape(lambda: muvo_jax.start_live(model, jax.random.key(0), BATCH))
    places = sizes | {"F": model.config.first_guess.memory_frames + 1}
    check(begun, (), places)
    seen = {name: jax.ShapeDtypeStruct(leaf.shape if name in UNTIMED_FIELDS else (BATCH, *leaf.shape[2:]), leaf.dtype)
            for name in world_model.inputs(model.config) if (leaf := getattr(batch, name)) is not None}
    check(traced(muvo_jax.observe_step, setting, begun, seen, actions(BATCH)), (), places)


def test_decode(setting, observed):
    config = setting[0].config
    sides = {"image": (config.image_size, 3), "occupancy": (config.voxels.shape, 2),
             "range_view": ((config.range_view.rows, config.range_view.columns), 4)}
    expected = {head: {scale: (*(side // scale for side in size), channels) for scale in (1, 2, 4)}
                for head, (size, channels) in sides.items()} | {"action": {1: (2,)}}
    decoded = jax.eval_shape(functools.partial(muvo_jax.decode, setting[0]), setting[1], observed.states,
                             memory=observed.memory)
    assert decoded.arrays == {head: {scale: jax.ShapeDtypeStruct((BATCH, FRAMES, *axes), jnp.float32)
                                     for scale, axes in scales.items()} for head, scales in expected.items()}


def test_an_episode(setting, observed):
    model, variables, batch, sizes = setting
    environment = muvo_jax.Environment(model, observation="features", reward_config=rewards.RewardConfig())

    def episode(variables, observed, batch, key, action):
        starts = environment.starts(observed, batch)
        params = environment.params(variables, starts, HORIZON)
        observation, state = environment.reset(key, params)
        return starts, observation, state, environment.step(key, state, action, params)

    starts, observation, state, (after, transition) = jax.eval_shape(
        episode, variables, observed, batch, jax.random.key(0), actions())
    check(starts, (), sizes)
    assert observation == environment.observation_shapes == jax.ShapeDtypeStruct((sizes["P"],), jnp.float32)
    check(state, (), sizes)
    check(after, (), sizes)
    check(transition, (), sizes)


def test_a_batch_is_documented_as_it_validates():
    table = documented(types.Batch)
    assert set(table) == set(BATCH_FIELDS)
    for name, (dtype, rank) in BATCH_FIELDS.items():
        kind, axes, *_ = table[name]
        assert (jnp.dtype(kind), len(axes.split(", "))) == (dtype, rank), name
