"""simgen: road scenes with a wide-baseline camera rig, rendered with exact ground truth."""

__version__ = "0.2.0.dev3"
