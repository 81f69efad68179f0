"""Whether a network's matches tell pairs from images of two scenes, and where the line lies.

    python benchmarks/match_probability.py --data train/ --weights runs/small/last.safetensors

Mean probability of the most probable matches (``Estimate.match_probability``) of pairs, and of the
same left images with the right one of another scene. If all pairs have more than all others, the
middle between them is what ``Card.least_match_probability`` should be; ``--write`` puts it there.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from _table import markdown
from rich.progress import track

from flowrect.estimate import load_model
from flowrect.evaluation.delivered import Delivery
from flowrect.sample import Pair
from flowrect.weights import find_weights, save_weights
from simgen.errors import UserError


@dataclass(frozen=True)
class Options:
    """Looks at pairs, and at the same with the right image of another scene."""

    data: Path
    """a set of simgen"""
    weights: str = "small"
    split: str = "train"
    """test pairs should not choose a threshold"""
    limit: int = 60
    """pairs, evenly chosen"""
    write: bool = False
    """write the threshold into the card of the weights"""


def partners(scenes: list[str]) -> list[int]:
    """For each pair the next one, around the end, of another scene."""
    num = len(scenes)
    found = []
    for i, scene in enumerate(scenes):
        others = [j % num for j in range(i + 1, i + num) if scenes[j % num] != scene]
        if not others:
            raise UserError("all pairs are of one scene; expected two at least.")
        found.append(others[0])
    return found


def threshold(true: np.ndarray, mixed: np.ndarray) -> float | None:
    """The middle between the least true and the largest mixed probability; None if they overlap."""
    return float((true.min() + mixed.max()) / 2) if true.min() > mixed.max() else None


def probabilities(weights: str, pairs: list[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """Of pairs, and of mixed ones."""
    model = load_model(weights)

    def probability(left: Pair, right: Pair) -> float:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = model.estimate(left.left, right.right, left.K_left, right.K_right,
                                   left.T_right_left_nominal).match_probability  # fmt: skip
        if found is None:
            raise UserError(f"{weights}: such a network has no matches.")
        return found

    other = [pairs[j] for j in partners([p.scene for p in pairs])]
    true = [probability(p, p) for p in track(pairs, "pairs")]
    mixed = [probability(p, q) for p, q in track(list(zip(pairs, other, strict=True)), "mixed")]
    return np.array(true), np.array(mixed)


def main(options: Options) -> None:
    """Prints both distributions and the threshold."""
    delivered = Delivery(options.data, options.split, (512, 256), options.limit).open()  # type: ignore[arg-type]
    true, mixed = probabilities(options.weights, [p.input for p in delivered])
    rows = [[name, len(x), *(f"{v:.3f}" for v in np.quantile(x, (0, 0.05, 0.5, 0.95, 1)))]
            for name, x in (("pairs", true), ("of two scenes", mixed))]  # fmt: skip
    print(markdown(["", "number", "least", "5 %", "median", "95 %", "largest"], rows))
    least = threshold(true, mixed)
    if least is None:
        print("they overlap: no threshold tells them apart.")
        return
    print(f"threshold {least:.3f}")
    if options.write:
        path = find_weights(options.weights)
        model = load_model(path)
        save_weights(path, model.network, replace(model.card, least_match_probability=least))
        print(f"{path}: written")


if __name__ == "__main__":
    main(tyro.cli(Options))
