"""How many samples a picture is made of: stored with a set, whose frames all follow one rule.

Imports no renderer: what a set was asked for is compared before one is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LAMPS_BELOW_DEG = 0.0
"""Sun elevation under which lamps burn and windows are lit."""
NIGHT_SAMPLES = 2
"""Where lamps burn, so many times the samples: each picks one of several small lights. Of a country
road that only headlights reach, 2 samples a pixel left 1.8 times the true power in an octave, 4
left 1.2."""
FEATURE_SPP = 16
"""of the first-hit pass that measures albedo, normals, distance and coverage"""
MAX_DEPTH = 4
"""of a path"""


def rule(spp: int) -> dict[str, int]:
    """What ``--spp`` means in this version: samples per pixel by day and by night, and the rest."""
    return {
        "day_spp": spp,
        "night_spp": NIGHT_SAMPLES * spp,
        "features_spp": FEATURE_SPP,
        "max_depth": MAX_DEPTH,
    }


def of_frame(stored: Mapping[str, Any], *, night: bool) -> dict[str, Any]:
    """What a frame's spec holds under a set's rule."""
    rest = {k: v for k, v in stored.items() if k not in ("day_spp", "night_spp")}
    return {"spp": stored["night_spp" if night else "day_spp"], **rest}


def in_words(config: Mapping[str, Any]) -> str:
    """The rule of a set by its stored configuration; sets of older versions tell of days only."""
    if (stored := config.get("samples")) is None:
        return f"{config['spp']} by day; where lamps burn as each frame's spec says"
    return f"{stored['day_spp']}, {stored['night_spp']} where lamps burn"
