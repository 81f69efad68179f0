"""Weights in files: safetensors with the network's config in the header. Nothing is unpickled.

The header's metadata holds ``format`` (which says what network it is), ``config`` (JSON of
ModelConfig, or of the rival's) and ``card`` (JSON of :class:`Card`: where the weights come from and
what they were trained for), so a file is enough to build the network again.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from flowrect.config import ModelConfig
from flowrect.model import Rectifier
from flowrect.rivals import build
from flowrect.rivals.config import RIVALS, RivalConfig
from simgen.errors import UserError

if TYPE_CHECKING:
    from flowrect.rivals import Rival

    PoseNetwork = Rectifier | Rival

FORMAT = "flowrect-weights-1"
_MEANING = {"vitpose": 2}
"""of rivals whose weights mean something else than at first: vitpose's first layer is divided"""
_CONFIGS: dict[str, type[ModelConfig | RivalConfig]] = {
    FORMAT: ModelConfig,
    **{f"flowrect-{n}-{_MEANING.get(n, 1)}": type(config) for n, config in RIVALS.items()},
}
"""what a file of each format describes"""
_LATER = {"passes"}
"""fields of ModelConfig whose default is what networks did before there was a field"""
SHIPPED = Path(__file__).with_name("weights_data")


@dataclass(frozen=True)
class Card:
    """What is known of trained weights."""

    preset: str
    """paper, small or a rival's name, or "custom" where a field differs"""
    prior_range_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """largest |R_gt R_priorᵀ| about x, y, z seen in training"""
    samples: int = 0
    """pairs seen in training"""
    hours: float = 0.0
    """that this took; 0: nobody noted them"""
    data: str = ""
    """what they were trained on"""
    translation: str = ""
    """gt or nominal: which t the prior had"""
    fit: Literal["crop", "stretch"] = "crop"
    """how images were fitted to the input, see flowrect.resize.Sizing"""
    keep: float = 1.0
    """share of the window that was kept"""
    least_match_probability: float = 0.0
    """mean probability of the most probable matches below which two images hardly show one scene,
    measured on pairs and on mixed ones; 0: nobody measured it"""


def save_weights(path: Path, model: PoseNetwork, card: Card) -> None:
    """Writes a file that ``load_weights`` reads, atomically."""
    config = model.config
    tensors = {name: x.detach().cpu().contiguous() for name, x in model.state_dict().items()}
    metadata = {
        "format": next(f for f, kind in _CONFIGS.items() if kind is type(config)),
        "config": json.dumps(asdict(config)),
        "card": json.dumps(asdict(card)),
    }
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, metadata)
    os.replace(partial, path)


def load_weights(
    path: Path, *, expected: ModelConfig | RivalConfig | None = None
) -> tuple[PoseNetwork, Card]:
    """The network of a file, in evaluation mode on the CPU, and its card.

    Args:
      path: a file of ``save_weights``.
      expected: the config that the network must have; any if not given. A Rectifier takes images of
        any size, so that ``input_wh`` may be another one than it was trained with.

    Raises:
      UserError: not such a file, or not weights of that network.
    """
    config, card = _read_header(path)
    if expected is not None:
        if isinstance(config, ModelConfig) and isinstance(expected, ModelConfig):
            config = replace(config, input_wh=expected.input_wh)
        if config != expected:
            raise UserError(
                f"{path} holds weights of another network: {_differences(config, expected)}. "
                "Choose the preset and the fields that it was trained with, or other weights."
            )
    model = untrained(config)
    tensors = load_file(path)
    _check_tensors(path, tensors, model.state_dict())
    model.load_state_dict(tensors)
    return model.eval(), card


def untrained(config: ModelConfig | RivalConfig) -> PoseNetwork:
    """The network of a config, with random weights."""
    return Rectifier(config) if isinstance(config, ModelConfig) else build(config)


def find_weights(name_or_path: str | Path) -> Path:
    """The file of shipped weights of that name, or the path itself."""
    path = Path(name_or_path)
    if path.is_file():
        return path
    shipped = SHIPPED / f"{name_or_path}.safetensors"
    if shipped.is_file():
        return shipped
    names = sorted(p.stem for p in SHIPPED.glob("*.safetensors") if _format_of(p) in _CONFIGS)
    raise UserError(
        f"weights {str(name_or_path)!r}: expected a file or one of the shipped "
        f"{names or 'names (there are none here)'}; check the spelling, or train some with "
        "python -m flowrect.train."
    )


def config_from_json(
    text: str, kind: type[ModelConfig | RivalConfig] = ModelConfig
) -> ModelConfig | RivalConfig:
    """A config of its JSON; ValueError if a field is missing, unknown or of the wrong type.

    Fields of ``_LATER`` may be missing: there were networks before them.
    """
    names, given = {f.name for f in fields(kind)}, set(json.loads(text))
    odd = (names ^ given) - (_LATER - given)
    if odd:
        raise ValueError(f"fields {sorted(odd)} are on one side only")
    config: ModelConfig | RivalConfig = TypeAdapter(kind).validate_json(text)
    return config


def _format_of(path: Path) -> str | None:
    with safe_open(path, framework="pt") as file:
        return (file.metadata() or {}).get("format")


def _read_header(path: Path) -> tuple[ModelConfig | RivalConfig, Card]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except SafetensorError as error:
        raise UserError(
            f"{path} is no safetensors file ({error}). Pickles (.pt, .pth, .ckpt) are refused, "
            "since reading one runs the code in it; expected a file written by flowrect.train."
        ) from error
    kind = _CONFIGS.get(metadata.get("format", ""))
    if kind is None:
        raise UserError(
            f"{path}: expected format {FORMAT!r} in its header, found {metadata.get('format')!r}; "
            "written by another program or version? Use weights written by flowrect.train."
        )
    try:
        card = TypeAdapter(Card).validate_json(metadata["card"])
        return config_from_json(metadata["config"], kind), card
    except (KeyError, ValueError, ValidationError) as error:
        raise UserError(
            f"{path}: its header does not describe a network that this version builds ({error}); "
            "written by another version? Train again, or use that version."
        ) from error


def _differences(found: ModelConfig | RivalConfig, expected: ModelConfig | RivalConfig) -> str:
    """``channels is 64, expected 128; …``"""
    if type(found) is not type(expected):
        return f"a {type(found).__name__}, expected a {type(expected).__name__}"
    a, b = asdict(found), asdict(expected)
    return "; ".join(f"{k} is {a[k]!r}, expected {b[k]!r}" for k in a if a[k] != b[k])


def _check_tensors(path: Path, found: dict[str, Tensor], expected: dict[str, Any]) -> None:
    """Raises where names or shapes differ, naming the first."""
    for name in sorted(found.keys() | expected.keys()):
        have = tuple(found[name].shape) if name in found else "absent"
        want = tuple(expected[name].shape) if name in expected else "absent"
        if have != want:
            raise UserError(
                f"{path}: tensor {name!r} is {have}, expected {want}; the file does not fit its "
                "own header. Damaged? Use another copy."
            )
