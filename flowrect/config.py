"""What a network is made of and how it is trained: frozen dataclasses, presets by name.

Where the paper is silent or contradicts itself the choice is a field, and the text under the field
says why the default is what it is. The defaults of :class:`ModelConfig` are the preset ``paper``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from flowrect.augment import Augmentation
from flowrect.loading import Loading
from flowrect.rivals.config import RIVALS, RivalConfig, ViTPoseConfig

PresetName = Literal["paper", "small", "rpnet", "directionnet", "vitpose"]


@dataclass(frozen=True)
class ModelConfig:
    """The network. The defaults are the paper as printed (sections 3.1 to 3.5).

    Choices without a field, where the paper is silent or can be read in two ways:

    * Eq. 3 and 4 name the output of cross-attention by its keys; here it lies at the pixels of its
      queries, and is named by them. The other reading transposes M_vol.
    * Blocks of the transformer normalise before attention and feed-forward, not after them as [54]:
      that needs no warm-up. One more layer norm follows the last block.
    * The CNN has instance normalisation without learnt scale, as GMFlow [58], and even kernels
      where it strides, so that features lie in the middle of what they see.
    * conv3d pools the left columns by 2 after each of the first five convolutions; what is left is
      averaged. It reads M_match in units of a uniform distribution.
    """

    input_wh: tuple[int, int] = (1024, 512)
    """width and height that images are fitted to; the network itself takes any size"""
    channels: int = 128
    """c of the feature maps: 64 (the paper's d) for each axis of the positional encoding"""
    strides: tuple[int, int, int, int] = (2, 1, 2, 2)
    """of the first convolution and the 3 residual blocks. The paper does not say; 1/8 in all, as
    in GMFlow [58], makes the full attention over 1024x512 affordable"""
    blocks: int = 6
    """self-attention blocks, and as many cross-attention blocks"""
    heads: int = 1
    """attention heads. The paper does not say; one, as in GMFlow [58]"""
    pool_keys: int = 1
    """keys and values of attention are means over squares of this many feature pixels; 1: every
    feature pixel, as in the paper. 2 quarters the cost of attention"""
    expansion: int = 4
    """hidden width of the feed-forward network over channels, as in [54]"""
    encode: Literal["before", "after"] = "before"
    """positional encoding before DRectify (Eq. 5) or after it (the text above Eq. 5)"""
    decoder: Literal["conv3d", "displacement"] = "conv3d"
    """conv3d: six 3D convolutions (section 3.5). displacement, beyond the paper: the expected
    position of each match, its spread and its probability, and from them a rotation in closed form
    that the linear layer corrects"""
    decoder_channels: tuple[int, ...] = (32, 32, 32, 16, 16)
    """conv3d: channels between the six convolutions; not in the paper"""
    decoder_rows: int = 64
    """conv3d: rows of the left image that make the input channels; other heights are pooled to it.
    The paper does not say how four dimensions become three; rows are the release's choice"""
    window: int = 2
    """displacement: the expectation is taken this many feature pixels around the best match, so
    that a second mode elsewhere does not pull it away"""
    prior_sigma_deg: float = 2.0
    """displacement: standard deviation of the prior's error, per axis; keeps the closed form finite
    where matches say nothing"""
    head_hw: tuple[int, int] = (64, 128)
    """rows and columns that are flattened for the linear layer; other sizes are pooled to it, so
    that any input size works. At 1024x512 it is H x W of the paper"""
    frame: Literal["camera", "rectified"] = "camera"
    """frame of r_correction. camera: added to the columns of R_init (Eq. 12). rectified: added to
    those of the identity in the frame that R_init rectifies to, the one that the network sees, so
    that what it learns does not depend on the prior. Equal for a prior without rotation"""
    correction_limit: float = 1.0
    """r_correction = limit * Tanh(...); 1 as in Eq. 8"""
    passes: int = 1
    """beyond the paper: how often a rotation is predicted outside training, each time with the last
    one as R_init. Where the first pass was right the second sees rectified features"""
    zero_head: bool = True
    """start the linear layer at zero, so that training starts from the prior. The paper does not
    say; PyTorch's default start is several degrees off"""
    max_tokens: int = 16384
    """feature pixels h * w at most: a correlation volume of (h * w)^2 float32, 1 GiB for 16384"""


PAPER = ModelConfig()
SMALL = replace(
    PAPER,
    input_wh=(256, 128),
    channels=64,
    strides=(2, 1, 2, 1),  # 64x32 feature pixels: matches to a fraction of 4 px
    blocks=3,
    pool_keys=2,
    expansion=2,
    encode="after",  # what is matched lies in the rectified frame
    decoder="displacement",
    head_hw=(4, 8),
    frame="rectified",
    passes=2,
    correction_limit=0.1,  # 6 degrees; one step of Adam moves the output by a tenth as much
)
MODELS: dict[str, ModelConfig] = {"paper": PAPER, "small": SMALL}


@dataclass(frozen=True)
class LossWeights:
    """What is minimised (Eq. 15), and one term beyond the paper."""

    rotation: float = 10.0
    """of the entry-wise sum |R_gt - R_pred| (Eq. 17; the sum, since only it balances the flow)"""
    flow: float = 0.1
    """of the mean |vertical flow| at 512x256 (Eq. 16) [1/px]"""
    matching: float = 0.0
    """beyond the paper: of the cross-entropy of M_match against exact flow [1/nat]"""


@dataclass(frozen=True)
class LoopOptions:
    """What every training needs to know, whatever the network."""

    data: Path
    """a set of simgen (its train frames), or another layout that flowrect.sources knows"""
    root: Path | None = None
    """folder that the paths of a CSV list are relative to; the list's own if not given"""
    trusted: bool = False
    """the calibration of a plain folder (left/, right/, calib.yaml) is the truth, as that of a
    rectified set is. Without depth, train with --loss.matching 0 and another teacher than exact"""
    both_directions: bool = False
    """of a rendered set: each pair from left to right, and from right to left, too. Validation is
    from left to right"""
    out: Path = Path("runs/flowrect")
    """folder of the run: checkpoint, best and last weights, metrics.jsonl, TensorBoard"""
    init: str = ""
    """weights to start from: a name or a file; random if not given. Those of our own network may
    have been trained at another ``input_wh``"""
    loading: Loading = field(default_factory=lambda: Loading(batch=16))
    """batch: pairs per backward pass, over all processes"""
    augmentation: Augmentation = field(default_factory=Augmentation)
    truth_points: int = 2048
    """about how many exact correspondences a pair of a rendered set carries"""
    fit: Literal["crop", "stretch"] = "crop"
    """crop to the aspect of the input, or squeeze the image as the paper's release does"""
    keep: float = 0.0
    """share of the window's sides that is kept; 0: the largest that no drawn turn of a camera
    leaves partly empty, see flowrect.turn"""
    epochs: int = 100
    """passes over the data; the paper says 80 to 140"""
    max_steps: int = 0
    """optimiser steps; 0: as many as the epochs have"""
    minutes: float = 0.0
    """stop, with a checkpoint, once training has taken so long, the runs that this one goes on from
    included; 0: no limit. The rate follows the epochs or steps, so that no preset has a limit:
    docs/training.md has the commands of comparisons at one budget"""
    lr: float = 1e-4
    """of Adam, at the start"""
    lr_final: float = 0.05
    """the rate decays exponentially to this share of itself at the last step. The paper names
    neither decay nor end; .05 over 100 epochs is 3 % an epoch"""
    warmup_steps: int = 0
    """the rate grows linearly over the first steps; not in the paper"""
    accumulate: int = 1
    """backward passes per optimiser step"""
    clip: float = 1.0
    """of the gradient's norm; not in the paper"""
    average: float = 0.0
    """decay of a moving average of the weights, such as .99, which is what is validated and saved;
    0: the weights of the last step. Not in the paper"""
    precision: Literal["no", "bf16", "fp16"] = "no"
    """of the network; geometry stays float64"""
    val_pairs: int = 48
    """the last pairs of the data, which are not trained on, nor is any other pair of their scenes,
    which join them: they choose the best weights"""
    val_every: int = 500
    """steps between validations; each one also writes a checkpoint"""
    overfit: int = 0
    """self-check: train on this many pairs as they stand, and validate on the same. flowrect.train
    has a schedule of its own for it, 250 steps; give --max-steps, --lr, … for another"""


@dataclass(frozen=True)
class PoseOptions(LoopOptions):
    """What every training for the pose of a pair needs to know."""

    both_directions: bool = True
    preset: PresetName = "paper"
    """paper on a GPU, small on a CPU if not given; or a rival of the paper's tables. --model NAME
    says the same"""
    translation: Literal["gt", "nominal"] = "gt"
    """t of the prior and of DRectify. gt as in the paper, though it leaks the right camera's yaw
    and roll; nominal is what a user has"""


@dataclass(frozen=True)
class TrainOptions(PoseOptions):
    """Trains the network on a set of pairs.

    The same command again resumes where the last one stopped, bit for bit on a CPU; on CUDA sums
    may differ in their last digits. Ctrl-C saves first.
    ``--overfit 4`` should come below 0.02 degrees. ``--model rpnet``, ``directionnet`` or
    ``vitpose`` trains a rival instead, which has other options: add ``--help`` to see them.
    """

    model: ModelConfig = PAPER
    loss: LossWeights = field(default_factory=LossWeights)
    teacher: Literal["exact", "raft", "raft-matches", "none"] = "exact"
    """where vertical flow comes from. exact: depth and poses. raft: a frozen flow network, which
    needs no depth (the paper's own way). raft-matches: the same, but its gradient is that of
    the geometry, with what was matched held fixed, not that of the network; it takes less time.
    none: nowhere (the paper's "w/o OF")"""
    flow_weights: str = "raft"
    """of the teachers raft: a name or file of flowrect.train_flow, a file of torchvision's, or
    "torchvision" or "torchvision-large" to let it fetch its own"""
    teacher_device: str = ""
    """where the teacher runs, such as cuda:1; beside the network if not given"""


@dataclass(frozen=True)
class RivalOptions(PoseOptions):
    """Trains a rival of the paper's tables on the same data, by the same loop.

    The same command again resumes where the last one stopped, bit for bit on a CPU; on CUDA sums
    may differ in their last digits. Ctrl-C saves first.
    """

    model: RivalConfig = field(default_factory=ViTPoseConfig)
    """which rival, and its fields"""


@dataclass(frozen=True)
class FlowOptions(LoopOptions):
    """Trains RAFT (small) on the exact flow of rendered pairs, perturbed and rectified.

    Its weights are the teacher of ``flowrect.train --teacher raft``, and measure vertical flow
    where there is no depth. The same command again resumes where the last one stopped.
    """

    out: Path = Path("runs/raft")
    loading: Loading = field(default_factory=lambda: Loading(batch=4))
    truth_points: int = 8192
    lr: float = 4e-4
    warmup_steps: int = 100
    crop_wh: tuple[int, int] = (512, 256)
    """training sees windows of this size, drawn anew each time, of the 512x256 images: multiples
    of 8, at least 128. 256x128 takes a quarter of the time"""
    magnify: float | None = None
    """images are magnified by this before RAFT sees them, whose features lie 8 px apart; if not
    given, as the weights of --init say, else 1"""
    updates: int = 12
    """refinements of the flow, each of which is supervised; 0: only features are trained, by
    ``matching``, at a third of the cost, as a start for --init"""
    refine: int | None = None
    """how often the flow is refined outside of training, which the weights remember; if not given,
    as those of --init say, else 12"""
    matching: float = 0.0
    """beyond RAFT: weight [px/nat] of the cross-entropy of the features' correlation against exact
    flow, over all features of the right image"""
    vertical: float = 1.0
    """beyond RAFT: weight of the vertical error of the flow over the horizontal one, since it is
    vertical flow that teacher and metric read"""
    rectified: float = 0.5
    """share of the batches that are rectified, by a pose which is wrong by up to ``error_deg``"""
    error_deg: float = 1.0
    """of that pose, each component of its rotation vector within ± this"""


@dataclass(frozen=True)
class HitnetConfig:
    """HITNet, compact: for 512x256 on a CPU. The paper's is about twice as wide and deep."""

    channels: tuple[int, ...] = (16, 16, 24, 24)
    """of the feature maps at 1, 1/2, 1/4, …; as many as there are resolutions. The paper has five:
    (16, 16, 24, 24, 32)"""
    max_disparity: int = 208
    """disparities [px] that are searched: 205 is 2 m, for a baseline of 1.6 m and 512 px of 90°"""
    tile_channels: int = 16
    """of the features that whole tiles are compared by"""
    descriptor: int = 13
    """numbers that a tile carries beside its plane"""
    hidden: int = 32
    """channels of propagation"""
    dilations: tuple[int, ...] = (1, 1)
    """of the residual blocks of propagation"""
    refine_hidden: tuple[int, int, int] = (32, 24, 16)
    """channels of the last refinements, at tiles of 4, 2 and 1 px"""
    refine_dilations: tuple[int, ...] = (1, 2)
    """of their residual blocks; the paper has (1, 2, 4, 8, 1, 1) at 4 px"""


@dataclass(frozen=True)
class HitnetLoss:
    """Weights of the terms of HITNet's loss; 1 each in the paper."""

    init: float = 1.0
    """tiles of one place are alike, others are not [1/feature]"""
    disparity: float = 1.0
    """robust error of every hypothesis at every resolution"""
    slant: float = 1.0
    """error of slopes where the disparity is right to a pixel [px/px]"""
    confidence: float = 1.0
    """the surer hypothesis is the better one"""


@dataclass(frozen=True)
class DepthOptions(LoopOptions):
    """Trains HITNet on exact disparity of rendered pairs, rectified by the truth.

    The same command again resumes where the last one stopped.
    """

    out: Path = Path("runs/hitnet")
    loading: Loading = field(default_factory=lambda: Loading(batch=4))
    truth_points: int = 65536
    """about how many exact correspondences a pair carries; slopes are fitted to them, so that
    several should fall on a tile of 4x4 pixels of 512x256"""
    model: HitnetConfig = field(default_factory=HitnetConfig)
    loss: HitnetLoss = field(default_factory=HitnetLoss)
    lr: float = 4e-4
    warmup_steps: int = 100


TRAINING: dict[str, TrainOptions] = {
    "paper": TrainOptions(data=Path("shards")),
    "small": TrainOptions(
        data=Path("shards"),
        preset="small",
        model=SMALL,
        loading=Loading(batch=8),
        loss=LossWeights(matching=0.5),
        lr=5e-4,
        warmup_steps=100,
    ),
}


def _rival(preset: PresetName, **changes: Any) -> RivalOptions:
    return RivalOptions(
        data=Path("shards"), preset=preset, model=RIVALS[preset], loading=Loading(batch=8),
        warmup_steps=100, **changes,
    )  # fmt: skip


RIVAL_TRAINING: dict[str, RivalOptions] = {
    "rpnet": _rival("rpnet", lr=1e-4),
    "directionnet": _rival("directionnet", lr=1e-3),
    "vitpose": _rival("vitpose", lr=2e-4, clip=2.5),
}
"""for a CPU: smaller batches than the papers', which have 60 or so"""

OVERFIT: dict[str, Any] = {
    "max_steps": 250, "lr": 1e-3, "lr_final": 0.005, "warmup_steps": 20, "val_every": 25
}  # fmt: skip
"""defaults of every preset with --overfit: ``small`` knows 4 pairs after 150 of these steps"""
