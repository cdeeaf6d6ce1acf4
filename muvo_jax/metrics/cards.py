"""Protocol cards: how something was judged, under a name, so that two numbers with one name can be compared.

A card is a TOML file of muvo_jax/cards, or of anyone's: the settings that a score depends on, the recording and the
splits, the list of samples by its fingerprint, where motion comes from, and what each metric means in words.
"""

from __future__ import annotations

import dataclasses
import pathlib
import tomllib
from collections.abc import Mapping
from typing import Any, Literal

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax.config import settings
from muvo_jax.metrics import protocol

FOLDER = pathlib.Path(__file__).parent.parent / "cards"
NONE = "no card"


@dataclasses.dataclass(frozen=True)
class Samples:
    """Of one split.

    Attributes:
      windows: how many.
      fingerprint: data.windows.fingerprint of them.
    """

    windows: int = 0
    fingerprint: str = ""


@dataclasses.dataclass(frozen=True)
class Card:
    """A protocol.

    Attributes:
      name: as it was asked for: of the package's, or the path of one's own file.
      about: what it judges, in a sentence.
      protocol: protocol.VERSION whose definitions it means.
      recording: kind of recording (RecordingDescription.kind) that it is for, or its data.path; "" for any.
      splits: those that it judges; () for all that a recording has.
      windows: of a split, evenly spread; 0 for all.
      motion: where the motion of the moved frames comes from (metrics/warp.py); "any" is what the recording offers.
      notes: what whoever compares must know.
      metrics: name -> definition. Other scores do not go under the card's name.
      requires: dotted name -> value, of config.Config, that a run must have been trained with.
      settings: the same of what can be changed after training: a run is judged with these values.
      samples: split -> its samples; a split without them has no list that could be compared.
    """

    name: str
    about: str = ""
    protocol: str = ""
    recording: str = ""
    splits: tuple[str, ...] = ()
    windows: int = 0
    motion: Literal["actions", "recorded", "any"] = "any"
    notes: tuple[str, ...] = ()
    metrics: Mapping[str, str] = dataclasses.field(default_factory=dict)
    requires: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    samples: Mapping[str, Samples] = dataclasses.field(default_factory=dict)

    def applied(self, config: config_lib.Config, chosen: Mapping[str, Any]) -> config_lib.Config:
        """A trained run's config, judged as the card says.

        Args:
          config: of the run, with what was chosen.
          chosen: dotted names -> values that the command line asked for; these samples, not other rules.

        Raises:
          ValueError: where something else was chosen than the card says, or the run cannot be judged so.
        """
        for name, value in _differing(config, self.requires).items():
            raise ValueError(f"card {self.name} is for runs with {name}={self.requires[name]}, but this one was "
                             f"trained with {value}. Train one with that, or judge this one without the card.")
        for name, value in self.settings.items():
            if name in chosen and chosen[name] != value:
                raise ValueError(f"card {self.name} says {name}={value}, but {chosen[name]} was chosen. Leave one of "
                                 f"the two out.")
        heads = [name for name, frames in head_lib.shown().items() if frames.metrics.keys() & self.metrics]
        if not set(heads) & set(config.model.heads):
            raise ValueError(f"card {self.name} scores {', '.join(heads)}, but the run's heads are "
                             f"{', '.join(config.model.heads)}.")
        config = config_lib.override_all(config, self.settings)
        windows = chosen.get("evaluation.windows", self.windows)
        return config_lib.override(config, "evaluation.windows", windows)

    def foreign(self, config: config_lib.Config, kind: str) -> str:
        """What is wrong with the recording of this kind that a config was fitted to; "" for nothing."""
        if self.recording not in ("", kind, config.data.path):
            return f"card {self.name} is for {self.recording}, but the recording {config.data.path} is {kind}."
        source = "actions" if config.contract.kinematics == "bicycle" else "recorded"
        if self.motion not in (source, "any"):
            return (f"card {self.name} has the motion from {self.motion}, but of the recording {config.data.path} it "
                    f"is {source}.")
        return ""

    def label(self, split: str, samples: Samples) -> str:
        """The name that numbers of these samples carry."""
        ours = (not self.splits or split in self.splits) and self.samples.get(split, samples) == samples
        return self.name if ours else f"{self.name}, other samples"


def _differing(config: config_lib.Config, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the settings that have another value, and which."""
    values = settings.names(dataclasses.asdict(config))
    as_stored = lambda value: tuple(value) if isinstance(value, list) else value
    return {name: values.get(name) for name, value in wanted.items() if values.get(name) != as_stored(value)}


def known() -> tuple[str, ...]:
    """Names of the cards that the package has."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load(name: str) -> Card:
    """A card of the package by its name, or one's own by the path of its .toml file.

    Raises:
      ValueError: for an unknown name (naming the nearest), a file that is no card, or one of another protocol version.
      OSError: where the file cannot be read.
    """
    path = pathlib.Path(name).expanduser()
    if path.suffix != ".toml":
        config_lib.check_choice("card", name, known())
        path = FOLDER / f"{name}.toml"
    try:
        values = {"name": name, **tomllib.loads(path.read_text(encoding="utf-8-sig"))}
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from error
    card = config_lib.parse(Card, values, str(path))
    if card.protocol != protocol.VERSION:
        raise ValueError(f"{path} is a card of protocol {card.protocol}; this version judges by {protocol.VERSION}.")
    known_settings = tuple(settings.names(dataclasses.asdict(config_lib.Config())))
    for setting in (*card.requires, *card.settings):
        config_lib.check_choice(f"{path}: settings", setting, known_settings)
    for metric in card.metrics:
        config_lib.check_choice(f"{path}: metrics", metric, tuple(head_lib.metrics()))
    return card


def label(config: config_lib.Config, kind: str, split: str, samples: Samples) -> str:
    """What numbers of one split are called where no card was asked for: by the one of the package whose rules and
    samples they follow all the same."""
    for card in map(load, known()):
        strange = card.foreign(config, kind) or _differing(config, {**card.requires, **card.settings})
        if card.samples.get(split) == samples and not strange:
            return card.name
    return NONE


def defined(card: Card, scores: Mapping[str, Any]) -> dict[str, Any]:
    """Scores as protocol.evaluate returns them, without those that the card does not define."""
    kept = lambda metrics: {name: value for name, value in metrics.items() if name in card.metrics}
    return {name: {source: kept(metrics) for source, metrics in value.items()} if name in protocol.PHASES else value
            for name, value in scores.items()}
