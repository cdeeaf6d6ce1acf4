"""Image networks trained elsewhere (on ImageNet, usually): a start for a model's encoders, or the perceptual network.

Names are those of torchvision and timm for ResNet-18, of timm for MobileViT-V2 (`stages.2.1...`, or `stages_2.1...` as
its feature extractor has them). Nothing is downloaded; docs/variants.md says where the files come from.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import checkpoints, names
from muvo_jax.nn import layers, mobilevit, norm, resnet
from muvo_jax.objectives import perceptual

_NETWORKS: dict[str, type[resnet.ResNet18] | type[mobilevit.MobileVit]] = {
    "resnet18": resnet.ResNet18, "mobilevitv2_100": mobilevit.MobileVit}
_LEVELS, _WIDTH = (1, 2, 3, 4), 64
_LANDMARKS = {"resnet18": "layer1.0.conv1.weight", "mobilevitv2_100": "stages_1.0.conv1_1x1.conv.weight"}
_FIRST = {"resnet18": "conv1.weight", "mobilevitv2_100": "stem.conv.weight"}
_UNUSED = re.compile(r"^(fc|head|classifier|final_conv)\b|num_batches_tracked$")
# Where a model has a backbone; the last three are a ResNet-18 whatever model.backbone says.
_PLACES = (("camera", "backbone"), ("lidar", "backbone"), ("lidar", "pillar_backbone"), ("route", "backbone"),
           ("fusion", "map_backbone"))


class BackboneError(ValueError):
    """The file holds no such network, or one of another size; the message names file, what was expected and found."""


@dataclasses.dataclass(frozen=True)
class Backbone:
    """A network from a file.

    Attributes:
      path: of the file.
      kind: "resnet18" or "mobilevitv2_100".
      tensors: timm's name -> array, torch layout.
    """

    path: pathlib.Path
    kind: str
    tensors: Mapping[str, np.ndarray]


def read(path: pathlib.Path | str) -> Backbone:
    """Reads a .pth or .safetensors file.

    Raises:
      TorchFileError, SafetensorsError, CheckpointMismatch: for a file that cannot be read or holds no tensors by name.
      BackboneError: where they are of another network.
    """
    stored = checkpoints.read(path)
    tensors = {re.sub(r"(^|\.)stages\.(\d)", r"\1stages_\2", key): value for key, value in stored.state_dict.items()}
    found = [(kind, key.removesuffix(landmark)) for kind, landmark in _LANDMARKS.items() for key in tensors
             if f".{key}".endswith(f".{landmark}")]
    if len(found) > 1:
        raise BackboneError(f"{path}: expected one image network, found {len(found)}: "
                            f"{', '.join(f'{kind} under {prefix!r}' for kind, prefix in found[:4])}. Take a file that "
                            f"holds one of them.")
    if not found:
        raise BackboneError(f"{path}: expected a ResNet-18 or MobileViT-V2 in torchvision's or timm's names (such as "
                            f"{' or '.join(_LANDMARKS.values())}), found {len(tensors)} tensors such as "
                            f"{', '.join(list(tensors)[:4])}.")
    kind, prefix = found[0]  # a wrapper's name, such as "module." or "backbone."; what lies beside it is not asked for
    tensors = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    wanted = {key for key, _, _ in _entries(_shapes(kind))}
    odd = sorted(key for key in tensors if key not in wanted and not _UNUSED.search(key))
    absent = sorted(wanted - tensors.keys())
    if odd or absent:
        raise BackboneError(f"{path}: looks like {kind} but is another network: expected {len(wanted)} tensors, "
                            f"{len(absent)} are missing ({', '.join(absent[:4]) or 'none'}), {len(odd)} are strange "
                            f"({', '.join(odd[:4]) or 'none'}).")
    return Backbone(pathlib.Path(path), kind, tensors)


def check(backbone: Backbone, config: config_lib.ModelConfig) -> None:
    """Raises BackboneError where a model's image encoder is another network than the file's, or of another width."""
    if backbone.kind != config.backbone:
        raise BackboneError(f"{backbone.path}: holds {backbone.kind}, the model's image encoder is {config.backbone}. "
                            f"Choose --backbone={backbone.kind}, or another file.")
    if config.backbone_width != _WIDTH:
        raise BackboneError(f"{backbone.path}: a network of full width (its {_FIRST[backbone.kind]} is "
                            f"{list(backbone.tensors[_FIRST[backbone.kind]].shape)}), but the model expected "
                            f"model.backbone_width={config.backbone_width}. Choose --set model.backbone_width={_WIDTH} "
                            f"(the presets paper and reference-* have it).")


def load_into(variables: Mapping[str, Any], backbone: Backbone,
              config: config_lib.ModelConfig) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Fresh variables with the backbone's weights wherever the model has such a network.

    Returns:
      the variables (float32 NumPy), and what was loaded, a sentence for each place.

    Raises:
      BackboneError: where the image encoder is another network, or a size differs.
    """
    check(backbone, config)
    filled, notes = jax.tree.map(np.asarray, {part: dict(tree) for part, tree in variables.items()}), []
    for module, name in _PLACES:
        kind = config.backbone if name == "backbone" and module != "route" else "resnet18"
        if kind != backbone.kind or name not in filled["params"].get(module, {}):
            continue
        shapes = {part: filled[part][module][name] for part in ("params", "batch_stats")}
        found = _filled(backbone, shapes, f"{module}/{name}")
        for part, tree in found.items():
            filled[part] = filled[part] | {module: filled[part][module] | {name: tree}}
        channels = next(leaf.shape[-2] for key, _, leaf in _entries(shapes) if key == _FIRST[kind])
        adapted = f", first convolution from 3 to {channels} channels" if channels != 3 else ""
        notes.append(f"{module}/{name}: {kind}, {len(jax.tree.leaves(found))} arrays{adapted}")
    return filled, tuple(notes)


def frozen_encoder(backbone: Backbone) -> perceptual.FrozenEncoder:
    """The network of the perceptual loss from a file: all four levels, as the reference's ResNet-18."""
    network = _NETWORKS[backbone.kind](_WIDTH, _LEVELS)
    return perceptual.FrozenEncoder(network, _filled(backbone, _shapes(backbone.kind), "the perceptual network"),
                                    f"{backbone.kind} of {backbone.path}")


def frozen_encoder_of_run(variables: Mapping[str, Any], config: config_lib.ModelConfig,
                          source: str) -> perceptual.FrozenEncoder:
    """The image encoder of one of our models, frozen, as the network of the perceptual loss.

    Raises:
      BackboneError: where the model has no camera.
    """
    if "camera" not in variables["params"]:
        raise BackboneError(f"{source}: its model has no camera, so no image encoder to compare pictures by. Take a "
                            f"run with a camera, or a file of ImageNet weights.")
    network = _NETWORKS[config.backbone](config.backbone_width, _LEVELS)
    part = {name: jax.tree.map(np.asarray, dict(variables[name]["camera"]["backbone"]))
            for name in ("params", "batch_stats")}
    return perceptual.FrozenEncoder(network, part, f"the image encoder of {source}")


def _shapes(kind: str) -> Any:
    """{"params": ..., "batch_stats": ...} of the whole network at full width, for pictures."""
    network = _NETWORKS[kind](_WIDTH, _LEVELS, layers.Compute(convolution="xla"))
    return jax.eval_shape(lambda: network.init(jax.random.key(0), jnp.zeros((1, 64, 64, 3)), norm.Mode()))


def _entries(tree: Any) -> Iterator[tuple[str, tuple, Any]]:
    """(timm's name, path, leaf) of every variable of a backbone."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        inner = "/".join(part.key for part in path[1:])
        yield names.reference_key(f"camera/backbone/{inner}").removeprefix("encoder."), path, leaf


def _filled(backbone: Backbone, shapes: Any, where: str) -> Any:
    """A tree of these shapes with the file's numbers in our layout."""
    first = _FIRST[backbone.kind]

    def value(key: str, path: tuple, leaf: Any) -> np.ndarray:
        found = np.asarray(backbone.tensors[key], np.float32)
        if key == first:
            found = _adapt_channels(found, leaf.shape[-2])
        ours = names.to_our_layout(path[-1].key, leaf.shape, found)
        if ours.shape != leaf.shape:
            expected = names.reference_shape(path[-1].key, leaf.shape)
            raise BackboneError(f"{backbone.path}: {key} is {list(backbone.tensors[key].shape)}, {where} expected "
                                f"{list(expected)}. Take the network of ImageNet's size.")
        return np.ascontiguousarray(ours)

    leaves = [value(*entry) for entry in _entries(shapes)]
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def _adapt_channels(kernel: np.ndarray, channels: int) -> np.ndarray:
    """[O, 3, k, k] -> [O, channels, k, k] as timm: the filters repeated, at a sum that stays the same."""
    given = kernel.shape[1]
    if channels == given:
        return kernel
    repeated = np.tile(kernel, (1, math.ceil(channels / given), 1, 1))[:, :channels]
    return repeated * np.float32(given / channels)
